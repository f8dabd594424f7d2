"""A batch of environments without Gymnasium: the state of a task's robots on a device, stepped and reset by kernels.

Single and vector environments are thin over this, so that a lane of a batch and an environment of its own are the same
numbers, bit for bit. On a GPU a control step and the resets that follow are one launch, because a look from the host
would cost as much as the physics; on the CPU they are two kernels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ce_gym.compile import Program, source_fingerprint
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.stages import OUTCOME
from ce_gym.sim.batch import Batch, File, Snapshot
from ce_gym.sim.devices import Array, Device
from ce_gym.sim.kernel_key import laws_key, model_key

SOURCES = ("ce_gym.envs.runtime", "ce_gym.envs.task", "ce_gym.envs.terms")
"""What traces a task, beside what traces a model, and makes programs of it."""
SHOWN = {"level": "terrain_level", "grown": "times_grown"}
"""State of the curricula, and its names for those who watch."""


@dataclass
class Outcome:
    """What a control step leaves behind: fresh arrays, but for `ended`, which the next step overwrites.

    Attributes:
        observation: float32, the policy's and then the critic's, shape (num_envs, n_obs); the first of the next episode
            where one has begun.
        final_observation: The same before any reset.
        reward: float64, shape (num_envs,).
        terminated: Failed, shape (num_envs,).
        truncated: Time is up, or it has diverged.
        diverged: Frozen at the last good state.
        done: Terminated or truncated.
        terms: Weighted reward terms, in the order of the task, shape (num_envs, n_terms).
        ended: Length, return and sums of episodes that have ended, zero elsewhere, shape (num_envs, 1 + n_sums).
    """

    observation: Array
    final_observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    diverged: Array
    done: Array
    terms: Array
    ended: Array


class TaskBatch(Batch):
    """Many copies of one task on one robot.

    Args:
        program: The task on the robot.
        num_envs: Number of copies.
        dtype: "float64" or "float32" for state and arithmetic.
        device: Where they live.
        num_threads: Threads the copies are split over.
        max_episode_steps: Control steps until time is up.

    Attributes:
        fused: Whether a reset is part of each step.
    """

    def __init__(
        self,
        program: TaskProgram,
        num_envs: int,
        dtype: str,
        device: Device,
        num_threads: int = 1,
        max_episode_steps: float = math.inf,
    ) -> None:
        super().__init__(program.schema.values(), num_envs, dtype, device, program.field, num_threads)
        self.program, self.fused = program, device.fuses
        key = kernel_key(program)
        kind = "fused step" if self.fused else "environment"
        self._step = device.kernel(f"{kind} {key}", lambda: programs(program, self.fused), dtype)
        self._begin = device.kernel(f"reset {key}", lambda: (program.reset_program(),), dtype)
        ended = device.zeros((num_envs, 1 + len(program.sum_names)), "float64")
        self._fixed = {name: self.arrays[name] for name in program.state_sizes} | self.tables | {"ended": ended}
        out = [b for b in self._step.buffers.values() if b.kind == "rows_out" and b.name not in self._fixed]
        self._results = [(b.name, (num_envs, b.size), b.dtype) for b in out]
        self.write("limit", max_episode_steps)
        curriculum = (*program.curriculum.sizes, "command", "clock") if program.curriculum.sizes else ()
        self._carried = (*curriculum, "failures")
        keys = self.arrays["keys"]
        self._streams = {"keys": keys if self.fused else keys.view(np.uint64), "counters": self.arrays["counters"]}

    def seed(self, keys: Array, mask: Array | None = None) -> None:
        """Start random streams and curricula anew.

        Args:
            keys: One number for each copy, int64 or uint64, shape (num_envs,).
            mask: Which copies, bool, shape (num_envs,); all of them if None.
        """
        self.write("keys", np.asarray(keys).view(np.int64), mask)
        self.write("counters", 0, mask)
        self.write("seeded", True, mask)
        for name in self.program.curriculum.sizes:
            self.write(name, 0.0, mask)

    def curriculum(self) -> dict[str, Array]:
        """Return where the copies are in the curricula of the task, each shape (num_envs,)."""
        return {shown: self.rows(name)[:, 0] for name, shown in SHOWN.items() if name in self.schema}

    def reset(self, mask: Array) -> Array:
        """Start new episodes where `mask` is true.

        Returns:
            Observations of all copies, shape (num_envs, n_obs).
        """
        self.write("chosen", mask[:, None])
        self.write("finished", False, mask)
        return self._reset(mask)

    def _reset(self, mask: Array) -> Array:
        before = self.arrays["observation"]
        after = self.place.copy(before)
        if self.fused:
            self._run(self._begin, {"observation": after})
        else:  # a kernel of the CPU writes all rows of a tile, and leaves it to us to count
            rows = np.empty_like(before)
            self._run(self._begin, {"observation": rows})
            self.arrays["counters"] += mask
            after[mask] = rows[mask]
        self.arrays["observation"] = after
        return after

    def step(self, action: Array, ignored: Array | None = None, autoreset: bool = False) -> Outcome:
        """Carry out one control step.

        Args:
            action: Shape (num_envs, n_actions), float32; clipped to [-1, 1].
            ignored: Copies about to be reset, whose step must not use up random numbers nor count in a curriculum,
                shape (num_envs,).
            autoreset: Whether to begin the next episode of those that are done; a fused step always does.
        """
        rows = {name: self.place.empty(shape, dtype) for name, shape, dtype in self._results}
        carried = {name: self.rows(name) for name in self._carried} if ignored is not None else {}
        self._run(self._step, {**rows, "action_in": action}, {"n_substeps": self.program.task.n_substeps})
        if not self.fused:
            self.arrays["counters"] += 1 if ignored is None else ~ignored
        for name, values in carried.items():
            self.write(name, values, ignored)
        outcome, n = rows["outcome"], len(OUTCOME)
        flags = (outcome[:, 1:n] > 0.5).T
        observation = final = self.arrays["observation"] = rows["observation"]
        if self.fused:
            final = rows["final_observation"]
        elif autoreset and flags[-1].any():
            observation = self._reset(flags[-1])
        results = (self.place.copy(outcome[:, 0]), *flags, outcome[:, n:], self._fixed["ended"])
        return Outcome(observation, final, *results)  # pyright: ignore[reportCallIssue]

    def first(self, name: str) -> list[float]:
        """Return the values of the first copy in a state buffer, quickly."""
        return self.arrays[name][0, :, 0].tolist()

    def restore(self, snapshot: Snapshot | File) -> None:
        """Continue from a snapshot; see `Batch.restore`."""
        self.arrays["observation"] = self.place.copy(self.arrays["observation"])  # a caller may hold the old one
        super().restore(snapshot)

    def _run(self, kernel: Any, given: dict[str, Array], repeats: Mapping[str, int] | None = None) -> None:
        kernel(self._fixed | given, self.num_envs, repeats=repeats, num_threads=self.num_threads, **self._streams)


def programs(program: TaskProgram, fused: bool) -> tuple[Program, ...]:
    """Return what one launch of a control step consists of."""
    return (program.step_program(fused), program.reset_program()) if fused else (program.step_program(),)


def kernel_key(program: TaskProgram) -> str:
    """Return a text that names everything that the kernels of a task on a robot depend on."""
    traced = f"{source_fingerprint(*SOURCES)} {model_key(program.model)}"
    laws = laws_key(program.model.mechanism, program.options)
    return (
        f"{traced} {program.task!r} {program.contact_forces} {program.stages.user_terms} {program.options.hulls} {laws}"
    )
