"""Rollouts of a policy that follows a list of commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.envs.base import BaseEnv
from ce_gym.policies import environment_of, import_module_of, load_policy, policy_name
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.rollouts.recording import Act, record_lanes
from ce_gym.viewer.rollouts.rollout import Rollout

Script = Sequence[tuple[float, tuple[float, float, float]]]
"""Commands in sequence, each with its duration [s], forward and sideways speed [m/s] and yaw rate [rad/s]."""

SHOW: Script = (
    (1.0, (0.0, 0.0, 0.0)),
    (4.0, (0.8, 0.0, 0.0)),
    (4.0, (0.5, 0.0, 1.0)),
    (3.0, (0.0, 0.4, 0.0)),
    (4.0, (1.0, 0.0, 0.0)),
    (1.0, (0.0, 0.0, 0.0)),
)
"""Stand, walk, turn, step sideways, walk faster, stand; clipped to the command range of the task."""


def drive(act: Act, env_id: str, script: Script = SHOW, *, seed: int = 0, label: str = "", **kwargs: Any) -> Rollout:
    """Drive one robot through a list of commands and record every control step.

    Recording ends with the script, or with the episode if the robot falls.

    Args:
        act: The policy.
        env_id: Registered environment id.
        script: The commands.
        seed: Seed of the environment.
        label: A few words for the viewer's legend.
        **kwargs: Arguments of the environment, such as `transmission`.
    """
    return drive_many(act, env_id, script, robots=1, seed=seed, label=label, **kwargs)[0]


def drive_many(
    act: Act, env_id: str, script: Script = SHOW, *, robots: int, seed: int = 0, label: str = "", **kwargs: Any
) -> list[Rollout]:
    """Drive several robots through the same commands; robot `i` has seed `seed + i`. See `drive`."""
    seconds = sum(time for time, _ in script)
    # With this period the environment draws no commands of its own.
    envs, native = make_envs(env_id, robots, {**kwargs, "contact_forces": True, "command_period": 1e6})
    try:
        commands = np.repeat([c for _, c in script], [round(t / native.dt) for t, _ in script], axis=0)
        if script is SHOW:
            low, high = np.transpose(native.batch.program.task.command_range)
            commands = np.clip(commands, low, high)
        options: dict[str, Any] = {"seed": seed, "commands": commands, "label": label, "info": {"env": env_id}}
        return record_lanes(envs, act, seconds, lanes=range(robots), **options)
    finally:
        envs.close()


def make_envs(env_id: str, robots: int, options: Mapping[str, Any]) -> tuple[Any, BaseEnv]:
    """Return an environment of several robots, and the environment inside its wrappers.

    Raises:
        ViewerError: The environment cannot be made, or is not of ce_gym.
    """
    import gymnasium

    try:
        envs = gymnasium.make_vec(import_module_of(env_id), robots, vectorization_mode="vector_entry_point", **options)
    except (TypeError, ValueError, ImportError, gymnasium.error.Error) as error:
        raise ViewerError(f"environment {env_id!r}: {' '.join(str(error).split())}") from error
    native = envs.unwrapped
    if not isinstance(native, BaseEnv):
        envs.close()
        raise ViewerError(f"environment {env_id!r}: expected an environment of ce_gym or of a registered robot")
    return envs, native


def walk(file: Path, script: Script = SHOW, *, env: str | None = None, **options: Any) -> list[Rollout]:
    """Run a policy through a list of commands in the environment of its training.

    Args:
        file: File of the policy.
        script: The commands.
        env: Id of another environment than in the policy's record; see `policies.environment_of`.
        **options: Arguments of `drive_many`, and of the environment in place of the training's, such as `transmission`.

    Raises:
        PolicyError: The file is not a policy, or its environment is not registered.
        ViewerError: The environment cannot be made, or is not of ce_gym.
    """
    arguments = {name: value for name, value in options.items() if name not in ("robots", "seed", "label")}
    policy = load_policy(file, env=env, env_kwargs=arguments)
    record = policy.record
    env_id = environment_of(record, env)
    kwargs: Mapping[str, Any] = {"robots": 1, "label": policy_name(file), **record["env_kwargs"], **options}
    return drive_many(lambda observation: policy.predict(observation)[0], env_id, script, **kwargs)
