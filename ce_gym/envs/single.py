"""`LeggedEnv`: one robot as a Gymnasium `Env`, a batch of one. May know batches and Gymnasium."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from ce_gym.compile import CriticalSection
from ce_gym.envs.base import BatchShell
from ce_gym.envs.rendering import RENDER_MODES, Screen
from ce_gym.envs.runtime.program import OBSERVATION_BOUND, TaskProgram
from ce_gym.envs.runtime.setup import make_batch


class LeggedEnv(BatchShell, gymnasium.Env[NDArray[np.float32], NDArray[np.float32]], EzPickle):
    """One robot and one task.

    Observations and actions are float32 vectors; `observation_structure` names the blocks of the observation. `info`
    holds `diverged`, whether the simulation failed numerically: the episode is then truncated, at the last good state;
    `reward_<name>` for each reward term; and, as in Gymnasium's MuJoCo environments, `x_position`, `y_position`,
    `distance_from_origin` [m], `x_velocity` and `y_velocity` [m/s] of the base in the world.

    Attributes:
        n_diverged: How many episodes have ended so far because the simulation failed.

    Args:
        robot: Name of a robot that ships with the package, or a path to a robot file.
        task: Name of a task.
        obs_mode: "vector", or "dict" for `{"policy": ..., "critic": ...}`, where the critic may see more.
        render_mode: None; "rgb_array", for pictures as arrays; or "human", for a live page at this machine's loopback.
        width: Of a picture [pixels].
        height: Of a picture [pixels].
        **kwargs: See `ce_gym.envs.runtime.setup.make_batch`.
    """

    metadata: dict[str, Any] = {"render_modes": [*RENDER_MODES]}  # noqa: RUF012  (Gymnasium's own declaration)

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
        shown_as = {"obs_mode": obs_mode, "render_mode": render_mode, "width": width, "height": height}
        EzPickle.__init__(self, robot, task, **shown_as, **kwargs)
        self.batch = make_batch(robot, task, num_envs=1, **kwargs)
        self.task = task
        self.model = self.batch.program.model
        self.observation_space, self.action_space = spaces(self.batch.program, obs_mode)
        self._names = [f"reward_{name}" for name in self.batch.program.reward_terms]
        self.metadata = {**self.metadata, "render_fps": round(1 / self.dt)}
        self.render_mode = render_mode
        self._screen = Screen(render_mode, self.batch, width=width, height=height)
        self.n_diverged = 0
        self.closed = self._seeded = False
        self._section = CriticalSection(self._title)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode; see `gymnasium.Env.reset`. The same seed gives the same episodes, step by step."""
        with self._changing():
            super().reset(seed=seed)
            if seed is not None or not self._seeded:
                key = checked_seed(seed) if seed is not None else self.np_random.integers(2**63)
                self.batch.seed(np.array([key], np.uint64))
                self._seeded = True
            observation = self._shown(self.batch.reset(np.ones(1, bool)))[0]
        self._screen.refresh()
        return observation, {"diverged": False, **self._whereabouts()}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Carry out one control step; see `gymnasium.Env.step`.

        Raises:
            ValueError: If the action has the wrong shape or is not finite.
            RuntimeError: If another thread steps or resets this environment.
            gymnasium.error.ClosedEnvironmentError: After `close`.
        """
        rows = checked_action(action, (1, self.batch.program.n_actions))
        with self._changing():
            outcome = self.batch.step(rows)
            diverged = bool(outcome.diverged[0])
            self.n_diverged += diverged
        info = {"diverged": diverged, **dict(zip(self._names, outcome.terms[0].tolist(), strict=True))}
        info |= self._whereabouts()
        observation = self._shown(outcome.observation[0])
        self._screen.refresh()
        return observation, float(outcome.reward[0]), bool(outcome.terminated[0]), diverged, info

    def render(self) -> Any:
        """Return a picture, uint8, shape (height, width, 3), or None if there is none."""
        frames = self._screen.frames()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Give back whatever rendering holds; harmless if done before."""
        self.closed = True
        self._screen.close()

    def _shown(self, rows: NDArray[np.float32]) -> Any:
        return shown(rows, self.batch.program, self.observation_space)

    def _whereabouts(self) -> dict[str, float]:
        q, v = self.batch.first("q"), self.batch.first("v")
        (x, y), (w, i, j, k), (a, b, c) = q[:2], q[3:7], v[3:6]
        return {
            "x_position": x,
            "y_position": y,
            "distance_from_origin": math.hypot(x, y),
            "x_velocity": a * (1 - 2 * (j * j + k * k)) + 2 * b * (i * j - w * k) + 2 * c * (i * k + w * j),
            **{name: float(values[0]) for name, values in self.batch.progress().items()},
            "y_velocity": 2 * a * (i * j + w * k) + b * (1 - 2 * (i * i + k * k)) + 2 * c * (j * k - w * i),
        }

    def state(self) -> dict[str, NDArray]:
        """Return what a recorder needs: q, v, command, torque and, if computed, contact_forces (n_contacts, 3)."""
        return {name: rows[0] for name, rows in recorded_state(self.batch).items()}


def spaces(program: TaskProgram, obs_mode: str) -> tuple[Any, Any]:
    """Return observation and action space of one robot.

    Raises:
        ValueError: If the mode does not exist.
    """
    if obs_mode not in ("vector", "dict"):
        raise ValueError(f"obs_mode={obs_mode!r}; expected 'vector' or 'dict'")
    bound = OBSERVATION_BOUND
    policy = Box(-bound, bound, (program.observation_size,), np.float32)
    actions = Box(-1.0, 1.0, (program.n_actions,), np.float32)
    if obs_mode == "vector":
        return policy, actions
    critic = Box(-bound, bound, (program.critic_size or program.observation_size,), np.float32)
    return Dict({"policy": policy, "critic": critic}), actions


def shown(rows: NDArray[np.float32], program: TaskProgram, space: Any) -> Any:
    """Return observation rows (..., n_obs) as a space has them: the policy's part, or a dictionary of both."""
    policy = rows[..., : program.observation_size]
    if not isinstance(space, Dict):
        return policy if program.critic_size == 0 else np.ascontiguousarray(policy)
    critic = rows[..., program.observation_size :] if program.critic_size else policy
    return {"policy": np.ascontiguousarray(policy), "critic": critic.copy()}


def checked_action(action: Any, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return an action as contiguous float32 rows.

    Raises:
        ValueError: If it is not an array of numbers, its shape is wrong or it is not finite.
    """
    try:
        rows = np.asarray(action)
    except ValueError:  # lists of unequal lengths
        rows = np.empty(0, object)
    if rows.dtype.kind not in "fiu":
        raise ValueError(f"action is {_brief(action)}; expected an array of real numbers, such as float32")
    if rows.shape not in ((shape, shape[1:]) if shape[0] == 1 else (shape,)):
        raise ValueError(f"action has shape {np.shape(action)}; expected {shape if shape[0] > 1 else shape[1:]}")
    if not np.isfinite(rows).all():
        raise ValueError("action holds a number that is not finite")
    if rows.dtype != np.float32:
        rows = np.clip(rows, -1.0, 1.0)  # as the kernel does; a large number could not be converted
    return np.ascontiguousarray(rows, dtype=np.float32).reshape(shape)


def checked_seed(seed: Any) -> int:
    """Return a seed of one environment.

    Raises:
        ValueError: If it is not a whole number from 0 to 2**62.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed <= 2**62:
        raise ValueError(f"seed={seed!r}; expected a whole number from 0 to 2**62")
    return int(seed)


def _brief(value: Any) -> str:
    kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
    return kind if value is not None else "None"


def recorded_state(batch: Any) -> dict[str, NDArray]:
    """Return copies of a batch's state by name, one robot per row.

    q (n, nq); v (n, nv); command (n, 3); torque of the motors at the joints (n, n_joints) [N m]; and, if computed,
    contact_forces (n, n_contacts, 3) [N].
    """
    state = {name: batch.rows(name) for name in ("q", "v", "command", "torque")}
    if batch.program.contact_forces:
        state["contact_forces"] = batch.rows("contact_forces").reshape(batch.num_envs, -1, 3)
    return state
