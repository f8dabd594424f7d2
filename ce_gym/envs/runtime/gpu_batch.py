"""A batch of environments whose state, actions, observations and rewards stay on a GPU, as torch tensors.

One launch is a control step, the resets of who is done included. May know programs, rounds and sim; no Gymnasium.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ce_gym.envs.runtime.batch import PROGRESS, kernel_key
from ce_gym.envs.runtime.fused_step import FLAGS, OWN_STATE, reset_stage, round_stages
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.task.terrain_tiles import make_field
from ce_gym.sim.devices import Device, device_named
from ce_gym.sim.substeps import FRAME, HEIGHTS


@dataclass
class Round:
    """What a control step leaves behind, fresh tensors.

    Attributes:
        observation: float32, the policy's and then the critic's; the first of a new episode where one has begun,
            shape (num_envs, n_obs).
        final_observation: The same before any reset.
        reward: float64, shape (num_envs,).
        terminated, truncated, diverged, done: bool, shape (num_envs,).
        terms: Weighted reward terms, in the order of the task, shape (num_envs, n_terms).
        ended: Length, return and sums of episodes that have ended, zero elsewhere, shape (num_envs, 1 + n_sums).
    """

    observation: torch.Tensor
    final_observation: torch.Tensor
    reward: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    diverged: torch.Tensor
    done: torch.Tensor
    terms: torch.Tensor
    ended: torch.Tensor


class GpuBatch:
    """Many copies of one task on one robot.

    Args:
        program: The task on the robot.
        num_envs: Number of copies.
        dtype: "float64" or "float32" for state and arithmetic.
        device: "cuda" or "cuda:N".
        max_episode_steps: Control steps until time is up.

    Raises:
        ValueError: If there is no such GPU, or a package is missing; one line.
    """

    def __init__(
        self, program: TaskProgram, num_envs: int, dtype: str, device: str | Device, max_episode_steps: int
    ) -> None:
        self.program, self.num_envs, self.dtype = program, num_envs, dtype
        self._device = device_named(device)
        key = kernel_key(program)
        self._round = self._device.kernel(f"round {key}", lambda: round_stages(program), dtype)
        self._begin = self._device.kernel(f"begin {key}", lambda: (reset_stage(program),), dtype)
        self.observation_size = self._round.buffers["observation"].size
        sizes = program.state_sizes | dict.fromkeys(OWN_STATE, 1)
        self._arrays = {name: self._device.tiles(num_envs, size, dtype) for name, size in sizes.items()}
        self._arrays["limit"].fill_(max_episode_steps)
        if program.ground:
            field = make_field(program.task.terrain)
            self._arrays[FRAME] = self._device.tiles(num_envs, 3, dtype)
            self._arrays[HEIGHTS] = self._device.rows(field.heights.astype(dtype), dtype)
            self.write(FRAME, [*field.origin, field.cell])
        self.device: torch.device = self._arrays["q"].device
        self.keys = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self._counters = torch.zeros_like(self.keys)
        self._sizes = {b.name: b.size for b in self._round.buffers.values() if b.kind == "rows_out"}
        self._dtypes = {b.name: getattr(torch, b.dtype or dtype) for b in self._round.buffers.values()}

    def seed(self, keys: np.ndarray) -> None:
        """Start the random streams and curricula of all copies anew, one uint64 key for each, shape (num_envs,)."""
        self.keys.copy_(torch.from_numpy(np.asarray(keys, np.uint64).view(np.int64)))
        self._counters.zero_()
        for name in self.program.progress.sizes:
            self._arrays[name].zero_()

    def progress(self) -> dict[str, torch.Tensor]:
        """Return where the copies are in the curricula of the task, each shape (num_envs,)."""
        return {shown: self.rows(name)[:, 0] for name, shown in PROGRESS.items() if name in self._arrays}

    def reset(self, mask: torch.Tensor, observation: torch.Tensor) -> torch.Tensor:
        """Start new episodes where `mask` is true.

        Args:
            mask: bool, shape (num_envs,).
            observation: Present observations, float32, shape (num_envs, n_obs).

        Returns:
            A copy of them with those of the new episodes.
        """
        fresh = observation.clone()
        self._device.write(self._arrays["chosen"], mask[:, None])
        self._begin(self._arrays | {"observation": fresh}, self.num_envs, keys=self.keys, counters=self._counters)
        self.elapsed.masked_fill_(mask, 0)
        return fresh

    def step(self, action: torch.Tensor) -> Round:
        """Carry out one control step, and begin the next episode of who is done.

        Args:
            action: float32, shape (num_envs, n_actions); clipped to [-1, 1], what is not a number to 1.
        """
        rows = {
            name: torch.empty((self.num_envs, size), dtype=self._dtypes[name], device=self.device)
            for name, size in self._sizes.items()
        }
        self._round(
            self._arrays | rows | {"action_in": action},
            self.num_envs,
            repeats={"n_substeps": self.program.task.n_substeps},
            keys=self.keys,
            counters=self._counters,
        )
        outcome, flags = rows["outcome"], dict(zip(FLAGS, (rows["flags"] > 0.5).T, strict=True))
        return Round(
            rows["observation"],
            rows["final_observation"],
            outcome[:, 0],
            terms=outcome[:, 3:],
            ended=rows["ended"],
            **flags,
        )

    @property
    def elapsed(self) -> torch.Tensor:
        """Control steps since each episode began, the state itself, shape (num_envs,)."""
        return self._arrays["elapsed"][0, 0]

    @property
    def n_diverged(self) -> int:
        """How many episodes have ended because the simulation failed; waits for the GPU."""
        return int(self._arrays["failures"].sum())

    def rows(self, name: str) -> torch.Tensor:
        """Return a copy of a state buffer, shape (num_envs, size); KeyError if there is none."""
        return self._device.read(self._arrays[name], self.num_envs)

    def write(self, name: str, rows: Any, mask: Any = None) -> None:
        """Overwrite a state buffer, for tests, evaluation and curricula; shape (num_envs, size)."""
        self._device.write(self._arrays[name], rows, mask)
