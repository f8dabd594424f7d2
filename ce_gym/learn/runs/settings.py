"""Settings of learners, and their values from a YAML file, a policy and the user.

`config/` has one file per robot and task, found by the name of the environment. Each file contains all settings.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar

from ce_gym.model.arguments import check, is_number
from ce_gym.model.options import Check, Options, number, one_of, option, positive
from ce_gym.policies import ACTIVATIONS, checked_arguments, listed_names, parse_yaml

MOST_SAMPLES = 10**8
"""Largest number of steps between two updates, over all environments, because of memory."""

ENV_ARGS = "env_args"
"""Key of the arguments of the environment in a settings file; the only optional key."""

GIVEN = "settings"
"""Beginning of errors about settings that are given by hand; `commands.errors` replaces it by `--set`."""


class SettingsError(ValueError):
    """A settings file or override cannot be used; the message is one line for the user."""


def _settings_folder() -> Path:
    """Return the folder of settings files: inside an installed package, or `train/config` in a source checkout."""
    learn = Path(__file__).resolve().parents[1]
    installed = learn / "config"
    return installed if installed.is_dir() else learn.parents[1] / "train" / "config"


CONFIG_FOLDER = _settings_folder()
"""Settings files of PPO; other learners have subfolders."""


def count(most: float) -> Check:
    """Return a check for a whole number from 1 to `most`, which may be written as 6e6."""

    def checked(name: str, value: Any) -> int:
        whole = is_number(value) and value == int(value)
        check(name, value, whole and 1 <= value <= most, f"a whole number from 1 to {most:g}")
        return int(value)

    return checked


def _layer_sizes(name: str, value: Any) -> tuple[int, ...]:
    """Check the sizes of hidden layers."""
    check(name, value, isinstance(value, list | tuple) and len(value) <= 100, "a list of layer sizes")
    return tuple(count(2**13)(name, size) for size in value)


def _env_arguments(name: str, value: Any) -> dict[str, Any]:
    """Check arguments of an environment."""
    try:
        return checked_arguments(value)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


@dataclass(frozen=True)
class CommonSettings(Options):
    """Settings of every learner.

    Attributes:
        steps: Duration of training, over all environments [environment steps].
        num_envs: Environments stepped in parallel.
        rollout: Length of the experience of each environment between two updates [control steps].
        minibatches: Number of minibatches of an update.
        epochs: Number of passes over the collected steps in each update.
        hidden: Sizes of the hidden layers, the same for policy and value.
        activation: Tanh, ReLU, ELU, SELU, Sigmoid or Softplus, as in `torch.nn`.
        initial_std: Standard deviation of the actions at the start; actions lie in -1..1.
        final_std: Standard deviation of the actions at the end, geometric in between.
        learning_rate: Learning rate of Adam at the start.
        max_grad_norm: Gradients of the networks are clipped to this norm.
        training: Arguments of the environment for training only. Arguments that belong to the policy are in `env_args`.

    Raises:
        ValueError: If a value is wrong; one line.
    """

    steps: int = option(count(1e12))
    num_envs: int = option(count(2**20))
    rollout: int = option(count(10_000))
    minibatches: int = option(count(10_000))
    epochs: int = option(count(1000))
    hidden: tuple[int, ...] = option(_layer_sizes)
    activation: str = option(one_of(ACTIVATIONS))
    initial_std: float = option(positive(100))
    final_std: float = option(number(0, 100))
    learning_rate: float = option(number(0, 1))
    max_grad_norm: float = option(positive(1e9))
    training: Mapping[str, Any] = option(_env_arguments)

    def __post_init__(self) -> None:
        """Check values, and that each minibatch has two samples, because the variance of one sample is 0 / 0."""
        super().__post_init__()
        samples = self.num_envs * self.rollout
        if samples > MOST_SAMPLES:
            raise ValueError(f"num_envs * rollout = {samples}; expected at most {MOST_SAMPLES} samples of an update")
        size = -(-samples // self.minibatches)
        if size < 2 or samples % size == 1:
            raise ValueError(f"minibatches={self.minibatches} of {samples} samples; expected 2 samples or more in each")

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain data, for the record of a policy."""
        return asdict(self)


@dataclass(frozen=True)
class ActorCriticSettings(CommonSettings):
    """Settings of learners with a value function.

    Attributes:
        gamma: Discount per step.
        gae_lambda: Lambda of generalised advantage estimation (PPO), or of the critic's TD(lambda) targets (SHAC).
        fall_cost: Final cost that is subtracted from the last reward of an episode that ends as a failure [reward]. It
            is 0 until 30 % of training and grows until 60 %. Reported rewards do not contain it.
    """

    gamma: float = option(number(0, 1))
    gae_lambda: float = option(number(0, 1))
    fall_cost: float = option(number(0, 1e6))


@dataclass(frozen=True)
class Settings(ActorCriticSettings):
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

    target_kl: float = option(number(0, 10))
    clip: float = option(positive(10))
    entropy: float = option(number(0, 10))
    final_entropy: float = option(number(0, 10))
    value: float = option(number(0, 1000))


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


def load_settings(path: Path, given: Mapping[str, Any] | Iterable[str] = (), kind: type = Settings) -> Any:
    """Return the settings in a file.

    Args:
        path: The file.
        given: Settings that replace those in the file, by name or each as text `KEY=VALUE`.
        kind: The learner's dataclass of settings.

    Raises:
        SettingsError: If the file cannot be read, a key is missing or unknown, or a value is wrong.
    """
    return make_settings(kind, {str(path): read_file(path)[0], GIVEN: by_name(given)})


def read_file(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings in a file, unchecked, and the arguments of the environment.

    Raises:
        SettingsError: If the file cannot be read, or arguments of the environment are not plain data by name.
    """
    try:
        data = parse_yaml(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SettingsError(f"{path}: cannot be read as YAML: {_line(error)}") from None
    if not isinstance(data, dict):
        raise SettingsError(f"{path}: expected one `key: value` per line, got {type(data).__name__}")
    with _errors_of(str(path)):
        return data, _env_arguments(ENV_ARGS, data.pop(ENV_ARGS, {}))


def with_named(settings: Any, env_args: Mapping[str, Any]) -> Any:
    """Return settings whose `training` does not override arguments of the environment; mappings are merged."""
    training = dict(settings.training)
    for name, value in env_args.items():
        earlier = training.pop(name, None)
        if isinstance(value, Mapping) and isinstance(earlier, Mapping):
            training[name] = {**earlier, **value}
    return replace(settings, training=training)


def make_settings(kind: type, sources: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return the settings of several sources.

    Args:
        kind: The learner's dataclass of settings.
        sources: Values by name of setting, by name of the source; later sources replace values of earlier ones.

    Raises:
        SettingsError: If a key is missing or unknown, or a value is wrong.
    """
    checks = {field.name: field.metadata["check"] for field in fields(kind)}
    values: dict[str, Any] = {}
    for source, data in sources.items():
        for key, value in data.items():
            with _errors_of(source):
                if key not in checks:
                    raise ValueError(f"{key}: unknown setting; expected one of {listed_names(key, checks)}")
                values[key] = checks[key](key, value)
    used = [source for source, data in sources.items() if data] or [GIVEN]
    with _errors_of(used[0]):
        if missing := [key for key in checks if key not in values]:
            raise ValueError(f"{missing[0]}: missing; expected all settings of the learner")
    with _errors_of(used[-1]):
        return kind(**values)


@contextlib.contextmanager
def _errors_of(source: str) -> Iterator[None]:
    """Turn errors about values into errors that begin with their source."""
    try:
        yield
    except ValueError as error:
        raise SettingsError(f"{source}: {error}") from None


def by_name(given: Mapping[str, Any] | Iterable[str]) -> dict[str, Any]:
    """Return settings by name; each may be a text `KEY=VALUE`, whose value is YAML.

    Raises:
        SettingsError: If a text has another form.
    """
    if isinstance(given, Mapping):
        return dict(given)
    settings = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals:
            raise SettingsError(f"{GIVEN}: {text}: expected KEY=VALUE")
        try:
            settings[key.strip().replace("-", "_")] = parse_yaml(value)
        except ValueError as error:
            raise SettingsError(f"{GIVEN}: {key}: cannot be read as YAML: {_line(error)}") from None
    return settings


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _snake(name: str) -> str:
    """Return `MyRobotTask` as `my_robot_task`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()
