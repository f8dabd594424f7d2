"""Records rollouts of simulations, and of the package's environments.

env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0", contact_forces=True)
rollout = record(env, lambda observation: env.action_space.sample(), seconds=5.0)
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
from ce_gym.viewer.rollouts.ground_patch import around
from ce_gym.viewer.rollouts.rollout import Rollout, RolloutError
from ce_gym.viewer.rollouts.scan import scans_of

Act = Callable[[Any], NDArray[np.float32]]
"""A policy, or any other function from observations to actions in the shapes of the environment."""


class Recorder:
    """Collects the frames of a rollout.

    Args:
        robot: Name of the robot, or path of its file.
        transmission: Transmission level.
        dt: Time between frames [s].
        label: A few words for the legend.
        info: Further entries for the file, as text.
        contact_names: Names of the contacts of the forces; empty for all contacts of the robot.
        signal_names: Names of further signals for plots.
        terrain: The ground; the rollout keeps the part around the robot's path. None for flat ground.
        scan: Height and range scans, see `Rollout.scan`.
    """

    def __init__(
        self,
        robot: str,
        transmission: str,
        dt: float,
        *,
        label: str = "",
        info: Mapping[str, str] | None = None,
        contact_names: Sequence[str] = (),
        signal_names: Sequence[str] = (),
        terrain: Terrain | None = None,
        scan: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        self._terrain = terrain
        self._header: dict[str, Any] = {"robot": robot, "transmission": transmission, "dt": dt, "label": label}
        self._header |= {"info": dict(info or {}), "contact_names": tuple(contact_names)}
        self._header |= {"signal_names": tuple(signal_names), "scan": tuple(scan)}
        self._frames: list[dict[str, Any]] = []

    def __len__(self) -> int:
        return len(self._frames)

    def add(
        self,
        time: float,
        q: ArrayLike,
        v: ArrayLike,
        contact_forces: ArrayLike = (),
        command: ArrayLike = (),
        torque: ArrayLike = (),
        signals: ArrayLike = (),
    ) -> None:
        """Append one frame; the arrays are copied.

        Args:
            time: [s]
            q: Positions, shape (nq,).
            v: Velocities, shape (nv,).
            contact_forces: Force on each contact, world axes [N], shape (n_contacts, 3).
            command: Shape (n,); see `Rollout.commands`.
            torque: Motor torques at the independent joints [N m], shape (n_joints,).
            signals: One number for each of `signal_names`.
        """
        frame = {"times": time, "q": q, "v": v, "commands": command, "torques": torque, "signals": signals}
        frame["contact_forces"] = np.reshape(contact_forces, (-1, 3))
        self._frames.append({name: np.array(value, float) for name, value in frame.items()})

    def rollout(self) -> Rollout:
        """Return the rollout of all frames.

        Raises:
            RolloutError: There is no frame, or frames differ in shape.
        """
        if not self._frames:
            raise RolloutError("nothing was recorded: expected at least one frame")
        arrays: dict[str, Any] = {
            name: _stack(name, [frame[name] for frame in self._frames]) for name in self._frames[0]
        }
        ground = None
        if self._terrain is not None:
            floating = arrays["q"].shape[1] > arrays["v"].shape[1]  # the quaternion of the base
            ground = around(self._terrain, arrays["q"][:, :2] if floating else np.zeros((1, 2)))
        return Rollout(**self._header, **arrays, ground=ground)


def _stack(name: str, rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    shapes = sorted({row.shape for row in rows})
    if len(shapes) > 1:
        raise RolloutError(f"{name} changes shape from frame to frame: {shapes[0]} and {shapes[1]}")
    return np.array(rows, float)


def record(env: Any, act: Act, seconds: float, *, lane: int = 0, **options: Any) -> Rollout:
    """Record one robot from a reset on, for some time or until its episode ends.

    Contact forces are recorded if the environment was made with `contact_forces=True`.

    Args:
        env: A single or vector environment of ce_gym, wrapped or not. It stays open.
        act: The policy.
        seconds: Duration [s].
        lane: Index of the robot in a vector environment.
        **options: seed, commands, label and info, see `record_lanes`.

    Returns:
        One frame per control step.

    Raises:
        ViewerError: The environment is not of ce_gym, or has no such lane.

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
    """Record several robots of a vector environment, each until its episode ends.

    Args:
        env: See `record`.
        act: The policy.
        seconds: Duration [s].
        lanes: Indices of the robots.
        seed: Seed of the reset.
        commands: Command of each control step, shape (n, 3); the last one holds until the end. None leaves commands to
            the task.
        label: A few words for the viewer's legend.
        info: Further entries for the file, as text.

    Returns:
        One rollout for each of `lanes`.

    Raises:
        ViewerError: The environment is not of ce_gym, or has no such lane.
    """
    native = env.unwrapped
    if not isinstance(native, BaseEnv):
        raise ViewerError(f"cannot record {type(native).__name__}: expected an environment of ce_gym")
    batch, program = native.batch, native.batch.program
    for lane in lanes:
        if not 0 <= lane < batch.num_envs:
            raise ViewerError(f"lane {lane}: expected 0 to {batch.num_envs - 1}")
    reward_terms = tuple(program.reward_terms)
    recorders = {
        lane: Recorder(
            robot_reference(program.model.robot),
            program.model.transmission,
            native.dt,
            label=label,
            info={"task": native.task, **(info or {})},
            contact_names=native.contact_names,
            signal_names=("reward", *(f"reward: {name}" for name in reward_terms)),
            terrain=field_of(program.task.terrain),
            scan=scans_of(program),
        )
        for lane in lanes
    }
    script = None if commands is None else np.asarray(commands, float)
    observation, _ = env.reset(seed=seed)
    rewards, running = np.zeros((batch.num_envs, 1 + len(reward_terms))), set(lanes)
    for step in range(round(seconds / native.dt)):
        if script is not None:
            command = script[min(step, len(script) - 1)]
            batch.write("command", np.broadcast_to(command, (batch.num_envs, 3)).astype(batch.dtype))
        state = BaseEnv.state(native)  # a single environment returns no rows
        for lane in running:
            forces = state["contact_forces"][lane] if "contact_forces" in state else ()
            q, v, command, torque = (state[name][lane] for name in ("q", "v", "command", "torque"))
            recorders[lane].add(step * native.dt, q, v, forces, command, torque, rewards[lane])
        observation, reward, terminated, truncated, step_info = env.step(act(observation))
        rewards = np.column_stack([np.atleast_1d(reward), *_weighted_terms(step_info, reward_terms)])
        running -= set(np.flatnonzero(np.atleast_1d(np.logical_or(terminated, truncated))).tolist())
        if not running:
            break
    return [recorder.rollout() for recorder in recorders.values()]


def robot_reference(robot: Robot) -> str:
    """Return the name of a robot of the package, or the path of another robot's file."""
    return robot.name if robot.name in robots() else robot.source or robot.name


def _weighted_terms(info: Mapping[str, Any], names: Sequence[str]) -> list[NDArray[np.float64]]:
    """Return the weighted reward terms of a step, each shape (num_envs,)."""
    if "reward_terms" in info:
        return [info["reward_terms"][name] for name in names]
    return [np.array([info[f"reward_{name}"]]) for name in names]
