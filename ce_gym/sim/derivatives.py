"""`StepDerivatives`: gradients through the steps of a simulator, and their linearisation.

One kernel computes the reverse mode of one sub-step: it repeats the iterations of the step and differentiates them.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.compile import aligned_copy
from ce_gym.dynamics.algebra.batched import call_on_batch
from ce_gym.dynamics.algebra.tracing import output_names
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import MOVED
from ce_gym.dynamics.stepping.derivatives import adjoint_weights, input_gradients, primal_function, state_parts
from ce_gym.dynamics.stepping.halving import PART, subdivide_function
from ce_gym.dynamics.stepping.linearization import REMEMBERED
from ce_gym.dynamics.stepping.variables import LEFT, RETRIES, StepVariables
from ce_gym.model.arguments import check_whole
from ce_gym.model.errors import check_names
from ce_gym.sim.derivative_kernels import load_gradient_kernel, load_linearization_kernel
from ce_gym.sim.inputs import finite_array
from ce_gym.sim.simulator import Simulator
from ce_gym.sim.substeps import DT, TIMES, load_step_kernel
from ce_gym.sim.tiles import read_rows, tiles, write_rows


@dataclass
class Record:
    """Consecutive sub-steps.

    Attributes:
        arrays: State before the first sub-step.
        kept: For each part of the state, robots that started from the end of the previous record, shape (num_envs,).
        targets: Target of each sub-step.
        after: For each part of the state its version after the last sub-step, see `Batch.version`.
        in_parts: For each sub-step the robots that halved it, shape (num_envs,); None if no robot did.
    """

    arrays: dict[str, NDArray]
    kept: dict[str, NDArray[np.bool_]]
    targets: list[NDArray] = field(default_factory=list)
    after: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    in_parts: list[NDArray | None] = field(default_factory=list)


class StepDerivatives:
    """Derivatives of the steps of a simulator, in reverse mode.

    Positions are differentiated in their tangent space: rotation and translation of the base, both in base axes,
    rotations of ball joints, then the other joints. Decisions of a step (touching, sticking, slipping, an active limit)
    are differentiated as decided, through all iterations of the step.

    On terrain the ground under a contact is the plane that the step found there. If a robot halved a sub-step (see
    `Simulator`), `backward` goes through its parts, whose lengths count as constant. `gradient` and `linearize` always
    differentiate a whole sub-step.

    Args:
        simulator: The simulator, on the CPU.
        keep_every: Number of recorded sub-steps per stored state. `backward` recomputes the states between, which takes
            a step each.

    Attributes:
        state_sizes: Sizes of the tangent space of each part of a state.
        n_recorded: Number of recorded sub-steps.
        bytes_recorded: Memory of the record.

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

    def __init__(self, simulator: Simulator, keep_every: int = 1) -> None:
        if simulator.device != "cpu":
            raise ValueError(f"derivatives of a simulator on device {simulator.device!r}; expected 'cpu'")
        if simulator.controlled:
            raise ValueError("derivatives of a simulator with a controller; expected one without")
        check_whole("keep_every", keep_every, 1)
        self.simulator, self._records = simulator, list[Record]()
        self._keep_every, self._linear = keep_every, dict[bool, Any]()
        primal = primal_function(simulator.model.mechanism, simulator.options)
        self._parts = state_parts(primal)
        self._weight_variables = adjoint_weights(primal, simulator.model.robot.layout)
        self._input_gradients = input_gradients(primal)
        self.state_sizes = {name: variable.size for name, variable in self._weight_variables.items()}
        self._other_sizes = {name: variable.size for name, variable in self._input_gradients.items()}

    def __reduce__(self) -> tuple[Any, ...]:
        left = self._where_left(self._records[-1]) if self._records else {}
        return _copied, (self.simulator, self._keep_every, self._records, left)

    def __copy__(self) -> StepDerivatives:
        return copy.deepcopy(self)  # of the simulator and the record, too

    @property
    def n_recorded(self) -> int:
        """See above."""
        return sum(len(record.targets) for record in self._records)

    @property
    def bytes_recorded(self) -> int:
        """See above."""
        held = [[*one.arrays.values(), *one.after.values(), *one.targets] for one in self._records]
        return sum({id(array): array.nbytes for arrays in held for array in arrays}.values())

    def step(self, target: ArrayLike, n_substeps: int = 1) -> None:
        """Step the simulator as `Simulator.step` does, and record the sub-steps."""
        simulator, rows = self.simulator, self._target(target)
        for _ in range(n_substeps):
            last = self._records[-1] if self._records else None
            if last is None or len(last.targets) >= self._keep_every or not self._is_as_left(last):
                arrays = {name: aligned_copy(simulator._arrays[name]) for name in self._kept}
                self._records.append(Record(arrays, {} if last is None else self._where_left(last)))
            retries = simulator._batch.rows("retries")
            simulator.step(rows, 1)
            record = self._records[-1]
            record.targets.append(rows)
            record.after = self._versions()
            parts = (simulator._batch.rows("retries") > retries).reshape(simulator.num_envs)
            record.in_parts.append(parts if parts.any() else None)

    def state(self) -> dict[str, NDArray]:
        """Return the state that steps depend on, without targets and parameters, by part, shape (num_envs, size)."""
        return {name: self.simulator._batch.rows(name) for name in self._parts}

    def restore(self, state: Mapping[str, ArrayLike]) -> None:
        """Set parts of the state, and clear divergence; other parts do not change.

        Quaternions whose norm is within 1e-3 of 1 are scaled to unit length.

        Args:
            state: Some of the parts of `state`, shape (num_envs, size) each.

        Raises:
            ValueError: If a part does not exist, a shape is wrong, or a number is not finite or no unit quaternion.
        """
        batch = self.simulator._batch
        check_names("state", state, self._parts, "one of")
        checked = {}
        for name, rows in state.items():
            shape = batch.num_envs, batch.schema[name].size
            checked[name] = batch.unit(name, finite_array(name, rows, batch.dtype, shape))
        for name, rows in checked.items():
            batch.write(name, rows)
        batch.write("diverged", 0.0)

    def take(self) -> list[Record]:
        """Return the recorded sub-steps, and start a new record."""
        records, self._records = self._records, []
        return records

    def backward(
        self, weights: Mapping[str, ArrayLike], records: list[Record] | None = None
    ) -> tuple[dict[str, NDArray], list[NDArray], NDArray]:
        """Propagate a gradient back through all recorded sub-steps, and delete the record.

        The gradient of a robot stops where the robot was reset or set, was stepped without a record, or diverged. Where
        only parts of its state were set, by `restore`, it stops for these parts.

        Args:
            weights: Gradient of a quantity with respect to parts of the last state, shape (num_envs, size), see
                `state_sizes`; zero for other parts.
            records: Result of `take`, used in place of the record and not deleted.

        Returns:
            The gradient with respect to the first state, by part; to the target of each sub-step, first to last,
            (num_envs, n_targets) each; and to the declared parameters, (num_envs, n), in the order of declaration.
        """
        simulator, records = self.simulator, self.take() if records is None else records
        n, parameters = simulator.num_envs, np.zeros((simulator.num_envs, self._size("parameters")))
        now = _in_tiles(self._weights(weights), simulator.dtype)
        targets = np.empty((sum(len(record.targets) for record in records), n, self._size("target")))
        at, others = len(targets), {"parameters": parameters.copy()}
        for record in reversed(records):
            for (arrays, target), parts in zip(reversed(self._states(record)), reversed(record.in_parts), strict=True):
                at -= 1
                others["target"] = targets[at]
                after = None if parts is None else self._rows(now, n)
                self._go_back(arrays, target, now, others)
                if parts is not None and after is not None:
                    for name, rows in self._through_parts(arrays, target, after, parts).items():
                        _overwrite((now | others)[name], rows, parts)
                parameters += others["parameters"]
            for name, kept in record.kept.items():
                if not kept.all():
                    write_rows(now[name], 0.0, ~kept)
        return self._rows(now, n), list(targets), parameters

    def gradient(self, target: ArrayLike, weights: Mapping[str, ArrayLike]) -> dict[str, NDArray]:
        """Return the gradient of one sub-step from the present state, without a step.

        Args:
            target: As for `Simulator.step`.
            weights: Gradient of a quantity with respect to parts of the state after the sub-step, as for `backward`.

        Returns:
            The gradient with respect to each part of the state before, to "target" and to "parameters", as far as they
            exist, shape (num_envs, size) each.
        """
        return self._gradient(self.simulator._arrays, self._target(target), self._weights(weights))

    def linearize(self, target: ArrayLike, whole_state: bool = False, by_rows: bool = False) -> tuple[NDArray, NDArray]:
        """Return the Jacobian of one sub-step from the present state with respect to the state and the target.

        Args:
            target: As for `Simulator.step`.
            whole_state: Whether the state is [q; v; load; anchor], as far as the scene has them, instead of [q; v].
                Contacts remember load and anchor, so that only whole states can be chained over steps in contact.
            by_rows: Whether to use the kernel of the reverse mode, row by row, which is slower than the kernel of
                columns and compiles faster. Methods other than `euler` always do so.

        Returns:
            `A`, shape (num_envs, n, n), and `B`, shape (num_envs, n, n_targets), in the tangent space of positions; n
            is 2 nv, plus the sizes of load and anchor for the whole state.
        """
        simulator, sizes = self.simulator, self._linear_sizes(whole_state)
        options = simulator.options
        if by_rows or options.self_collisions or not METHODS[options.method].is_euler:
            return self._linearize_by_rows(target, whole_state)
        n = sum(sizes.values())
        columns = np.empty((simulator.num_envs, n + len(simulator.target_names), n))
        every = {**simulator._arrays, **simulator._batch.tables, "target": self._target(target)}
        every |= {"ends": columns.reshape(simulator.num_envs, -1)}
        self._forward_kernels(whole_state)(every, simulator.num_envs, num_threads=simulator.num_threads)
        whole = columns.transpose(0, 2, 1)
        return whole[:, :, :n], whole[:, :, n:]

    def _linear_sizes(self, whole_state: bool) -> dict[str, int]:
        remembered = REMEMBERED if whole_state else ()
        return {name: n for name, n in self.state_sizes.items() if name in ("q", "v", *remembered)}

    def _linearize_by_rows(self, target: ArrayLike, whole_state: bool = False) -> tuple[NDArray, NDArray]:
        """Return the Jacobian row by row, in reverse mode, for any method and for scenes with self-collisions."""
        n, sizes = self.simulator.num_envs, self._linear_sizes(whole_state)
        A, B = list[NDArray](), list[NDArray]()
        for name, size in sizes.items():
            for row in np.eye(size):
                found = self.gradient(target, {name: np.broadcast_to(row, (n, size))})
                A.append(np.hstack([found[part] for part in sizes]))
                B.append(found.get("target", np.zeros((n, 0))))
        return np.stack(A, axis=1), np.stack(B, axis=1)

    def _through_parts(
        self, arrays: Mapping[str, NDArray], target: NDArray, weights: Mapping[str, NDArray], chosen: NDArray
    ) -> dict[str, NDArray]:
        """Return the gradient of a sub-step for robots that halved the sub-step."""
        rows = {name: read_rows(array, self.simulator.num_envs)[chosen] for name, array in arrays.items()}
        target, now = target[chosen], {name: value[chosen] for name, value in weights.items()}
        others = {name: np.zeros((len(target), size)) for name, size in self._other_sizes.items()}
        for part in reversed(_parts_of(self.simulator, rows, target)):
            found, taken = self._gradient(part.arrays, target, now), part.taken[:, None]
            now = {name: np.where(taken, found[name], value) for name, value in now.items()}
            others = {name: value + np.where(taken, found[name], 0.0) for name, value in others.items()}
        return now | others

    def _size(self, name: str) -> int:
        return self._other_sizes.get(name, 0)

    @cached_property
    def _kernel(self) -> Any:
        return load_gradient_kernel(self.simulator.model, self.simulator.options, self.simulator.dtype)

    def _forward_kernels(self, whole_state: bool) -> Any:
        if whole_state not in self._linear:
            simulator = self.simulator
            given = simulator.model, simulator.options, simulator.dtype
            self._linear[whole_state] = load_linearization_kernel(*given, whole_state)
        return self._linear[whole_state]

    @property
    def _kept(self) -> list[str]:
        return [name for name in self._kernel.buffers if name in self.simulator._arrays]

    def _target(self, target: ArrayLike) -> NDArray:
        return self.simulator._checked_target(target)

    def _weights(self, weights: Mapping[str, ArrayLike]) -> dict[str, NDArray]:
        if unknown := set(weights) - set(self.state_sizes):
            raise ValueError(f"weights of {min(unknown)!r}; expected some of {', '.join(self.state_sizes)}")
        rows = {name: np.zeros((self.simulator.num_envs, size)) for name, size in self.state_sizes.items()}
        for name, value in weights.items():
            rows[name] = finite_array(f"weights[{name!r}]", value, "float64", rows[name].shape)
        return rows

    def _gradient(
        self, arrays: Mapping[str, NDArray], target: NDArray, weights: Mapping[str, NDArray]
    ) -> dict[str, NDArray]:
        n, now = len(target), _in_tiles(dict(weights), self.simulator.dtype)
        others = {name: np.zeros((n, size)) for name, size in self._other_sizes.items()}
        self._go_back(arrays, target, now, others)
        return self._rows(now, n) | others

    def _go_back(
        self, arrays: Mapping[str, NDArray], target: NDArray, now: dict[str, NDArray], others: dict[str, NDArray]
    ) -> None:
        """Overwrite the gradient after a sub-step, in tiles, by the gradient before, and write that of `others`."""
        gradients = self._weight_variables.named(now)
        gradients |= self._input_gradients.named({name: others[name] for name in self._input_gradients})
        every = {**arrays, **gradients, **self.simulator._batch.tables, "target": target}
        self._kernel(every, len(target), num_threads=self.simulator.num_threads)

    def _rows(self, now: dict[str, NDArray], n: int) -> dict[str, NDArray]:
        return {name: read_rows(array, n).astype(float, copy=False) for name, array in now.items()}

    def _is_as_left(self, record: Record) -> bool:
        """Return whether robots and their parameters have not been set since the record."""
        now = self.simulator._arrays
        figures = np.array_equal(now["parameters"], record.arrays["parameters"]) if "parameters" in now else True
        return figures and all(kept.all() for kept in self._where_left(record).values())

    def _where_left(self, record: Record) -> dict[str, NDArray[np.bool_]]:
        """Return for each part of the state which robots are at the end of a record, shape (num_envs,)."""
        return {name: version == record.after[name] for name, version in self._versions().items()}

    def _versions(self) -> dict[str, NDArray[np.int64]]:
        return {name: self.simulator._batch.version(name) for name in self._parts}

    def _states(self, record: Record) -> list[tuple[dict[str, NDArray], NDArray]]:
        """Return the state before each sub-step of a record and its target; all states but the first are recomputed."""
        states = [(record.arrays, record.targets[0])]
        for target in record.targets[1:]:
            states.append((self._stepped(states[-1][0], states[-1][1]), target))
        return states

    def _stepped(self, arrays: dict[str, NDArray], target: NDArray) -> dict[str, NDArray]:
        """Return the state after one sub-step of all robots."""
        simulator = self.simulator
        every = {**simulator._arrays, **arrays}
        lanes = {name: aligned_copy(every[name]) for name in simulator._kernel.buffers if name in every}
        given = {**lanes, **simulator._batch.tables, "target": target}
        simulator._kernel(given, simulator.num_envs, {TIMES: 1}, num_threads=simulator.num_threads)
        return {name: lanes[name] for name in self._kept}


@dataclass(frozen=True)
class _Part:
    """A part of a sub-step that robots tried.

    Attributes:
        arrays: State before the part, in tiles, with the length of the part as `DT`.
        taken: Robots that accepted the part, shape (n,).
    """

    arrays: dict[str, NDArray]
    taken: NDArray[np.bool_]


def _parts_of(simulator: Simulator, rows: Mapping[str, NDArray], target: NDArray) -> list[_Part]:
    """Repeat a sub-step of robots that halved it, as the kernel does (`ce_gym.dynamics.stepping.halving`).

    Args:
        simulator: The simulator.
        rows: State before the sub-step by name, one robot per row.
        target: Shape (n, n_targets).
    """
    model, options, dtype = simulator.model, simulator.options, simulator.dtype
    kernel, n = load_step_kernel(model, replace(options, retry=0), (), dtype), len(target)
    step = StepVariables(model.mechanism, options)
    subdivide = subdivide_function(step, options.retry)
    arguments = [name for name in kernel.buffers if name in rows] + [RETRIES.name]
    scratch = {variable.name: np.zeros((n, variable.size)) for name, variable in step.start.items() if name not in rows}
    values = {**rows, **scratch, RETRIES.name: np.zeros((n, 1)), PART.name: np.ones((n, 1)), LEFT.name: np.ones((n, 1))}
    parts: list[_Part] = []
    while (values[PART.name] > 0).any():
        length = values[PART.name] * values[DT]
        state = {name: values[name] for name in arguments} | {DT: length}
        before, after = _in_tiles(state, dtype), _in_tiles(state, dtype)
        kernel(after | simulator._batch.tables | {"target": target}, n, {TIMES: 1})
        tried = {step.tried[name].name: read_rows(after[name], n) for name in step.start if name in after}
        tried |= {step.tried[name].name: values[name] for name in scratch}
        joints = tried[step.tried["v"].name][:, model.robot.layout.base_nv :]
        tried[step.tried[MOVED].name] = length * np.abs(joints).max(axis=1, initial=0.0, keepdims=True)
        results = call_on_batch(subdivide, [(values | tried)[name] for name in subdivide.name_in()])
        updates = {name: rows[..., 0] for name, rows in zip(output_names(subdivide), results, strict=True)}
        parts.append(_Part(before, (updates[LEFT.name] < values[LEFT.name])[:, 0]))
        values |= updates | {variable.name: updates[step.tried[part].name] for part, variable in step.start.items()}
    return parts


def _copied(
    simulator: Simulator, keep_every: int, records: list[Record], left: dict[str, NDArray[np.bool_]]
) -> StepDerivatives:
    """Return derivatives of a simulator with records whose arrays a copy may have moved to unaligned memory.

    Args:
        simulator: The copy.
        keep_every: See `StepDerivatives`.
        records: Of the original.
        left: Which robots of the original are at the end of the last record, by part of the state.
    """
    derivatives = StepDerivatives(simulator, keep_every)
    aligned = [{name: aligned_copy(array) for name, array in record.arrays.items()} for record in records]
    derivatives._records = [replace(record, arrays=arrays) for record, arrays in zip(records, aligned, strict=True)]
    if records:
        versions = derivatives._versions()
        derivatives._records[-1].after = {name: np.where(at_end, versions[name], -1) for name, at_end in left.items()}
    return derivatives


def _overwrite(array: NDArray, rows: NDArray, chosen: NDArray[np.bool_]) -> None:
    """Write rows of the chosen robots into an array of tiles or rows."""
    if array.ndim == 2:
        array[chosen] = rows
        return
    every = np.zeros((len(chosen), rows.shape[1]))
    every[chosen] = rows
    write_rows(array, every, chosen)


def _in_tiles(rows: Mapping[str, NDArray], dtype: str) -> dict[str, NDArray]:
    """Return rows of robots as tiles."""
    arrays = {name: tiles(len(value), value.shape[1], dtype) for name, value in rows.items()}
    for name, value in rows.items():
        write_rows(arrays[name], value)
    return arrays
