"""`LeggedVectorEnv`: many robots as a native Gymnasium `VectorEnv`. May know batches and Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ce_gym.compile import CriticalSection
from ce_gym.envs.base import BatchShell
from ce_gym.envs.rendering import RENDER_MODES, Screen
from ce_gym.envs.runtime.batch import check_snapshot
from ce_gym.envs.runtime.setup import make_batch
from ce_gym.envs.single import checked_action, checked_seed, recorded_state, shown, spaces
from ce_gym.envs.task.checks import checked_value
from ce_gym.sim.devices import Device, device_named

Observations = NDArray[np.float32]


class LeggedVectorEnv(BatchShell, VectorEnv[Observations, NDArray[np.float32], NDArray[Any]]):
    """Many copies of one robot and one task, stepped by one kernel.

    Environment `i` of a batch seeded with `s` behaves as a single environment seeded with `s + i`, bit for bit,
    whatever the size of the batch and the number of threads. `infos` holds `diverged`, bool (num_envs,): environments
    whose simulation failed numerically; they are truncated at their last good state and reset alone; and
    `reward_terms`, the weighted terms of the rewards by name, each (num_envs,); with curricula `terrain_level` and
    `times_grown`, where each robot stands in them. Where an episode has ended,
    `infos["episode_terms"]` has its length, its return, the sum of every reward term and the mean of every metric (see
    `Task`).

    Attributes:
        n_diverged: How many episodes have ended so far because the simulation failed.

    Args:
        num_envs: Number of environments.
        max_episode_steps: Control steps until time is up; the task's own if None.
        autoreset_mode: When a finished environment starts again: "NextStep" (Gymnasium's default), "SameStep" or
            "Disabled", see `gymnasium.vector.AutoresetMode`.
        robot: Name of a robot that ships with the package, or a path to a robot file.
        task: Name of a task.
        obs_mode: "vector", or "dict" for `{"policy": ..., "critic": ...}`, where the critic may see more.
        render_mode: None; "rgb_array", for a picture of every environment; or "human", for a live page of the first.
        width: Of a picture [pixels].
        height: Of a picture [pixels].
        **kwargs: See `ce_gym.envs.runtime.setup.make_batch`.

    Raises:
        ValueError: If an argument is not one of the choices.
    """

    metadata: dict[str, Any] = {"render_modes": [*RENDER_MODES], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        robot: str = "mini_cheetah",
        task: str = "velocity",
        obs_mode: str = "vector",
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        **kwargs: Any,
    ) -> None:
        self.autoreset_mode = as_autoreset_mode(autoreset_mode)
        if max_episode_steps is not None:
            checked_value("max_episode_steps", max_episode_steps, 1)
        self.num_envs = num_envs
        self.batch = make_batch(robot, task, num_envs=num_envs, **kwargs)
        self.task = task
        program = self.batch.program
        self.model = program.model
        self.max_episode_steps = max_episode_steps or program.task.episode_length
        self.metadata = {
            **self.metadata,
            "autoreset_mode": self.autoreset_mode,
            "render_fps": round(1 / program.control_dt),
        }
        self.single_observation_space, self.single_action_space = spaces(program, obs_mode)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = render_mode
        self._screen = Screen(render_mode, self.batch, width=width, height=height)
        self.n_diverged = 0
        self._elapsed = np.zeros(num_envs, np.int64)
        self._finished = np.zeros(num_envs, bool)
        self._observation = np.zeros((num_envs, self.batch.observation_size), np.float32)
        self._seeded = False
        self._section = CriticalSection(self._title)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start new episodes; see `gymnasium.vector.VectorEnv.reset`.

        Args:
            seed: One number `s`, giving seeds s, s + 1, ..., or one for each environment.
            options: `reset_mask`, bool (num_envs,), resets only some environments.

        Raises:
            ValueError: If the mask or the list of seeds has the wrong shape.
        """
        mask = self._reset_mask(options)
        if seed is not None and (isinstance(seed, str) or not hasattr(seed, "__len__")):
            seed = checked_seed(seed)
        with self._changing():
            super().reset(seed=seed if isinstance(seed, int) else None)
            self._seed(seed)
            fresh = self.batch.reset(mask)
            self._observation = np.where(mask[:, None], fresh, self._observation)
            self._elapsed[mask] = 0
            self._finished[mask] = False
        self._screen.refresh()
        return self._shown(self._observation), {"diverged": np.zeros(self.num_envs, bool), **self.batch.progress()}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observations, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Carry out one control step; see `gymnasium.vector.VectorEnv.step`.

        Raises:
            ValueError: If the actions have the wrong shape or are not finite.
            gymnasium.error.ResetNeeded: In "Disabled" mode, if a finished environment has not been reset.
            RuntimeError: If another thread steps or resets these environments.
            gymnasium.error.ClosedEnvironmentError: After `close`.
        """
        rows = checked_action(actions, (self.num_envs, self.batch.program.n_actions))
        with self._changing():
            results = self._advance(rows)
        self._screen.refresh()
        return results

    def _advance(
        self, rows: NDArray[np.float32]
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Step with actions, shape (num_envs, n_actions), and reset whom it is time for; return what `step` does."""
        resetting = self._finished
        some_reset = bool(resetting.any())
        if some_reset and self.autoreset_mode == AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(
                f"{int(resetting.sum())} environments are finished; reset them with options={{'reset_mask': ...}}"
            )
        outcome = self.batch.step(rows, resetting if some_reset else None)
        self._elapsed += 1
        truncated = (self._elapsed >= self.max_episode_steps) | outcome.diverged
        terminated, reward, observation = outcome.terminated, outcome.reward, outcome.observation
        terms = dict(zip(self.batch.program.reward_terms, outcome.terms.T, strict=True))
        infos: dict[str, Any] = {"diverged": outcome.diverged, "reward_terms": terms}
        if some_reset:  # next-step mode: these environments ignore the action and show the first observation instead
            fresh = self.batch.reset(resetting)
            observation[resetting] = fresh[resetting]
            reward[resetting] = 0.0
            for flags in (terminated, truncated, outcome.diverged):
                flags[resetting] = False
            self._elapsed[resetting] = 0
        self.n_diverged += int(outcome.diverged.sum())
        done = terminated | truncated
        if done.any():
            infos["episode_terms"] = self._episode_terms(done)
            infos["_episode_terms"] = done
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                infos["final_obs"], infos["_final_obs"] = self._shown(observation), done.copy()
                infos["final_info"], infos["_final_info"] = {"diverged": outcome.diverged.copy()}, done.copy()
                fresh = self.batch.reset(done)
                observation[done] = fresh[done]
                self._elapsed[done] = 0
                done = np.zeros(self.num_envs, bool)
        self._finished = done
        self._observation = observation
        infos |= self.batch.progress()
        return self._shown(observation), reward, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of every environment, each uint8 (height, width, 3), or None if there are none."""
        return self._screen.frames()

    def close_extras(self, **kwargs: Any) -> None:
        """Give back whatever rendering holds; see `gymnasium.vector.VectorEnv.close`."""
        self._screen.close()

    def _shown(self, rows: NDArray[np.float32]) -> Any:
        """Return observations as the space has them, fresh arrays."""
        return shown(rows.copy(), self.batch.program, self.single_observation_space)

    def state(self) -> dict[str, NDArray]:
        """Return what a recorder needs, one robot per row; see `recorded_state`."""
        return recorded_state(self.batch)

    def snapshot(self) -> dict[str, NDArray]:
        """Return copies of the states of all environments, random streams included, by name; see `restore`."""
        return self.batch.snapshot() | {name: array.copy() for name, array in self._own_state().items()}

    def restore(self, snapshot: Mapping[str, NDArray]) -> None:
        """Go on from a snapshot, bit for bit, in this or another process.

        Raises:
            ValueError: If it is of another task or robot, of another dtype or of more or fewer environments; nothing
                has changed then.
        """
        own = self._own_state()
        check_snapshot(snapshot, own)
        self.batch.restore(snapshot)
        self._elapsed, self._finished, self._observation = (snapshot[name].copy() for name in own)
        self._seeded = True
        self._screen.refresh()

    def _own_state(self) -> dict[str, NDArray]:
        """What changes here, beside the batch."""
        return {"elapsed": self._elapsed, "finished": self._finished, "observation": self._observation}

    @property
    def elapsed_steps(self) -> NDArray[np.int64]:
        """Control steps since each episode began, by which time runs out, shape (num_envs,).

        Learners set it at random at first, so that episodes do not all end together; lengths and means that are
        reported of those first episodes count from there too.
        """
        return self._elapsed.copy()

    @elapsed_steps.setter
    def elapsed_steps(self, steps: NDArray[Any]) -> None:
        self._elapsed[:] = steps

    def set_command(self, command: NDArray[Any]) -> None:
        """Command velocities until the task draws new ones.

        Args:
            command: Forward [m/s], sideways [m/s], yaw rate [rad/s], shape (3,) or (num_envs, 3).

        Raises:
            ValueError: If the shape is wrong or a number is not finite.
        """
        given = np.asarray(command, float)
        if given.shape not in ((3,), (self.num_envs, 3)) or not np.isfinite(given).all():
            expected = f"(3,) or ({self.num_envs}, 3), finite"
            raise ValueError(f"command has shape {given.shape}; expected {expected}")
        self.batch.write("command", np.broadcast_to(given, (self.num_envs, 3)))

    def _episode_terms(self, done: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        """Length, sums of reward terms and means of metrics of the episodes that have just ended, zero elsewhere."""
        length = self._elapsed * done
        terms = self.batch.episode_sums(done)
        means = {key: sums / np.maximum(length, 1) for key, sums in terms.items() if key.startswith("metrics/")}
        return {"length": length, **terms, **means}

    def _reset_mask(self, options: dict[str, Any] | None) -> NDArray[np.bool_]:
        """Read, but do not take away, the mask: wrappers outside look at it too."""
        if not options or "reset_mask" not in options:
            return np.ones(self.num_envs, bool)
        mask = options["reset_mask"]
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            raise ValueError(
                f"reset_mask={mask!r}; expected a bool array of shape ({self.num_envs},) with a true entry"
            )
        return mask

    def _seed(self, seed: int | Sequence[int | None] | None) -> None:
        if seed is None:
            if not self._seeded:
                self.batch.seed(self.np_random.integers(2**63, size=self.num_envs).astype(np.uint64))
        elif isinstance(seed, int | np.integer):
            self.batch.seed(np.arange(seed, seed + self.num_envs).astype(np.uint64))
        else:
            if len(seed) != self.num_envs or any(s is None for s in seed):
                raise ValueError(f"seed has {len(seed)} entries; expected {self.num_envs} whole numbers")
            self.batch.seed(np.array([checked_seed(s) for s in seed], np.uint64))
        self._seeded = True


def make_vector_env(num_envs: int = 1, device: str | Device = "cpu", **kwargs: Any) -> VectorEnv:
    """Make the vector environment of a device; entry point of every registered id.

    Args:
        num_envs: Number of environments.
        device: "cpu" for `LeggedVectorEnv`, "cuda" or "cuda:N" for `ce_gym.envs.gpu_vector.GpuVectorEnv`.
        **kwargs: What that takes.

    Raises:
        ValueError: If there is no such device, or an argument is not one of the choices.
    """
    if device_named(device).name == "cpu":
        return LeggedVectorEnv(num_envs, **kwargs)
    from ce_gym.envs.gpu_vector import GpuVectorEnv

    return GpuVectorEnv(num_envs, device, **kwargs)


def as_autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """Return an autoreset mode given as itself, by name ("SAME_STEP") or by value ("SameStep").

    Raises:
        ValueError: If there is no such mode.
    """
    for known in AutoresetMode:
        if mode in (known, known.name, known.value):
            return known
    raise ValueError(f"autoreset_mode={mode!r}; expected one of {', '.join(str(m.value) for m in AutoresetMode)}")
