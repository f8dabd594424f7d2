"""Records a rollout in any environment of the package: a single one, or lanes of a vector environment.

    env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0", contact_forces=True)
    rollout = record(env, lambda observation: env.action_space.sample(), seconds=5.0)

The actions come from an argument: a policy, or any function of the observation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.envs.base import BaseEnv
from ce_gym.envs.task.terrain_tiles import field_of
from ce_gym.model import Robot, robots
from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.rollouts.recorder import Recorder
from ce_gym.viewer.rollouts.rollout import Rollout
from ce_gym.viewer.rollouts.scan import scans_of

Act = Callable[[Any], NDArray[np.float32]]
"""Actions for observations, both as the environment has them."""


def record(env: Any, act: Act, seconds: float, *, lane: int = 0, **options: Any) -> Rollout:
    """Record one robot from a reset on, for some time or until its episode ends.

    Contact forces are recorded if the environment was made with `contact_forces=True`.

    Args:
        env: A single or vector environment of ce_gym, wrapped or not. It stays open.
        act: Who acts.
        seconds: For how long [s].
        lane: Which robot of a vector environment.
        **options: seed, commands, label and info, see `record_lanes`.

    Returns:
        One frame per control step.

    Raises:
        ViewerError: It is no environment of ce_gym, or there is no such lane.

    Examples:
        >>> env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0")
        >>> rollout = record(env, lambda observation: np.zeros(12, np.float32), seconds=1.0, seed=0)
        >>> print(len(rollout), rollout.q.shape)
        50 (50, 19)
    """
    return record_lanes(env, act, seconds, lanes=(lane,), **options)[0]


def record_lanes(
    env: Any,
    act: Act,
    seconds: float,
    *,
    lanes: Sequence[int],
    seed: int | None = None,
    commands: ArrayLike | None = None,
    label: str = "",
    info: Mapping[str, str] | None = None,
) -> list[Rollout]:
    """Record several robots of a vector environment side by side, each until its own episode ends.

    Args:
        env: See `record`.
        act: Who acts.
        seconds: For how long [s].
        lanes: Which robots.
        seed: Given to `reset`.
        commands: What to command in each control step, the last for ever, shape (n, 3); None leaves it to the task.
        label: A few words for the viewer's legend.
        info: Anything else worth keeping, as text.

    Returns:
        One rollout for each of `lanes`.

    Raises:
        ViewerError: It is no environment of ce_gym, or there is no such lane.
    """
    native = env.unwrapped
    if not isinstance(native, BaseEnv):
        raise ViewerError(f"cannot record {type(native).__name__}: expected an environment of ce_gym")
    batch = native.batch
    for lane in lanes:
        if not 0 <= lane < batch.num_envs:
            raise ViewerError(f"lane {lane}: expected 0 to {batch.num_envs - 1}")
    field = field_of(batch.program.task.terrain)
    recorders = {lane: _recorder(native, field, label, info or {}) for lane in lanes}
    given = None if commands is None else np.asarray(commands, float)
    observation, _ = env.reset(seed=seed)
    rewards, running = np.zeros((batch.num_envs, 1 + len(batch.program.reward_terms))), set(lanes)
    for step in range(round(seconds / native.dt)):
        if given is not None:
            now = given[min(step, len(given) - 1)]
            batch.write("command", np.broadcast_to(now, (batch.num_envs, 3)).astype(batch.dtype))
        state = BaseEnv.state(native)  # a single environment returns no rows
        for lane in running:
            forces = state["contact_forces"][lane] if "contact_forces" in state else ()
            q, v, command, torque = (state[name][lane] for name in ("q", "v", "command", "torque"))
            recorders[lane].add(step * native.dt, q, v, forces, command, torque, rewards[lane])
        observation, reward, terminated, truncated, more = env.step(act(observation))
        rewards = np.column_stack([np.atleast_1d(reward), *_terms(more, tuple(batch.program.reward_terms))])
        ended = np.atleast_1d(np.logical_or(terminated, truncated))
        running -= set(np.flatnonzero(ended).tolist())
        if not running:
            break
    return [recorder.rollout() for recorder in recorders.values()]


def _recorder(native: BaseEnv, field: Terrain | None, label: str, info: Mapping[str, str]) -> Recorder:
    model = native.batch.program.model
    names = ("reward", *(f"reward: {name}" for name in native.batch.program.reward_terms))
    return Recorder(
        reference(model.robot),
        model.transmission,
        native.dt,
        label=label,
        info={"task": native.task, **info},
        contact_names=native.contact_names,
        signal_names=names,
        terrain=field,
        scan=scans_of(native.batch.program),
    )


def reference(robot: Robot) -> str:
    """Return what a robot is found by: its name if it ships with the package, else its file."""
    return robot.name if robot.name in robots() else robot.source or robot.name


def _terms(info: Mapping[str, Any], names: Sequence[str]) -> list[NDArray[np.float64]]:
    """Return the weighted reward terms of a step, each shape (num_envs,)."""
    if "reward_terms" in info:
        return [info["reward_terms"][name] for name in names]
    return [np.array([info[f"reward_{name}"]]) for name in names]
