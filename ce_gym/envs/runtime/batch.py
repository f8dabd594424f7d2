"""A batch of environments without Gymnasium: the state of a task's robots on a device, stepped and reset by kernels.

Single and vector environments wrap a batch, so a robot in a batch and a robot alone give the same numbers, bit for bit.
On a GPU a control step and the resets after it are one launch, because a query from the host would take as long as the
physics. On the CPU they are two kernels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ce_gym.compile import Program, source_fingerprint
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.stages import OUTCOME
from ce_gym.sim.batch import Batch, File, Snapshot
from ce_gym.sim.devices import Array, Device
from ce_gym.sim.kernel_key import laws_key, model_key

SOURCES = ("ce_gym.envs.runtime", "ce_gym.envs.task", "ce_gym.envs.terms")
"""Packages whose source traces a task, for the cache key of its kernels."""
CURRICULUM_INFO = {"level": "terrain_level", "grown": "times_grown"}
"""State of the curricula and the names that `info` has for it."""


@dataclass
class Outcome:
    """Results of a control step. All arrays are new except `ended`, which the next step overwrites.

    Attributes:
        observation: Observation of the policy, then of the critic, float32, shape (num_envs, n_obs); the first one of
            the next episode where that has begun.
        final_observation: Observation before any reset, same shape.
        reward: Rewards, float64, shape (num_envs,).
        terminated: Whether the robot has failed, shape (num_envs,).
        truncated: Whether time is up or the robot has diverged, shape (num_envs,).
        diverged: Whether the robot is frozen at its last good state, shape (num_envs,).
        done: Whether the episode is terminated or truncated, shape (num_envs,).
        terms: Weighted reward terms in the order of the task, shape (num_envs, n_terms).
        ended: Length, return and sums of episodes that have ended, else zero, shape (num_envs, 1 + n_sums).
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
        device: Device that holds the state and runs the kernels.
        num_threads: Threads that share the copies.
        max_episode_steps: Control steps until time is up.

    Attributes:
        fused: Whether each step resets the robots that are done.
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
        self._njit = self._compiled_terms()
        self._addresses = {name: function.address for name, function in self._njit.items()}
        key = f"{kernel_key(program)} {device.joint_space}"
        kind = "fused step" if self.fused else "environment"
        self._step_kernel = device.kernel(f"{kind} {key}", lambda: programs(program, device), dtype)
        self._reset_kernel = device.kernel(f"reset {key}", lambda: (program.reset_program(),), dtype)
        ended = device.zeros((num_envs, 1 + len(program.sum_names)), "float64")
        self._persistent = {name: self.arrays[name] for name in program.state_sizes} | self.tables | {"ended": ended}
        results = [b for b in self._step_kernel.buffers.values() if b.kind == "rows_out"]
        self._results = [(b.name, (num_envs, b.size), b.dtype) for b in results if b.name not in self._persistent]
        self.write("limit", max_episode_steps)
        curriculum = (*program.curriculum.sizes, "command", "clock") if program.curriculum.sizes else ()
        self._kept_if_ignored = (*curriculum, "failures")
        keys = self.arrays["keys"]
        self._streams = {"keys": keys if self.fused else keys.view(np.uint64), "counters": self.arrays["counters"]}

    def _compiled_terms(self) -> dict[str, Any]:
        """Return the C functions of the terms that are `@njit` functions, by key.

        Raises:
            ValueError: A function cannot be compiled or returns another type, or the device is a GPU.
        """
        program, functions = self.program, {}
        for term in program.njit_terms:
            if self.fused:
                expected = "device='cpu', or the term written with CasADi operations, see ce_gym.reward"
                given = f"an @njit function on device {self.place.name!r}"
                raise ValueError(f"{term.kind} term {term.name!r}: {given}; expected {expected}")
            shapes, function = program.stages.njit_shapes[term.key], cast("Any", term.function)
            functions[term.key] = function.compiled(shapes, term.parameters, self.dtype)
        return functions

    def _check_values(self, name: str, values: Array, exempt: Array) -> None:
        """Check the values of an `@njit` term, except for diverged robots and those that are reset next.

        Raises:
            ValueError: A value is not finite; one line.
        """
        wrong = np.flatnonzero(~(np.isfinite(values) | exempt))
        if wrong.size:
            kind, term = name.split("_", 1)
            place = f"{kind} term {term!r}: {values[wrong[0]]:g} for robot {wrong[0]}"
            raise ValueError(f"{place}; expected a finite number, and no exception in the function")

    def seed(self, keys: Array, mask: Array | None = None) -> None:
        """Restart random streams and curricula.

        Args:
            keys: Key of the random stream of each copy, int64 or uint64, shape (num_envs,).
            mask: Copies to seed, bool, shape (num_envs,); all if None.
        """
        self.write("keys", np.asarray(keys).view(np.int64), mask)
        self.write("counters", 0, mask)
        self.write("seeded", True, mask)
        for name in self.program.curriculum.sizes:
            self.write(name, 0.0, mask)

    def curriculum(self) -> dict[str, Array]:
        """Return the progress of each copy in the curricula of the task by name, each shape (num_envs,)."""
        return {key: self.rows(name)[:, 0] for name, key in CURRICULUM_INFO.items() if name in self.schema}

    def reset(self, mask: Array) -> Array:
        """Start new episodes where `mask` is true.

        Returns:
            Observations of all copies, shape (num_envs, n_obs).
        """
        self.write("chosen", mask[:, None])
        self.write("finished", False, mask)
        return self._reset(mask)

    def _reset(self, mask: Array) -> Array:
        self.n_changes += mask if isinstance(mask, np.ndarray) else True
        observation = self.place.copy(self.arrays["observation"])
        if self.fused:
            self._run(self._reset_kernel, {"observation": observation})
        else:  # a kernel of the CPU writes all rows of a tile, and does not advance the counters
            rows = np.empty_like(observation)
            self._run(self._reset_kernel, {"observation": rows})
            self.arrays["counters"] += mask
            observation[mask] = rows[mask]
        self.arrays["observation"] = observation
        return observation

    def step(self, action: Array, ignored: Array | None = None, autoreset: bool = False) -> Outcome:
        """Carry out one control step.

        Args:
            action: Shape (num_envs, n_actions), float32; clipped to [-1, 1].
            ignored: Copies that are reset next, shape (num_envs,). Their step changes neither their random stream nor
                their curriculum.
            autoreset: Whether to start the next episode of copies that are done; a fused step always does.
        """
        rows = {name: self.place.empty(shape, dtype) for name, shape, dtype in self._results}
        kept = {name: self.rows(name) for name in self._kept_if_ignored} if ignored is not None else {}
        self.n_changes += 1
        integers = {"n_substeps": self.program.task.n_substeps, **self._addresses}
        self._run(self._step_kernel, {**rows, "action_in": action}, integers)
        if not self.fused:
            self.arrays["counters"] += 1 if ignored is None else ~ignored
        for name, values in kept.items():
            self.write(name, values, ignored)
        outcome, n = rows["outcome"], len(OUTCOME)
        flags = (outcome[:, 1:n] > 0.5).T
        for name in self._njit:
            self._check_values(name, rows[name][:, 0], flags[2] if ignored is None else flags[2] | ignored)
        observation = final = self.arrays["observation"] = rows["observation"]
        if self.fused:
            final = rows["final_observation"]
        elif autoreset and flags[-1].any():
            observation = self._reset(flags[-1])
        results = (self.place.copy(outcome[:, 0]), *flags, outcome[:, n:], self._persistent["ended"])
        return Outcome(observation, final, *results)  # pyright: ignore[reportCallIssue]

    def first(self, name: str) -> list[float]:
        """Return a state buffer of the first copy as a list, without copying the other rows."""
        return self.arrays[name][0, :, 0].tolist()

    def restore(self, snapshot: Snapshot | File) -> None:
        """Continue from a snapshot; see `Batch.restore`."""
        self.arrays["observation"] = self.place.copy(self.arrays["observation"])  # a caller may hold the old one
        super().restore(snapshot)

    def _run(self, kernel: Any, arrays: dict[str, Array], repeats: Mapping[str, int] | None = None) -> None:
        kernel(self._persistent | arrays, self.num_envs, repeats=repeats, num_threads=self.num_threads, **self._streams)


def programs(program: TaskProgram, device: Device) -> tuple[Program, ...]:
    """Return the programs of one launch of a control step."""
    step = program.step_program(device.fuses, device.joint_space)
    return (step, program.reset_program()) if device.fuses else (step,)


def kernel_key(program: TaskProgram) -> str:
    """Return a text that identifies the kernels of a task on a robot, for the cache."""
    traced = f"{source_fingerprint(*SOURCES)} {model_key(program.model)} {program.stages.user_terms}"
    laws = laws_key(program.model.mechanism, program.options)
    return f"{traced} {program.task!r} {program.contact_forces} {program.options.hulls} {laws}"
