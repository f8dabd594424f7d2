"""One robot of a live page: an environment without commands, pushes or resets of its own."""

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
from ce_gym.viewer.rollouts.driving import made
from ce_gym.viewer.rollouts.scan import scans_of

Array = NDArray[np.float64]
Act = Callable[[Any], NDArray[np.float32]]

RANGES = {"friction": (0.05, 2.0), "added_mass": (0.0, 10.0)}
"""Figures that can be changed while it walks, and how far; see `ce_gym.envs.task.tasks.RANDOMISED`."""
UNDISTURBED: dict[str, Any] = {
    "command_period": 1e6,
    "heading": False,
    "push_period": 0.0,
    "noise": {},
    "terminations": (),  # who falls may try to get up
    "contacts": "all",  # or what ends an episode would sink into the ground
    "command_curriculum": 1.0,
    "max_episode_steps": 10**9,
}
"""What replaces figures of a task: everything that happens to the robot is asked for in the page."""


class LiveRobot:
    """A robot under a policy, stepped and disturbed from outside.

    Args:
        env_id: Registered environment id.
        act: The policy: actions for observations; None holds the pose that an action of zero stands for.
        **kwargs: Given to the environment, such as `transmission` or `terrain`.

    Attributes:
        model: The robot.
        dt: Length of a control step [s].
        terrain: The ground, None where it is flat.
        scan: Where its height and range scans look, see `Rollout.scan`.
        command_range: Bounds of the commands that the task draws, shape (3, 2).

    Raises:
        ViewerError: If the environment cannot be made, or is none of ce_gym.
    """

    def __init__(self, env_id: str, act: Act | None = None, **kwargs: Any) -> None:
        options = {**kwargs, **UNDISTURBED, "randomise": RANGES}
        self._env, native = made(env_id, 1, options)
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
        """Let it stand where episodes begin; on ground with levels, on the last of them."""
        self._observation, _ = self._env.reset(seed=seed)
        while self._terrain_level() < self._last_level:
            self._observation, _ = self._env.reset()
        self.set_figures({})

    def _terrain_level(self) -> float:
        return self._batch.rows("level")[0, 0] if self.terrain is not None else 0

    def set_figures(self, figures: Mapping[str, float]) -> None:
        """Change some of `RANGES`; values beyond them are clipped."""
        self.figures = {**self.figures, **figures}
        shares = [(self.figures[name] - low) / (high - low) for name, (low, high) in RANGES.items()]
        draw = np.clip(shares, 0.0, 1.0)
        self._batch.write("draw", draw[None])
        self._batch.write("parameters", self._values(draw).full().T)

    def step(self, command: ArrayLike) -> None:
        """Carry out one control step: forward [m/s], sideways [m/s] and yaw rate [rad/s] are commanded."""
        action = self._act(self._observation)
        self._native.set_command(np.asarray(command, float))
        self._observation, _, _, truncated, _ = self._env.step(action)
        if truncated[0]:  # it has diverged
            self.reset()

    def state(self) -> tuple[Array, Array]:
        """Return positions and velocities, shapes (nq,) and (nv,)."""
        return self._batch.rows("q")[0].astype(float), self._batch.rows("v")[0].astype(float)

    def write(self, q: ArrayLike, v: ArrayLike) -> None:
        """Set positions and velocities."""
        self._batch.write("q", np.asarray(q, float)[None])
        self._batch.write("v", np.asarray(v, float)[None])

    def frame(self) -> dict[str, Array]:
        """Return what is recorded of a moment: q, v, command and torque."""
        return {name: self._batch.rows(name)[0].astype(float) for name in ("q", "v", "command", "torque")}

    def snapshot(self) -> tuple[Snapshot, Any]:
        """Return all that `restore` needs to continue bit for bit."""
        return self._batch.snapshot(), self._observation

    def restore(self, snapshot: tuple[Snapshot, Any]) -> None:
        """Continue from a snapshot."""
        state, self._observation = snapshot
        self._native.restore(state)

    def close(self) -> None:
        """Give back what the environment holds."""
        self._env.close()
