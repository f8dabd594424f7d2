"""One robot of a live page: an environment without its own commands, pushes and resets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.model import Model
from ce_gym.envs.task.terrain_tiles import field_of
from ce_gym.sim.batch import Snapshot
from ce_gym.viewer.rollouts.driving import make_envs
from ce_gym.viewer.rollouts.scan import scans_of

Array = NDArray[np.float64]
Act = Callable[[Any], NDArray[np.float32]]

RANGES = {"friction": (0.05, 2.0), "added_mass": (0.0, 10.0)}
"""Range of each parameter that the page can change; see `ce_gym.envs.task.tasks.RANDOMISED`."""
UNDISTURBED: dict[str, Any] = {
    "command_period": 1e6,
    "heading": False,
    "push_period": 0.0,
    "noise": {},
    "terminations": (),  # a fallen robot may try to get up
    "contacts": "all",  # with fewer contacts a fallen robot sinks into the ground
    "command_curriculum": 1.0,
    "max_episode_steps": 10**9,
}
"""Task arguments that leave commands and disturbances to the page."""


class LiveRobot:
    """A robot with a policy, commanded and disturbed from outside.

    Args:
        env_id: Registered environment id.
        act: The policy: actions for observations; None applies zero actions, which hold the pose.
        **kwargs: Arguments of the environment, such as `transmission` or `terrain`.

    Attributes:
        model: The robot.
        dt: Length of a control step [s].
        terrain: The ground; None if flat.
        scan: Its height and range scans, see `Rollout.scan`.
        command_range: Bounds of the task's commands, shape (3, 2).

    Raises:
        ViewerError: The environment cannot be made, or is not of ce_gym.
    """

    def __init__(self, env_id: str, act: Act | None = None, **kwargs: Any) -> None:
        options = {**kwargs, **UNDISTURBED, "randomise": RANGES}
        self._env, native = make_envs(env_id, 1, options)
        self._native, self._batch, program = native, native.batch, native.batch.program
        self._act = act or (lambda _: np.zeros((1, program.n_actions), np.float32))
        self.model: Model = program.model
        self.dt, self.terrain = native.dt, field_of(program.task.terrain)
        self.scan = scans_of(program)
        self.command_range = np.array(program.task.command_range, float)
        draw = SX.sym("draw", program.randomised.n_draws)
        self._values = ca.Function("values", [draw], [program.randomised.values(draw)])
        self.figures = {"friction": program.model.robot.material.friction, "added_mass": 0.0}
        ground = program.task.terrain
        self._last_level = 0 if ground.get("curriculum", True) else ground.get("levels", 1) - 1
        self.reset(0)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; on ground with levels, on the last level."""
        self._observation, _ = self._env.reset(seed=seed)
        while self._terrain_level() < self._last_level:
            self._observation, _ = self._env.reset()
        self.set_figures({})

    def _terrain_level(self) -> float:
        return self._batch.rows("level")[0, 0] if self.terrain is not None else 0

    def set_figures(self, figures: Mapping[str, float]) -> None:
        """Change some parameters of `RANGES`; values beyond their range are clipped."""
        self.figures = {**self.figures, **figures}
        shares = [(self.figures[name] - low) / (high - low) for name, (low, high) in RANGES.items()]
        draw = np.clip(shares, 0.0, 1.0)
        self._batch.write("draw", draw[None])
        self._batch.write("parameters", self._values(draw).full().T)

    def step(self, command: ArrayLike) -> None:
        """Simulate one control step with a command: forward [m/s], sideways [m/s], yaw rate [rad/s]."""
        action = self._act(self._observation)
        self._native.set_command(np.asarray(command, float))
        self._observation, _, _, truncated, _ = self._env.step(action)
        if truncated[0]:  # the simulation diverged
            self.reset()

    def state(self) -> tuple[Array, Array]:
        """Return positions and velocities, shapes (nq,) and (nv,)."""
        return self._batch.rows("q")[0].astype(float), self._batch.rows("v")[0].astype(float)

    def write(self, q: ArrayLike, v: ArrayLike) -> None:
        """Set positions and velocities."""
        self._batch.write("q", np.asarray(q, float)[None])
        self._batch.write("v", np.asarray(v, float)[None])

    def frame(self) -> dict[str, Array]:
        """Return the present q, v, command and torque, for recordings."""
        return {name: self._batch.rows(name)[0].astype(float) for name in ("q", "v", "command", "torque")}

    def snapshot(self) -> tuple[Snapshot, Any]:
        """Return a snapshot from which `restore` continues bit for bit."""
        return self._batch.snapshot(), self._observation

    def restore(self, snapshot: tuple[Snapshot, Any]) -> None:
        """Continue from a snapshot."""
        state, self._observation = snapshot
        self._native.restore(state)

    def close(self) -> None:
        """Close the environment."""
        self._env.close()
