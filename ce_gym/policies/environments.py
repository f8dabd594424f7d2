"""The environment of a policy whose file is not trusted.

Gymnasium imports `module` when an environment `module:id` is made. An id with a module is therefore accepted from the
user's command line only. From a file it is accepted only if the module has been imported already.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from ce_gym.model.errors import RobotError
from ce_gym.model.load import load_robot
from ce_gym.policies.errors import PolicyError, RobotWarning
from ce_gym.policies.places import find_policy


def environment_of(record: Mapping[str, Any], named: str | None = None) -> str:
    """Return the id of the environment that a policy runs in.

    Args:
        record: Record of the policy.
        named: Id that the user gave, such as `my_module:ce_gym/MyRobotVelocity-v0`; it replaces that in the record.

    Raises:
        PolicyError: If the record names an environment that is not registered, or that needs the import of a module.
    """
    if named:
        with contextlib.suppress(gymnasium.error.Error, ImportError, RobotError):  # whoever makes it reports these
            if robot := registered(named).kwargs.get("robot"):
                warn_of_other_robot(record, load_robot(robot).name)
        return named
    env_id = record["env"]
    module, _, name = env_id.rpartition(":")
    if module not in ("", "ce_gym") and module not in sys.modules:
        raise PolicyError(
            f"environment {env_id!r}: named by the policy's file, would import the module {module!r}; "
            f"if you trust it, name it yourself: --env {shown(env_id)}"
        )
    if name not in gymnasium.registry:
        raise PolicyError(
            f"environment {env_id!r}: not registered; expected one of this package's (see `list`), "
            f"or the module that registers it: --env MODULE:{shown(name)}"
        )
    return env_id


def warn_of_other_robot(record: Mapping[str, Any], robot: str) -> None:
    """Warn if a policy was trained on a robot of another name.

    Warns:
        RobotWarning: The names differ.
    """
    trained = record.get("policy_spec", {}).get("robot", robot)
    if trained != robot:
        warnings.warn(f"trained on robot {shown(str(trained))!r}, used on {robot!r}", RobotWarning, stacklevel=3)


def import_module_of(env_id: str) -> str:
    """Import the module of an id `module:id`, as `gymnasium.make` does, and return the id after the colon.

    Raises:
        ModuleNotFoundError: If there is no such module. Its `name` is None, because no package can be installed for it.
    """
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
    except ModuleNotFoundError as error:
        if f"{module}.".startswith(f"{error.name}."):
            raise ModuleNotFoundError(f"no module named {module!r}; expected a module on PYTHONPATH") from None
        raise  # the module imports a package that is not installed
    return name


def registered(env_id: str) -> EnvSpec:
    """Return the registration of an environment; `module:id` imports the module first, as `gymnasium.make` does.

    Raises:
        ModuleNotFoundError: If there is no such module.
        gymnasium.error.Error: If the environment is not registered.
    """
    name = import_module_of(env_id)
    try:
        return gymnasium.spec(name)
    except gymnasium.error.Error:
        example = "the id of an environment, such as ce_gym/MiniCheetahVelocity-v0"
        if find_policy(name) is not None:
            raise gymnasium.error.NameNotFound(f"{env_id}: is a policy; expected {example}") from None
        if f"ce_gym/{name}" in gymnasium.registry:
            raise gymnasium.error.NameNotFound(f"{env_id}: not registered; did you mean ce_gym/{name}?") from None
        raise


def shown(text: str) -> str:
    """Return text with a question mark in place of each character that a terminal cannot print."""
    return "".join(c if c.isprintable() else "?" for c in text)
