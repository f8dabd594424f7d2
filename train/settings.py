"""Settings of learners: what they are, and how they are read from a YAML file and the command line.

One file per robot and task lies in `config/`, found by the name of the environment. A file is complete: every setting
is in it, none is inherited.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar

from ce_gym.policies import ACTIVATIONS, checked_arguments, listed_names, parse_yaml

Activation = str
"""One of those with which a policy can be run without its learner."""

LIMITS = {
    "steps": 1e12, "num_envs": 2**20, "rollout": 10_000, "minibatches": 10_000, "epochs": 1000, "hidden": 2**13,
    "initial_std": (1e-6, 100), "final_std": (0, 100), "learning_rate": (0, 1), "target_kl": (0, 10), "gamma": (0, 1),
    "gae_lambda": (0, 1), "clip": (1e-6, 10), "entropy": (0, 10), "final_entropy": (0, 10), "value": (0, 1000),
    "fall_cost": (0, 1e6), "max_grad_norm": (1e-6, 1e9),
    "decay": (1e-3, 1), "target_memory": (0, 1), "max_adjoint": (1e-9, 1e30),
}  # fmt: skip
"""The largest of whole numbers, whose smallest is 1; the smallest and largest of other numbers."""

MOST_SAMPLES = 10**8
"""Steps between two updates, over all environments: more would not fit into memory."""

ENV_ARGS = "env_args"
"""Key of a settings file under which arguments of the environment stand, by name; the only one that may be missing."""

NETWORK = ("hidden", "activation")
"""What a policy keeps for life."""

CONFIG_FOLDER = Path(__file__).parent / "config"


class SettingsError(ValueError):
    """A settings file or override that cannot be used; the message is one line for the user."""


@dataclass(frozen=True)
class CommonSettings:
    """Settings of every learner.

    Attributes:
        steps: Environment steps to train for, over all environments.
        num_envs: Environments stepped at once.
        rollout: Control steps of each environment between two updates.
        minibatches: Parts into which the collected steps are divided.
        epochs: Times each update goes over the collected steps.
        hidden: Sizes of the hidden layers, the same for policy and value.
        activation: Tanh, ReLU, ELU, SELU, Sigmoid or Softplus, as in `torch.nn`.
        initial_std: Standard deviation of the actions at the start; actions lie in -1..1.
        final_std: At the end, geometric in between.
        learning_rate: Of Adam, at the start.
        gamma: Discount per step.
        gae_lambda: Of generalised advantage estimation, or of the critic's targets, TD(lambda).
        fall_cost: What an episode that ends as a failure takes from the reward of its last step, in the end; see
            `progress.fall_cost`. Rewards that are reported are without it.
        max_grad_norm: Gradients of the networks are clipped to this norm.
        training: Arguments of the environment for training only, by which no policy is judged; those that go with the
            policy are `env_args`.
    """

    steps: int
    num_envs: int
    rollout: int
    minibatches: int
    epochs: int
    hidden: tuple[int, ...]
    activation: Activation
    initial_std: float
    final_std: float
    learning_rate: float
    gamma: float
    gae_lambda: float
    fall_cost: float
    max_grad_norm: float
    training: Mapping[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """The settings as plain data, for a record beside the policy."""
        return asdict(self)


@dataclass(frozen=True)
class Settings(CommonSettings):
    """Everything that shapes learning by PPO, apart from the environment itself and the seed.

    Attributes:
        final_std: 0 lets the learner choose it during training. Of use where robots fall by the mean action, by which
            policies are judged, that stood with the noise of training.
        target_kl: KL divergence of an update that the learning rate is adapted to; with 0 it falls linearly to 0.
        clip: Clipping range of PPO's probability ratio.
        entropy: Weight of the entropy bonus at the start.
        final_entropy: At the end, linear in between.
        value: Weight of the value loss.
    """

    folder: ClassVar[Path] = CONFIG_FOLDER

    target_kl: float
    clip: float
    entropy: float
    final_entropy: float
    value: float


def config_file(env_id: str, folder: Path = CONFIG_FOLDER) -> Path:
    """The settings file of an environment, in the folder of a learner.

    `namespace/MyRobotTask-Level-v0` takes `my_robot_task_level.yaml` if there is one, else `my_robot_task.yaml`, else
    `default.yaml`.
    """
    name = re.sub(r"-v\d+$", "", env_id.rsplit("/", 1)[-1])
    for candidate in (name.replace("-", ""), name.split("-")[0]):
        path = folder / f"{_snake(candidate)}.yaml"
        if path.exists():
            return path
    return folder / "default.yaml"


def load_settings(path: Path, overrides: Iterable[str] = (), kind: type = Settings) -> Any:
    """Read a settings file of a learner and apply `KEY=VALUE` overrides; `kind` is its dataclass of settings.

    Raises:
        SettingsError: If the file cannot be read, or a key is missing, unknown or of the wrong kind.
    """
    data = {key: value for key, value in _read(path).items() if key != ENV_ARGS}
    return make_settings(data | parsed(overrides), str(path), kind)


def load_env_args(path: Path) -> dict[str, Any]:
    """Return the arguments of the environment that a settings file asks for; none if it says nothing of them.

    Raises:
        SettingsError: If the file cannot be read, or they are no plain data by name.
    """
    try:
        return checked_arguments(_read(path).get(ENV_ARGS, {}))
    except SettingsError:
        raise
    except ValueError as error:
        raise SettingsError(f"{path}: {ENV_ARGS}: {error}") from None


def with_named(settings: Any, env_args: Mapping[str, Any]) -> Any:
    """Return settings whose `training` gives way to arguments that a command line names; mappings are merged by key."""
    training = dict(settings.training)
    for name, value in env_args.items():
        if isinstance(value, Mapping) and isinstance(training.get(name), Mapping):
            training[name] = {**training[name], **value}
        else:
            training.pop(name, None)
    return replace(settings, training=training)


def _read(path: Path) -> dict[str, Any]:
    """Return what a settings file says, unchecked."""
    try:
        data = parse_yaml(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise SettingsError(f"{path}: cannot be read as YAML: {reason}") from None
    if not isinstance(data, dict):
        raise SettingsError(f"{path}: expected one `key: value` per line, got {type(data).__name__}")
    return data


def make_settings(data: Mapping[str, Any], source: str, kind: type = Settings) -> Any:
    """Check plain data, key by key, and return it as settings of a kind; `source` names it in errors.

    Raises:
        SettingsError: If a key is missing, unknown or of the wrong kind.
    """
    known = {field.name: str(field.type) for field in fields(kind)}
    for key in data:
        if key not in known:
            raise SettingsError(f"{source}: {key}: unknown setting; expected one of {listed_names(key, known)}")
    for key in known:
        if key not in data:
            raise SettingsError(f"{source}: {key}: missing; expected {known[key]}")
    result = kind(**{key: _convert(source, key, data[key], form) for key, form in known.items()})
    _check_samples(source, result)
    return result


def _check_samples(source: str, s: Any) -> None:
    """See that every minibatch has two samples, or the spread of its advantages would be 0 / 0."""
    samples = s.num_envs * s.rollout
    if samples > MOST_SAMPLES:
        raise SettingsError(
            f"{source}: num_envs * rollout: {samples}; expected at most {MOST_SAMPLES} samples between two updates"
        )
    size = -(-samples // s.minibatches)
    if size < 2 or samples % size == 1:
        raise SettingsError(
            f"{source}: minibatches: {s.minibatches} of {samples} samples; expected at least 2 samples in each"
        )


def parsed(overrides: Iterable[str]) -> dict[str, Any]:
    """Return overrides, each `KEY=VALUE`, as plain data.

    Raises:
        SettingsError: If one is something else.
    """
    return dict(_parse_override(text) for text in overrides)


def _parse_override(text: str) -> tuple[str, Any]:
    """Split one `KEY=VALUE`."""
    key, equals, value = text.partition("=")
    if not equals:
        raise SettingsError(f"--set {text}: expected KEY=VALUE")
    try:
        return key.strip().replace("-", "_"), parse_yaml(value)
    except ValueError as error:
        reason = " ".join(str(error).split())[:200]
        raise SettingsError(f"--set {key.strip()}: cannot be read as YAML: {reason}") from None


def _convert(source: str, key: str, value: Any, kind: str) -> Any:
    """Convert one value. Numbers may be quoted."""
    wanted = f"one of {', '.join(ACTIVATIONS)}" if kind == "Activation" else "a list of layer sizes"
    try:
        if kind == "int":
            high: Any = LIMITS[key]
            wanted = f"a positive whole number, at most {high:g}"
            number = float(value)
            if isinstance(value, bool) or number != int(number) or not 1 <= number <= high:
                raise ValueError
            return int(number)
        if kind == "float":
            low, high = LIMITS[key]  # type: ignore[misc]
            wanted = f"a number from {low:g} to {high:g}"
            number = float(value)
            if isinstance(value, bool) or not low <= number <= high:
                raise ValueError
            return number
        if kind.startswith("Mapping"):
            wanted = "arguments of the environment by name, as plain data"
            return checked_arguments(value)
        if kind == "str":
            wanted = "a name or a path"
            if not isinstance(value, str) or not value:
                raise ValueError
            return value
        if kind == "Activation" and value in ACTIVATIONS:
            return value
        if kind == "Activation" or not isinstance(value, list | tuple) or len(value) > 100:
            raise ValueError
        return tuple(_convert(source, key, size, "int") for size in value)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, SettingsError):
            raise
        raise SettingsError(f"{source}: {key}: {repr(value)[:200]}; expected {wanted}") from None


def _snake(name: str) -> str:
    """`MyRobotTask` as `my_robot_task`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()
