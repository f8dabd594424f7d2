"""Settings of learners, and their values from a YAML file and the command line.

`config/` has one file per robot and task, found by the name of the environment. Each file contains all settings.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar

from ce_gym.policies import ACTIVATIONS, checked_arguments, listed_names, parse_yaml


def settings_folder() -> Path:
    """Return the folder of settings files: inside an installed package, or `train/config` in a source checkout."""
    learn = Path(__file__).resolve().parents[1]
    installed = learn / "config"
    return installed if installed.is_dir() else learn.parents[1] / "train" / "config"


Activation = str
"""Name of an activation function in `ce_gym.policies.ACTIVATIONS`."""

LIMITS = {
    "steps": 1e12, "num_envs": 2**20, "rollout": 10_000, "minibatches": 10_000, "epochs": 1000, "hidden": 2**13,
    "initial_std": (1e-6, 100), "final_std": (0, 100), "learning_rate": (0, 1), "target_kl": (0, 10), "gamma": (0, 1),
    "gae_lambda": (0, 1), "clip": (1e-6, 10), "entropy": (0, 10), "final_entropy": (0, 10), "value": (0, 1000),
    "fall_cost": (0, 1e6), "max_grad_norm": (1e-6, 1e9),
    "decay": (1e-3, 1), "target_memory": (0, 1), "max_adjoint": (1e-9, 1e30),
}  # fmt: skip
"""Largest value of whole numbers, whose smallest value is 1; smallest and largest value of other numbers."""

MOST_SAMPLES = 10**8
"""Largest number of steps between two updates, over all environments, because of memory."""

ENV_ARGS = "env_args"
"""Key of the arguments of the environment in a settings file; the only optional key."""

NETWORK = ("hidden", "activation")
"""Settings that cannot change when training continues."""

CONFIG_FOLDER = settings_folder()
"""Settings files of PPO; other learners have subfolders."""


class SettingsError(ValueError):
    """A settings file or override cannot be used; the message is one line for the user."""


@dataclass(frozen=True)
class CommonSettings:
    """Settings of every learner.

    Attributes:
        steps: Environment steps to train for, over all environments.
        num_envs: Environments stepped in parallel.
        rollout: Control steps of each environment between two updates.
        minibatches: Number of minibatches of an update.
        epochs: Number of passes over the collected steps in each update.
        hidden: Sizes of the hidden layers, the same for policy and value.
        activation: Tanh, ReLU, ELU, SELU, Sigmoid or Softplus, as in `torch.nn`.
        initial_std: Standard deviation of the actions at the start; actions lie in -1..1.
        final_std: Standard deviation of the actions at the end, geometric in between.
        learning_rate: Learning rate of Adam at the start.
        gamma: Discount per step.
        gae_lambda: Lambda of generalised advantage estimation (PPO), or of the critic's TD(lambda) targets (SHAC).
        fall_cost: Final cost that is subtracted from the last reward of an episode that ends as a failure; see
            `progress.fall_cost`. Reported rewards do not contain it.
        max_grad_norm: Gradients of the networks are clipped to this norm.
        training: Arguments of the environment for training only. Arguments that belong to the policy are in `env_args`.
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
        """Return the settings as plain data, for the record of a policy."""
        return asdict(self)


@dataclass(frozen=True)
class Settings(CommonSettings):
    """Settings of PPO.

    Attributes:
        final_std: Standard deviation of the actions at the end, geometric in between; 0 lets PPO learn it. A small
            value helps if robots stand with the noise of training and fall with the mean action.
        target_kl: KL divergence per update to which the learning rate is adapted; with 0 the rate falls linearly to 0.
        clip: Clipping range of PPO's probability ratio.
        entropy: Weight of the entropy bonus at the start.
        final_entropy: Weight of the entropy bonus at the end, linear in between.
        value: Weight of the value loss.
    """

    folder: ClassVar[Path] = CONFIG_FOLDER

    target_kl: float
    clip: float
    entropy: float
    final_entropy: float
    value: float


def config_file(env_id: str, folder: Path = CONFIG_FOLDER) -> Path:
    """Return the settings file of an environment in the folder of a learner.

    The file of `namespace/MyRobotTask-Level-v0` is the first of `my_robot_task_level.yaml`, `my_robot_task.yaml` and
    `default.yaml` that exists.
    """
    name = re.sub(r"-v\d+$", "", env_id.rsplit("/", 1)[-1])
    for candidate in (name.replace("-", ""), name.split("-")[0]):
        path = folder / f"{_snake(candidate)}.yaml"
        if path.exists():
            return path
    return folder / "default.yaml"


def load_settings(path: Path, overrides: Iterable[str] = (), kind: type = Settings) -> Any:
    """Return the settings in a file, with `KEY=VALUE` overrides; `kind` is the learner's dataclass of settings.

    Raises:
        SettingsError: If the file cannot be read, a key is missing or unknown, or a value is wrong.
    """
    data = {key: value for key, value in _read(path).items() if key != ENV_ARGS}
    return make_settings(data | parsed(overrides), str(path), kind)


def load_env_args(path: Path) -> dict[str, Any]:
    """Return the arguments of the environment in a settings file, or an empty dictionary.

    Raises:
        SettingsError: If the file cannot be read, or the arguments are not plain data by name.
    """
    try:
        return checked_arguments(_read(path).get(ENV_ARGS, {}))
    except SettingsError:
        raise
    except ValueError as error:
        raise SettingsError(f"{path}: {ENV_ARGS}: {error}") from None


def with_named(settings: Any, env_args: Mapping[str, Any]) -> Any:
    """Return settings whose `training` does not override arguments of the command line; mappings are merged."""
    training = dict(settings.training)
    for name, value in env_args.items():
        if isinstance(value, Mapping) and isinstance(training.get(name), Mapping):
            training[name] = {**training[name], **value}
        else:
            training.pop(name, None)
    return replace(settings, training=training)


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a settings file, unchecked."""
    try:
        data = parse_yaml(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise SettingsError(f"{path}: cannot be read as YAML: {reason}") from None
    if not isinstance(data, dict):
        raise SettingsError(f"{path}: expected one `key: value` per line, got {type(data).__name__}")
    return data


def make_settings(data: Mapping[str, Any], source: str, kind: type = Settings) -> Any:
    """Check plain data and return it as settings.

    Args:
        data: Values by key.
        source: Name of the data in errors, such as the path of a file.
        kind: The learner's dataclass of settings.

    Raises:
        SettingsError: If a key is missing or unknown, or a value is wrong.
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
    """Check that every minibatch has two samples, otherwise the variance of its advantages would be 0 / 0."""
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
        SettingsError: If an override has another form.
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
    """Return one value with the type of its setting; numbers may be quoted."""
    expected = f"one of {', '.join(ACTIVATIONS)}" if kind == "Activation" else "a list of layer sizes"
    try:
        if kind == "int":
            high: Any = LIMITS[key]
            expected = f"a positive whole number, at most {high:g}"
            number = float(value)
            if isinstance(value, bool) or number != int(number) or not 1 <= number <= high:
                raise ValueError
            return int(number)
        if kind == "float":
            low, high = LIMITS[key]  # type: ignore[misc]
            expected = f"a number from {low:g} to {high:g}"
            number = float(value)
            if isinstance(value, bool) or not low <= number <= high:
                raise ValueError
            return number
        if kind.startswith("Mapping"):
            expected = "arguments of the environment by name, as plain data"
            return checked_arguments(value)
        if kind == "str":
            expected = "a name or a path"
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
        raise SettingsError(f"{source}: {key}: {repr(value)[:200]}; expected {expected}") from None


def _snake(name: str) -> str:
    """Return `MyRobotTask` as `my_robot_task`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()
