"""`LeggedVectorEnv`: many robots as a native Gymnasium `VectorEnv`, on the CPU or on a GPU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ce_gym.envs.base import BaseEnv, check_options, checked_action, spaces
from ce_gym.envs.rendering import RENDER_MODES
from ce_gym.envs.runtime.batch import Outcome
from ce_gym.envs.runtime.setup import make_batch
from ce_gym.model.arguments import check_shape, check_whole
from ce_gym.sim.devices import Array, Device, device_named
from ce_gym.sim.inputs import check_kind, check_mask, finite_array, real_array


class LeggedVectorEnv(BaseEnv, VectorEnv[Any, Any, Any]):
    """Many copies of one robot and one task, stepped by one kernel.

    Environment `i` of a batch with seed `s` and a single environment with seed `s + i` agree bit for bit, for any
    number of environments and threads. `infos` has

    - `diverged`, bool (num_envs,): environments that failed numerically. They are truncated at their last good state.
    - `reward_terms`: the weighted reward terms by name, each (num_envs,).
    - `terrain_level` and `times_grown` of tasks with curricula: the progress of each robot.
    - `episode_terms` where an episode has ended: length, return, sum of each reward term, mean of each metric.
    - `final_obs` and `final_info` in mode SameStep where an episode has ended: the last observation, and all of the
      above with a mask `_<key>` for each key, as in Gymnasium's `SyncVectorEnv`.

    On a GPU, actions, observations and rewards are torch tensors on this GPU. The same seeds give the same random
    streams. To avoid synchronisation, the autoreset mode is SameStep, `infos` always has `episode_terms`, `final_obs`
    and `final_info` with their masks, and actions are not checked: NaN counts as 1. Record robots through `state()`;
    they are not rendered.

    Attributes:
        device: Device of actions and observations: "cpu", or a torch device.

    Args:
        num_envs: Number of environments.
        device: "cpu", or "cuda" or "cuda:N" for a GPU.
        max_episode_steps: Control steps until time is up; `episode_length` of the task if None.
        autoreset_mode: "NextStep" (default of Gymnasium), "SameStep" or "Disabled", see
            `gymnasium.vector.AutoresetMode`.
        robot, task, obs_mode, width, height: See `LeggedEnv`.
        render_mode: None; "rgb_array" for a picture of each environment; or "human" for a live page of the first one.
        **kwargs: See `ce_gym.envs.runtime.setup.make_batch`.

    Raises:
        ValueError: The device does not exist, or an argument is not valid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [*RENDER_MODES],
        "render_fps": 50,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        device: str | Device = "cpu",
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode | None = None,
        robot: str = "mini_cheetah",
        task: str = "velocity",
        obs_mode: str = "vector",
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        **kwargs: Any,
    ) -> None:
        arguments = {name: value for name, value in locals().items() if name not in ("self", "kwargs", "__class__")}
        super().__init__(**arguments, **kwargs)
        place = device_named(device)
        self.autoreset_mode = _autoreset_mode(autoreset_mode, place)
        if place.fuses and render_mode is not None:
            raise ValueError(f"render_mode={render_mode!r}; expected None on device {place.name!r}")
        if max_episode_steps is not None:
            check_whole("max_episode_steps", max_episode_steps, 1)
        self._attach(make_batch(robot, task, num_envs=num_envs, device=place, **kwargs), task, arguments)
        program, self.num_envs = self.batch.program, num_envs
        self.max_episode_steps = max_episode_steps or program.task.episode_length
        self.batch.write("limit", self.max_episode_steps)
        self.device = getattr(self.batch.arrays["q"], "device", "cpu")
        self.metadata = {
            "render_modes": [] if place.fuses else [*RENDER_MODES],
            "autoreset_mode": self.autoreset_mode,
            "render_fps": round(1 / program.control_dt),
        }
        self.single_observation_space, self.single_action_space = spaces(program, obs_mode)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; see `gymnasium.vector.VectorEnv.reset`.

        Args:
            seed: A seed `s` for the seeds s, s + 1, ..., or one seed for each environment.
            options: `reset_mask`, bool (num_envs,): environments to reset and seed.

        Raises:
            ValueError: The mask or the list of seeds has the wrong shape, or an option does not exist.
        """
        batch, mask = self.batch, self._reset_mask(options)
        keys, to_seed = None if seed is None else self._keys(seed), mask
        with self._exclusive():
            VectorEnv.reset(self, seed=int(seed) if isinstance(seed, int | np.integer) else None)
            if keys is None and (to_seed := mask & ~batch.arrays["seeded"]).any():
                keys = self.np_random.integers(2**63, size=self.num_envs)
            if keys is not None:
                batch.seed(keys, to_seed)
            observation = batch.reset(mask)
        self._screen.refresh()
        diverged = batch.place.zeros((self.num_envs,), "bool")
        return self._observation(observation), {"diverged": diverged, **batch.curriculum()}

    def step(self, actions: Any) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Carry out one control step; see `gymnasium.vector.VectorEnv.step`. A GPU may still run when this returns.

        Raises:
            ValueError: The actions have the wrong shape or, on the CPU, are not finite.
            gymnasium.error.ResetNeeded: In mode "Disabled", a finished environment has not been reset.
            RuntimeError: Another thread steps or resets these environments.
            gymnasium.error.ClosedEnvironmentError: After `close`.
        """
        rows = self._checked(actions)
        with self._exclusive():
            outcome, infos = self._advance(rows)
        self._screen.refresh()
        return self._observation(outcome.observation), outcome.reward, outcome.terminated, outcome.truncated, infos

    def _advance(self, rows: Array) -> tuple[Outcome, dict[str, Any]]:
        """Step with actions, shape (num_envs, n_actions), and reset finished environments according to the mode."""
        batch, same_step = self.batch, self.autoreset_mode == AutoresetMode.SAME_STEP
        ignored = None
        if not same_step and batch.arrays["finished"].any():
            ignored = batch.rows("finished")
            if self.autoreset_mode == AutoresetMode.DISABLED:
                advice = "reset them with options={'reset_mask': ...}"
                raise gymnasium.error.ResetNeeded(f"{int(ignored.sum())} environments are finished; {advice}")
        o = batch.step(rows, ignored, same_step)
        if ignored is not None:  # mode NextStep: a reset replaces the step of these environments
            o.observation = batch.reset(ignored)
            o.reward[ignored] = 0.0
            o.ended[ignored] = 0.0
            for flags in (o.terminated, o.truncated, o.diverged, o.done):
                flags[ignored] = False
        if not same_step:
            batch.write("finished", o.done)
        infos = {
            "diverged": o.diverged,
            "reward_terms": dict(zip(batch.program.reward_terms, o.terms.T, strict=True)),
            **batch.curriculum(),
        }
        if batch.fused or o.done.any():
            infos["episode_terms"], infos["_episode_terms"] = self._episode_terms(o), o.done
            if same_step:
                infos["final_obs"], infos["_final_obs"] = self._observation(o.final_observation), o.done
                final = {name: infos[name] for name in infos if not name.startswith(("_", "final_"))}
                infos["final_info"], infos["_final_info"] = _masked(final, o.done), o.done
        return o, infos

    def _episode_terms(self, outcome: Outcome) -> dict[str, Array]:
        """Return length, sums of reward terms and means of metrics of episodes that have just ended, else zero."""
        length, *sums = self.batch.place.copy(outcome.ended).T
        terms = dict(zip(self.batch.program.sum_names, sums, strict=True))
        means = {name: total / length.clip(min=1) for name, total in terms.items() if name.startswith("metrics/")}
        return {"length": length, **terms, **means}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each environment, uint8 (height, width, 3); None in other modes than "rgb_array"."""
        return self._screen.frames()

    def close_extras(self, **kwargs: Any) -> None:
        """Release the resources of rendering; see `gymnasium.vector.VectorEnv.close`."""
        self._screen.close()

    @property
    def elapsed_steps(self) -> Array:
        """Control steps since each episode began, by which time runs out, int64, shape (num_envs,).

        Learners set random values at first, so that episodes do not all end together. Reported lengths and means of
        the first episodes count from these values.
        """
        return self.batch.place.rows(self.batch.rows("elapsed")[:, 0], "int64")

    @elapsed_steps.setter
    def elapsed_steps(self, steps: Any) -> None:
        rows = np.broadcast_to(finite_array("elapsed_steps", steps, self.batch.dtype, (), (n := self.num_envs,)), n)
        if (wrong := rows[(rows < 0) | (rows != np.floor(rows))]).size:
            raise ValueError(f"elapsed_steps holds {wrong[0]:g}; expected whole numbers, 0 or more")
        with self._exclusive():
            self.batch.write("elapsed", rows[:, None])

    def _checked(self, actions: Any) -> Array:
        shape = (self.num_envs, self.batch.program.n_actions)
        if not self.batch.fused:
            return checked_action(actions, shape)
        if getattr(actions, "is_cuda", False):
            check_kind("action", actions)
        else:
            actions = real_array("action", actions)
        check_shape("action", actions, shape)
        return self.batch.place.rows(actions, "float32").detach()

    def _reset_mask(self, options: dict[str, Any] | None) -> Array:
        """Return the mask of `options`, which stays there for wrappers."""
        check_options(options, ("reset_mask",))
        place, n = self.batch.place, self.num_envs
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return place.rows(True, "bool", (n,))
        return place.rows(check_mask("reset_mask", mask, n, some=True), "bool")


def _masked(infos: Mapping[str, Any], mask: Array) -> dict[str, Any]:
    """Return a copy of `infos` with zeros where the mask is false, and with the mask as `_<key>` of each key."""
    masked = {}
    for key, value in infos.items():
        masked[key] = _masked(value, mask) if isinstance(value, Mapping) else value * mask
        masked[f"_{key}"] = mask
    return masked


def _autoreset_mode(mode: str | AutoresetMode | None, place: Device) -> AutoresetMode:
    """Return the autoreset mode for a mode, its name ("SAME_STEP"), its value ("SameStep") or None.

    Raises:
        ValueError: The mode does not exist, or not on this device.
    """
    default = AutoresetMode.SAME_STEP if place.fuses else AutoresetMode.NEXT_STEP
    supported = (AutoresetMode.SAME_STEP,) if place.fuses else tuple(AutoresetMode)
    for known in supported:
        if (default if mode is None else mode) in (known, known.name, known.value):
            return known
    expected = ", ".join(repr(known.value) for known in supported)
    expected += f" on device {place.name!r}" if place.fuses else ""
    raise ValueError(f"autoreset_mode={mode!r}; expected one of {expected}")
