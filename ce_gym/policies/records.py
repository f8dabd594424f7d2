"""The record of a policy: environment, sizes and specification, as plain data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium

from ce_gym.policies.arguments import RESERVED
from ce_gym.policies.environments import shown
from ce_gym.policies.errors import PolicyError
from ce_gym.policies.height_maps import with_map

RECORD_KEY = "ce_gym_policy"
"""Key of the record in the metadata of an ONNX file."""

REQUIRED: dict[str, type] = {
    "env": str, "env_kwargs": dict, "transmission": str, "observation_size": int, "action_size": int,
    "policy_spec": dict,
}  # fmt: skip
"""Required keys of a record, with their types."""

KINDS = {str: "text", dict: "a JSON object", int: "a whole number"}


def environment_record(native: Any, env_id: str, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a record that describes the environment.

    Args:
        native: The vector environment, unwrapped.
        env_id: Its registered id.
        env_kwargs: Its arguments.
    """
    space, action = native.single_observation_space, native.single_action_space.shape
    observation = space["policy"].shape if isinstance(space, gymnasium.spaces.Dict) else space.shape
    return {
        "env": env_id,
        "transmission": native.model.transmission,
        "env_kwargs": dict(env_kwargs),
        "observation_size": observation[0] if observation else 0,
        "action_size": action[0] if action else 0,
        "policy_spec": native.policy_spec(),
    }


def record_of_id(env_id: str, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Make an environment, and return the part of a record that describes it.

    Raises:
        PolicyError: If the environment cannot be made, or is not of ce_gym.
    """
    mode = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    try:
        envs = gymnasium.make_vec(env_id, num_envs=1, vectorization_mode=mode, **env_kwargs)
    except (TypeError, ValueError, ImportError, gymnasium.error.Error) as error:
        raise PolicyError(f"environment {env_id!r}: {one_line(error)}") from error
    try:
        return environment_record(envs.unwrapped, env_id, env_kwargs)
    except AttributeError:
        raise PolicyError(f"environment {env_id!r}: expected an environment of ce_gym") from None
    finally:
        envs.close()


def checked_record(record: Any, file: Path, required: Mapping[str, type] = REQUIRED) -> dict[str, Any]:
    """Return a record after checking the keys that running its policy needs.

    Raises:
        PolicyError: If a key is missing or has a wrong value.
    """
    if isinstance(record, dict):
        record = {str(key): value for key, value in record.items()}
    for key, kind in required.items():
        if not isinstance(record, dict) or key not in record:
            raise PolicyError(f"{file}: {key}: missing; expected a record, which ce_gym.policies.save writes")
        if type(record[key]) is not kind:  # a bool is an int
            raise PolicyError(f"{file}: {key}: {shortened(record[key])}; expected {KINDS[kind]}")
    if reserved := RESERVED & record["env_kwargs"].keys():
        raise PolicyError(f"{file}: env_kwargs: {min(reserved)}: expected arguments of the environment alone")
    record["env_kwargs"] = with_map(record["env_kwargs"], file)
    return record


def one_line(error: Exception) -> str:
    """Return the message of an error as one line of at most 200 printable characters."""
    return shortened(" ".join(str(error).split()), str) or type(error).__name__


def shortened(value: Any, text: Callable[[Any], str] = repr) -> str:
    """Return a value as text of at most 200 printable characters."""
    try:
        return shown(text(value)[:200])
    except RecursionError:
        return "a deeply nested value"
