"""A batch of environments without Gymnasium: state arrays, two kernels and random streams.

Both the single environment and the vector environment are thin shells over this, so that one lane of a batch and an
environment of its own are the same numbers, bit for bit. May know programs, compile and sim; no Gymnasium.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.compile import Kernel, load_kernel, source_fingerprint
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.task.terrain_tiles import make_field
from ce_gym.sim.kernel_key import laws_key, model_key
from ce_gym.sim.substeps import FRAME, HEIGHTS
from ce_gym.sim.tiles import read_rows, tiles, write_rows

SOURCES = ("ce_gym.envs.runtime", "ce_gym.envs.task", "ce_gym.envs.terms")
"""What traces a task, beside what traces a model, and makes programs of it."""
PROGRESS = {"level": "terrain_level", "grown": "times_grown"}
"""State of the curricula, and its names for those who watch."""


@dataclass
class Outcome:
    """What a control step leaves behind, fresh arrays.

    Attributes:
        observation: float32, the policy's and then the critic's, shape (num_envs, n_obs).
        reward: float64, shape (num_envs,).
        terminated: Failed, shape (num_envs,).
        diverged: Numerically diverged and frozen at the last good state, shape (num_envs,).
        terms: Weighted reward terms, in the order of the task, shape (num_envs, n_terms).
    """

    observation: NDArray[np.float32]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    diverged: NDArray[np.bool_]
    terms: NDArray[np.float64]


class Batch:
    """Many copies of one task on one robot.

    Args:
        program: The task on the robot.
        num_envs: Number of copies.
        dtype: "float64" or "float32" for state and arithmetic.
        num_threads: Threads the copies are split over.
    """

    def __init__(self, program: TaskProgram, num_envs: int, dtype: str, num_threads: int) -> None:
        self.program, self.num_envs, self.dtype, self.num_threads = program, num_envs, dtype, num_threads
        self._step, self._reset = _kernels(program, dtype)
        self.observation_size = self._step.buffers["observation"].size
        self._arrays = {name: tiles(num_envs, size, dtype) for name, size in program.state_sizes.items()}
        self._arrays["chosen"] = tiles(num_envs, 1, dtype)
        if program.ground:
            field = make_field(program.task.terrain)
            self._arrays[FRAME] = tiles(num_envs, 3, dtype)
            self._arrays[HEIGHTS] = field.heights.astype(dtype)
            write_rows(self._arrays[FRAME], [*field.origin, field.cell])
        self._judged = (*program.progress.sizes, "command", "clock") if program.progress.sizes else ()
        self.keys = np.zeros(num_envs, np.uint64)
        self._counters = np.zeros(num_envs, np.int64)

    def seed(self, keys: NDArray[np.uint64]) -> None:
        """Start the random streams and curricula of all copies anew, one key for each, shape (num_envs,)."""
        self.keys[:] = keys
        self._counters[:] = 0
        for name, size in self.program.progress.sizes.items():
            self.write(name, np.zeros((self.num_envs, size)))

    def progress(self) -> dict[str, NDArray]:
        """Return where the copies are in the curricula of the task, each shape (num_envs,)."""
        return {shown: self.rows(name)[:, 0] for name, shown in PROGRESS.items() if name in self._arrays}

    def reset(self, mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Start new episodes where `mask` is true.

        Returns:
            Observations, shape (num_envs, n_obs); rows outside the mask are undefined.
        """
        observation = np.empty((self.num_envs, self.observation_size), np.float32)
        write_rows(self._arrays["chosen"], mask[:, None].astype(self.dtype))
        arrays = self._arrays | {"observation": observation}
        self._reset(arrays, self.num_envs, keys=self.keys, counters=self._counters, num_threads=self.num_threads)
        self._counters += mask
        return observation

    def step(self, action: NDArray[np.float32], ignored: NDArray[np.bool_] | None = None) -> Outcome:
        """Carry out one control step.

        Args:
            action: Shape (num_envs, n_actions), finite; clipped to [-1, 1].
            ignored: Copies about to be reset, whose step must not use up random numbers nor count in a curriculum,
                shape (num_envs,).
        """
        judged = {name: self.rows(name) for name in self._judged} if ignored is not None else {}
        observation = np.empty((self.num_envs, self.observation_size), np.float32)
        outcome = np.empty((self.num_envs, 3 + len(self.program.reward_terms)))
        self._step(
            self._arrays | {"action_in": action, "observation": observation, "outcome": outcome},
            self.num_envs,
            repeats={"n_substeps": self.program.task.n_substeps},
            keys=self.keys,
            counters=self._counters,
            num_threads=self.num_threads,
        )
        self._counters += 1 if ignored is None else ~ignored
        for name, rows in judged.items():
            self.write(name, rows, ignored)
        flags = outcome[:, 1:3] > 0.5
        if flags[:, 1].any():  # whose state may have held anything when it was written, numbers that are none included
            outcome[flags[:, 1]] = _finite(outcome[flags[:, 1]])
        return Outcome(observation, outcome[:, 0].copy(), flags[:, 0].copy(), flags[:, 1].copy(), outcome[:, 3:])

    def rows(self, name: str) -> NDArray:
        """Return a copy of a state buffer, shape (num_envs, size); KeyError if there is none."""
        return read_rows(self._arrays[name], self.num_envs)

    def first(self, name: str) -> list[float]:
        """Return the values of the first copy in a state buffer, quickly."""
        return self._arrays[name][0, :, 0].tolist()

    def write(self, name: str, rows: NDArray, mask: NDArray[np.bool_] | None = None) -> None:
        """Overwrite a state buffer, for tests, evaluation and curricula; shape (num_envs, size)."""
        write_rows(self._arrays[name], rows, mask)

    def snapshot(self) -> dict[str, NDArray]:
        """Return copies of all that changes, by name, one environment per row; see `restore`."""
        return {name: self.rows(name) for name in self.program.state_sizes} | {
            "keys": self.keys.copy(),
            "counters": self._counters.copy(),
        }

    def restore(self, snapshot: Mapping[str, NDArray]) -> None:
        """Go on from a snapshot, bit for bit.

        Raises:
            ValueError: If it is of another task or robot, of another dtype or of more or fewer environments; nothing
                has changed then.
        """
        check_snapshot(snapshot, self.snapshot())
        for name in self.program.state_sizes:
            self.write(name, snapshot[name])
        self.keys[:], self._counters[:] = snapshot["keys"], snapshot["counters"]

    def episode_sums(self, mask: NDArray[np.bool_]) -> dict[str, NDArray[np.float64]]:
        """Return sums over the current episodes, zero outside the mask, each shape (num_envs,)."""
        lanes = self._arrays["sums"].shape[2]
        index = np.flatnonzero(mask)
        sums = np.zeros((self.num_envs, len(self.program.sum_names)))
        sums[index] = self._arrays["sums"][index // lanes, :, index % lanes]
        return dict(zip(self.program.sum_names, _finite(sums).T, strict=True))


def check_snapshot(snapshot: Mapping[str, NDArray], own: Mapping[str, NDArray]) -> None:
    """Raise ValueError unless a snapshot has all that an own one has, of the same shapes and types."""
    for name, array in own.items():
        given = snapshot.get(name)
        if given is None or (given.shape, given.dtype) != (array.shape, array.dtype):
            found = "nothing" if given is None else f"{given.dtype} {given.shape}"
            raise ValueError(f"snapshot: {name}: {found}; expected {array.dtype} {array.shape}")


def _finite(values: NDArray) -> NDArray:
    """Return values with 0 in place of what is not finite."""
    return np.where(np.isfinite(values), values, 0.0)


def kernel_key(program: TaskProgram) -> str:
    """Return a text that names everything that the kernels of a task on a robot depend on."""
    laws = laws_key(program.model.mechanism, program.options)
    traced = f"{source_fingerprint(*SOURCES)} {model_key(program.model)}"
    return f"{traced} {program.task!r} {program.contact_forces} {program.added_terms()} {laws}"


def _kernels(program: TaskProgram, dtype: str) -> tuple[Kernel, Kernel]:
    key = kernel_key(program)
    step = load_kernel(f"environment {key}", program.step_program, dtype)
    return step, load_kernel(f"reset {key}", program.reset_program, dtype)
