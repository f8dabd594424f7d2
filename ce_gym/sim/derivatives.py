"""`StepDerivatives`: gradients through the steps of a simulator, and their linearisation.

One kernel makes the reverse mode of one sub-step: it repeats the iterations that the step needed and goes back through
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.compile import aligned_zeros
from ce_gym.dynamics.stepping.derivatives import primal_function, state_parts
from ce_gym.dynamics.stepping.methods import METHODS
from ce_gym.sim.derivative_kernels import load_gradient_kernel, load_linearization_kernel
from ce_gym.sim.simulator import Simulator


@dataclass
class Record:
    """One sub-step: the state before it, the target, and the positions and velocities after it."""

    arrays: dict[str, NDArray]
    target: NDArray
    after: tuple[NDArray, NDArray]


class StepDerivatives:
    """Derivatives of the steps of a simulator, in reverse mode.

    Positions are differentiated in their tangent space: a rotation of the base, a translation of it, both in base axes,
    then the joints. What was decided in a step (touching, sticking, slipping, a limit that acts) is differentiated as
    decided, through all iterations of the step. A robot that made a sub-step in parts (see `Simulator`) passes nothing
    on to what was before, like one that diverged.

    Args:
        simulator: Whose steps; on the CPU and on flat ground.

    Attributes:
        state_sizes: Of the tangent of each part of a state.
        n_recorded: How many sub-steps have been recorded.

    Raises:
        ValueError: If the simulator's steps cannot be differentiated.

    Examples:
        >>> model = ce_gym.Model("planar_leg_linkage")
        >>> sim = ce_gym.Simulator(model, num_envs=4)
        >>> derivatives = ce_gym.StepDerivatives(sim)
        >>> A, B = derivatives.linearize(model.standing_q)
        >>> print(A.shape, B.shape)
        (4, 4, 4) (4, 4, 2)
    """

    def __init__(self, simulator: Simulator) -> None:
        for unfit, why in (
            (simulator.device != "cpu", f"on device {simulator.device!r}; expected 'cpu'"),
            (simulator.terrain is not None, "on terrain; expected flat ground"),
        ):
            if unfit:
                raise ValueError(f"derivatives of a simulator {why}")
        self.simulator, self._records = simulator, list[Record]()
        primal = primal_function(simulator.model.mechanism, simulator.options)
        floating = simulator.model.robot.floating
        self._parts = state_parts(primal)
        self.state_sizes = {n: size - (1 if n == "q" and floating else 0) for n, size in self._parts.items()}
        others = {n: primal.numel_in(n) for n in ("target", "parameters") if n in primal.name_in()}
        ends = np.cumsum([0, *self.state_sizes.values(), *others.values()])
        names = [*self.state_sizes, *others]
        self._columns = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(names)}
        self._kernel = load_gradient_kernel(simulator.model, simulator.options, simulator.dtype)

    @property
    def n_recorded(self) -> int:
        """See above."""
        return len(self._records)

    def step(self, target: ArrayLike, n_substeps: int = 1) -> None:
        """Step the simulator, and record: the state before each sub-step is kept."""
        for _ in range(n_substeps):
            before = {name: _aligned_copy(self.simulator._arrays[name]) for name in self._kept}
            retries = self.simulator._arrays["retries"].copy()
            self.simulator.step(target, 1)
            before["diverged"][self.simulator._arrays["retries"] > retries] = 1  # made in parts, so not differentiated
            rows = self._target(target)
            self._records.append(Record(before, rows, (self.simulator.q, self.simulator.v)))

    def backward(self, weights: Mapping[str, ArrayLike]) -> tuple[dict[str, NDArray], list[NDArray], NDArray]:
        """Go back through all recorded sub-steps, and forget them.

        A robot that was reset or set in between, or diverged, passes nothing on to what was before.

        Args:
            weights: Gradient of something with respect to parts of the last state, shape (num_envs, size), see
                `state_sizes`; those left out are zero.

        Returns:
            Its gradient with respect to the first state, by part; to the target of each sub-step, first to last,
            (num_envs, n_targets) each; and to the declared parameters, (num_envs, n), in the order of declaration.
        """
        now = self._weights(weights)
        targets, parameters = [], np.zeros((self.simulator.num_envs, 0))
        later: Record | None = None
        for record in reversed(self._records):
            if later is not None:
                now = {name: self._unless_set(record, later, value) for name, value in now.items()}
            found = self._gradient(record.arrays, record.target, now)
            now = {name: found[name] for name in self.state_sizes}
            targets.append(found.get("target", np.zeros((self.simulator.num_envs, 0))))
            if "parameters" in found:
                parameters = found["parameters"] + (parameters if parameters.size else 0)
            later = record
        self._records.clear()
        return now, targets[::-1], parameters

    def gradient(self, target: ArrayLike, weights: Mapping[str, ArrayLike]) -> dict[str, NDArray]:
        """Return the gradient of one sub-step from the present state, which stays as it is.

        Args:
            target: As for `Simulator.step`.
            weights: Gradient of something with respect to parts of the state after it, as for `backward`.

        Returns:
            Its gradient with respect to each part of the state before, to "target" and to "parameters", if there are
            any, shape (num_envs, size) each.
        """
        return self._gradient(self.simulator._arrays, self._target(target), self._weights(weights))

    def linearize(self, target: ArrayLike) -> tuple[NDArray, NDArray]:
        """Return how one sub-step from the present state depends on that state and on the target.

        Args:
            target: As for `Simulator.step`.

        Returns:
            `A`, shape (num_envs, 2 nv, 2 nv), and `B`, shape (num_envs, 2 nv, n_targets), of the state [q; v] in the
            tangent space of positions.
        """
        simulator, nv = self.simulator, self.simulator.model.nv
        if not METHODS[simulator.options.method].is_euler:
            return self._linearize_by_rows(target)
        columns = np.empty((simulator.num_envs, 2 * nv + len(simulator.target_names), 2 * nv))
        every = {**simulator._arrays, "target": self._target(target), "ends": columns.reshape(simulator.num_envs, -1)}
        self._forward_kernel(every, simulator.num_envs, num_threads=simulator.num_threads)
        whole = columns.transpose(0, 2, 1)
        return whole[:, :, : 2 * nv], whole[:, :, 2 * nv :]

    def _linearize_by_rows(self, target: ArrayLike) -> tuple[NDArray, NDArray]:
        """Return the same row by row, in reverse mode, for any method."""
        nv, n = self.simulator.model.nv, self.simulator.num_envs
        A = np.zeros((n, 2 * nv, 2 * nv))
        B = np.zeros((n, 2 * nv, len(self.simulator.target_names)))
        for row in range(2 * nv):
            one = np.broadcast_to(np.eye(nv)[row % nv], (n, nv))
            found = self.gradient(target, {"q" if row < nv else "v": one})
            A[:, row] = np.hstack([found["q"], found["v"]])
            if "target" in found:
                B[:, row] = found["target"]
        return A, B

    @cached_property
    def _forward_kernel(self) -> Any:
        return load_linearization_kernel(self.simulator.model, self.simulator.options, self.simulator.dtype)

    @property
    def _kept(self) -> list[str]:
        return [name for name in self._kernel.buffers if name in self.simulator._arrays]

    def _target(self, target: ArrayLike) -> NDArray:
        shape = (self.simulator.num_envs, len(self.simulator.target_names))
        rows = np.asarray(target, self.simulator.dtype)
        if rows.shape not in (shape, shape[1:]):
            raise ValueError(f"target has shape {rows.shape}; expected {shape[1:]} or {shape}")
        return np.ascontiguousarray(np.broadcast_to(rows, shape))

    def _weights(self, weights: Mapping[str, ArrayLike]) -> dict[str, NDArray]:
        if unknown := set(weights) - set(self.state_sizes):
            raise ValueError(f"weights of {min(unknown)!r}; expected some of {', '.join(self.state_sizes)}")
        rows = {name: np.zeros((self.simulator.num_envs, size)) for name, size in self.state_sizes.items()}
        for name, value in weights.items():
            if np.shape(value) != rows[name].shape:
                raise ValueError(f"weights of {name!r} have shape {np.shape(value)}; expected {rows[name].shape}")
            rows[name] = np.array(value, float)
        return rows

    def _gradient(
        self, arrays: Mapping[str, NDArray], target: NDArray, weights: Mapping[str, NDArray]
    ) -> dict[str, NDArray]:
        simulator = self.simulator
        sums = np.zeros((simulator.num_envs, max(end.stop for end in self._columns.values())))
        given = {f"w_{name}": np.ascontiguousarray(value) for name, value in weights.items()}
        every = {**arrays, **given, "target": target, "sums": sums}
        self._kernel(every, simulator.num_envs, num_threads=simulator.num_threads)
        return {name: sums[:, columns] for name, columns in self._columns.items()}

    def _unless_set(self, record: Record, later: Record, value: NDArray) -> NDArray:
        """Return zeros for the robots that did not begin a sub-step where the one before had left them."""
        read = self.simulator._device.read
        began = [read(later.arrays[name], self.simulator.num_envs) for name in ("q", "v")]
        same = np.logical_and(*[(a == b).all(axis=1) for a, b in zip(began, record.after, strict=True)])
        return np.where(same[:, None], value, 0.0)


def _aligned_copy(array: NDArray) -> NDArray:
    copy = aligned_zeros(array.shape, array.dtype.name)
    copy[...] = array
    return copy
