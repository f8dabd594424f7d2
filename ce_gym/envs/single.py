"""`LeggedEnv`: one robot as a Gymnasium `Env`, a batch of one."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ce_gym.envs.base import BaseEnv, check_options, checked_action, spaces
from ce_gym.envs.rendering import RENDER_MODES
from ce_gym.envs.runtime.setup import make_batch


class LeggedEnv(BaseEnv, gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One robot and one task.

    Observations and actions are float32 vectors; `observation_structure` names the blocks of an observation. `info` has

    - `diverged`: whether the simulation failed numerically. The episode is then truncated at the last good state.
    - `reward_<name>`: each weighted reward term.
    - `x_position`, `y_position`, `distance_from_origin` [m], `x_velocity`, `y_velocity` [m/s] of the base in the world,
      as in Gymnasium's MuJoCo environments.

    Args:
        robot: Name of a robot of the package, or a path to a robot file.
        task: Name of a task.
        obs_mode: "vector", or "dict" for `{"policy": ..., "critic": ...}`, where the critic may have more blocks.
        render_mode: None; "rgb_array" for pictures as arrays; or "human" for a live page on localhost.
        width: Width of a picture [pixels].
        height: Height of a picture [pixels].
        **kwargs: See `ce_gym.envs.runtime.setup.make_batch`.
    """

    metadata: dict[str, Any] = {"render_modes": [*RENDER_MODES], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        robot: str = "mini_cheetah",
        task: str = "velocity",
        *,
        obs_mode: str = "vector",
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        **kwargs: Any,
    ) -> None:
        display = {"obs_mode": obs_mode, "render_mode": render_mode, "width": width, "height": height}
        super().__init__(robot, task, **display, **kwargs)
        self._attach(make_batch(robot, task, num_envs=1, **kwargs), task, display)
        self.observation_space, self.action_space = spaces(self.batch.program, obs_mode)
        self._names = [f"reward_{name}" for name in self.batch.program.reward_terms]
        self.metadata = {**self.metadata, "render_fps": round(1 / self.dt)}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode; see `gymnasium.Env.reset`. The same seed gives the same episodes.

        Raises:
            ValueError: The seed is not valid, or `options` is not empty.
        """
        check_options(options)
        keys = None if seed is None else self._keys(seed)
        with self._exclusive():
            gymnasium.Env.reset(self, seed=None if seed is None else int(seed))
            if keys is None and not self.batch.arrays["seeded"][0]:
                keys = self.np_random.integers(2**63, size=1)
            if keys is not None:
                self.batch.seed(keys)
            observation = self._observation(self.batch.reset(np.ones(1, bool))[0])
        self._screen.refresh()
        return observation, {"diverged": False, **self._base_motion()}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Carry out one control step; see `gymnasium.Env.step`.

        Raises:
            ValueError: The action has the wrong shape or is not finite.
            RuntimeError: Another thread steps or resets this environment.
            gymnasium.error.ClosedEnvironmentError: After `close`.
        """
        rows = checked_action(action, (1, self.batch.program.n_actions))
        with self._exclusive():
            outcome = self.batch.step(rows)
        diverged = bool(outcome.diverged[0])
        info = {"diverged": diverged, **dict(zip(self._names, outcome.terms[0].tolist(), strict=True))}
        info |= self._base_motion()
        observation = self._observation(outcome.observation[0])
        self._screen.refresh()
        return observation, float(outcome.reward[0]), bool(outcome.terminated[0]), diverged, info

    def render(self) -> Any:
        """Return a picture, uint8, shape (height, width, 3); None in other modes than "rgb_array"."""
        frames = self._screen.frames()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Release the resources of rendering. Repeated calls have no effect."""
        self.closed = True
        self._screen.close()

    def _base_motion(self) -> dict[str, float]:
        q, v = self.batch.first("q"), self.batch.first("v")
        (x, y), (w, i, j, k), (a, b, c) = q[:2], q[3:7], v[3:6]
        return {
            "x_position": x,
            "y_position": y,
            "distance_from_origin": math.hypot(x, y),
            "x_velocity": a * (1 - 2 * (j * j + k * k)) + 2 * b * (i * j - w * k) + 2 * c * (i * k + w * j),
            **{name: float(values[0]) for name, values in self.batch.curriculum().items()},
            "y_velocity": 2 * a * (i * j + w * k) + b * (1 - 2 * (i * i + k * k)) + 2 * c * (j * k - w * i),
        }

    def state(self) -> dict[str, NDArray]:
        """Return the recorded state: q, v, command, torque and, if computed, contact_forces (n_contacts, 3)."""
        return {name: rows[0] for name, rows in super().state().items()}
