"""Rollouts of a policy that follows a list of commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.envs.base import BaseEnv
from ce_gym.policies import environment_of, load_policy
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.rollouts.recording import Act, record_lanes
from ce_gym.viewer.rollouts.rollout import Rollout

Script = Sequence[tuple[float, tuple[float, float, float]]]
"""Commands one after the other: for how long [s], then forward, sideways [m/s] and yaw rate [rad/s]."""

SHOW: Script = (
    (1.0, (0.0, 0.0, 0.0)),
    (4.0, (0.8, 0.0, 0.0)),
    (4.0, (0.5, 0.0, 1.0)),
    (3.0, (0.0, 0.4, 0.0)),
    (4.0, (1.0, 0.0, 0.0)),
    (1.0, (0.0, 0.0, 0.0)),
)
"""Stand, walk, turn, step sideways, walk faster, stand; each within what the task commands."""


def drive(act: Act, env_id: str, script: Script = SHOW, *, seed: int = 0, label: str = "", **kwargs: Any) -> Rollout:
    """Drive one robot through a list of commands and record every step.

    Recording ends with the script, or with the episode should the robot fall.

    Args:
        act: The policy.
        env_id: Registered environment id.
        script: What to command.
        seed: Of the environment.
        label: A few words for the viewer's legend.
        **kwargs: Given to the environment, such as `transmission`.

    Returns:
        One frame per step of the environment.
    """
    return drive_many(act, env_id, script, robots=1, seed=seed, label=label, **kwargs)[0]


def drive_many(
    act: Act, env_id: str, script: Script = SHOW, *, robots: int, seed: int = 0, label: str = "", **kwargs: Any
) -> list[Rollout]:
    """Drive several robots through the same commands; robot `i` has seed `seed + i`. See `drive`."""
    seconds = sum(time for time, _ in script)
    # Commands come from the script: the environment draws no new ones before the end of time.
    options = {**kwargs, "contact_forces": True, "command_period": 1e6}
    envs, native = made(env_id, robots, options)
    try:
        commands = np.repeat([c for _, c in script], [round(t / native.dt) for t, _ in script], axis=0)
        if script is SHOW:
            low, high = np.transpose(native.batch.program.task.command_range)
            commands = np.clip(commands, low, high)
        more: dict[str, Any] = {"seed": seed, "commands": commands, "label": label, "info": {"env": env_id}}
        return record_lanes(envs, act, seconds, lanes=range(robots), **more)
    finally:
        envs.close()


def made(env_id: str, robots: int, options: Mapping[str, Any]) -> tuple[Any, BaseEnv]:
    """Make an environment of several robots; return it and what is inside its wrappers.

    Raises:
        ViewerError: If it cannot be made, or is none of ce_gym.
    """
    import gymnasium

    try:
        envs = gymnasium.make_vec(env_id, robots, vectorization_mode="vector_entry_point", **options)
    except (TypeError, ValueError, ImportError, gymnasium.error.Error) as error:
        raise ViewerError(f"environment {env_id!r}: {' '.join(str(error).split())}") from error
    native = envs.unwrapped
    if not isinstance(native, BaseEnv):
        envs.close()
        raise ViewerError(f"environment {env_id!r}: expected one of ce_gym, of its own robots or registered ones")
    return envs, native


def walk(file: Path, script: Script = SHOW, *, env: str | None = None, **options: Any) -> list[Rollout]:
    """Run a policy through a list of commands in the environment it was trained in.

    Args:
        file: Of the policy.
        script: What to command.
        env: Id of the environment, if not the one that the policy's record names; see `policies.environment_of`.
        **options: See `drive_many`; anything else replaces what the policy was trained with, such as `transmission`.

    Raises:
        PolicyError: If the file is damaged or no policy, or its environment is not registered.
        ViewerError: If the environment cannot be made, or is none of ce_gym.
    """
    policy = load_policy(file)
    record = policy.record
    env_id = environment_of(record, env)
    kwargs: Mapping[str, Any] = {"robots": 1, "label": file.resolve().parent.name, **record["env_kwargs"], **options}
    return drive_many(lambda observation: policy.predict(observation)[0], env_id, script, **kwargs)
