"""`GpuVectorEnv`: many robots on a GPU as a `VectorEnv` of torch tensors. May know GPU batches and Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ce_gym.compile import CriticalSection
from ce_gym.envs.base import BatchShell
from ce_gym.envs.runtime.gpu_batch import GpuBatch
from ce_gym.envs.runtime.setup import checked_dtype, make_program
from ce_gym.envs.single import checked_seed, recorded_state, spaces
from ce_gym.sim.devices import Device


class GpuVectorEnv(BatchShell, VectorEnv[Any, Any, Any]):
    """Many copies of one robot and one task on a GPU: actions in, observations and rewards out are its tensors.

    What `ce_gym.envs.vector.LeggedVectorEnv` is on the processor, with the same random streams from the same seeds, in
    SAME_STEP mode only. To leave the host out of it, `infos` always holds `episode_terms`, `final_obs` and
    `final_info`, with the masks of who is done beside them, and nothing is checked that would need waiting: actions
    that are not numbers count as 1.

    Args:
        num_envs: Number of environments.
        device: "cuda" or "cuda:N".
        max_episode_steps: Control steps until time is up; the task's own if None.
        autoreset_mode: "SameStep".
        robot: Name of a robot that ships with the package, or a path to a robot file.
        task: Name of a task.
        obs_mode: "vector", or "dict" for `{"policy": ..., "critic": ...}`, where the critic may see more.
        render_mode: None; robots on a GPU are recorded through `state()`.
        dtype: "float32" or "float64" for physics.
        **kwargs: See `ce_gym.envs.runtime.setup.make_program`.

    Raises:
        ValueError: If there is no such GPU, or an argument is not one of the choices; one line.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        device: str | Device = "cuda",
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        robot: str = "mini_cheetah",
        task: str = "velocity",
        obs_mode: str = "vector",
        render_mode: str | None = None,
        dtype: str = "float64",
        **kwargs: Any,
    ) -> None:
        same = AutoresetMode.SAME_STEP
        if autoreset_mode not in (same, same.name, same.value):
            raise ValueError(f"autoreset_mode={autoreset_mode!r}; expected {same.value!r} on device {device!r}")
        if render_mode is not None:
            raise ValueError(f"render_mode={render_mode!r}; expected None on device {device!r}")
        program = make_program(robot, task, **kwargs)
        self.max_episode_steps = max_episode_steps or program.task.episode_length
        self.batch: Any = GpuBatch(program, num_envs, checked_dtype(dtype), device, self.max_episode_steps)
        self.num_envs, self.task, self.model, self.autoreset_mode = num_envs, task, program.model, same
        self.device: torch.device = self.batch.device
        self.metadata = {**self.metadata, "render_fps": round(1 / program.control_dt)}
        self.single_observation_space, self.single_action_space = spaces(program, obs_mode)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = None
        self._observation = torch.zeros((num_envs, self.batch.observation_size), device=self.device)
        self._seeded = False
        self._section = CriticalSection(self._title)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; see `gymnasium.vector.VectorEnv.reset`.

        Args:
            seed: One number `s`, giving seeds s, s + 1, ..., or one for each environment.
            options: `reset_mask`, bool (num_envs,), a tensor or an array, resets only some environments.

        Raises:
            ValueError: If the mask or the list of seeds has the wrong shape.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        mask = torch.as_tensor((options or {}).get("reset_mask", np.ones(self.num_envs, bool)), device=self.device)
        if mask.shape != (self.num_envs,) or mask.dtype != torch.bool:
            raise ValueError(f"reset_mask has shape {tuple(mask.shape)}; expected bool, ({self.num_envs},)")
        with self._changing():
            if seed is not None or not self._seeded:
                self.batch.seed(self._keys(seed))
                self._seeded = True
            self._observation = self.batch.reset(mask, self._observation)
        return self._shown(self._observation), {"diverged": torch.zeros_like(mask), **self.batch.progress()}

    def step(self, actions: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Carry out one control step; see `gymnasium.vector.VectorEnv.step`. Returns before the GPU has finished.

        Raises:
            ValueError: If the actions have the wrong shape.
        """
        rows = torch.as_tensor(actions, dtype=torch.float32, device=self.device).detach().contiguous()
        expected = (self.num_envs, self.batch.program.n_actions)
        if tuple(rows.shape) != expected:
            raise ValueError(f"action has shape {tuple(rows.shape)}; expected {expected}")
        with self._changing():
            r = self.batch.step(rows)
            self._observation = r.observation
        length, *sums = r.ended.T
        terms = {"length": length, **dict(zip(self.batch.program.sum_names, sums, strict=True))}
        means = {name: total / length.clamp(min=1) for name, total in terms.items() if name.startswith("metrics/")}
        infos: dict[str, Any] = {
            "diverged": r.diverged,
            "reward_terms": dict(zip(self.batch.program.reward_terms, r.terms.T, strict=True)),
            "episode_terms": terms | means,
            "final_obs": self._shown(r.final_observation),
            "final_info": {"diverged": r.diverged},
            **self.batch.progress(),
        }
        infos |= dict.fromkeys(("_episode_terms", "_final_obs", "_final_info"), r.done)
        return self._shown(r.observation), r.reward, r.terminated, r.truncated, infos

    @property
    def n_diverged(self) -> int:
        """How many episodes have ended so far because the simulation failed; waits for the GPU."""
        return self.batch.n_diverged

    @property
    def elapsed_steps(self) -> torch.Tensor:
        """Control steps since each episode began, by which time runs out, int64, shape (num_envs,)."""
        return self.batch.elapsed.long()

    @elapsed_steps.setter
    def elapsed_steps(self, steps: Any) -> None:
        self.batch.elapsed.copy_(torch.as_tensor(steps, device=self.device))

    def state(self) -> dict[str, torch.Tensor]:
        """Return what a recorder needs: q, v, command and, if computed, contact_forces (num_envs, n_contacts, 3)."""
        state: dict[str, Any] = recorded_state(self.batch)
        return state

    def set_command(self, command: Any) -> None:
        """Command velocities until the task draws new ones.

        Args:
            command: Forward [m/s], sideways [m/s], yaw rate [rad/s], shape (3,) or (num_envs, 3).
        """
        self.batch.write("command", command)

    def _keys(self, seed: int | Sequence[int] | None) -> np.ndarray:
        if seed is None:
            return self.np_random.integers(2**63, size=self.num_envs).astype(np.uint64)
        if isinstance(seed, int | np.integer):
            return np.arange(checked_seed(seed), seed + self.num_envs).astype(np.uint64)
        if len(seed) != self.num_envs or any(s is None for s in seed):
            raise ValueError(f"seed has {len(seed)} entries; expected {self.num_envs} whole numbers")
        return np.array([checked_seed(s) for s in seed], np.uint64)

    def _shown(self, rows: torch.Tensor) -> Any:
        """Return observations as the space has them; views of tensors that no later step writes to."""
        program = self.batch.program
        policy = rows[:, : program.observation_size]
        if not hasattr(self.single_observation_space, "spaces"):
            return policy
        return {"policy": policy, "critic": rows[:, program.observation_size :] if program.critic_size else policy}
