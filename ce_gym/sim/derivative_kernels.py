"""The kernels of derivatives of a sub-step: reverse mode, and the Jacobian by columns.

Both execute the iterations that the step needs. The kernel of columns differentiates each iteration right after it. The
reverse mode also differentiates an iteration at once, as if it were the last one, and corrects the gradient if another
iteration follows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import casadi as ca

from ce_gym.compile import Buffer, Call, Program, Step, load_kernel, scratch_buffers
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import output_names, traced
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.derivatives import (
    adjoint_function,
    adjoint_weights,
    first_adjoint_function,
    input_gradients,
    iterations_of,
    primal_function,
    state_parts,
)
from ce_gym.dynamics.stepping.linearization import Linearization, blocks
from ce_gym.dynamics.stepping.variables import Variable
from ce_gym.sim.calls import NONE, assign, call
from ce_gym.sim.kernel_key import laws_key, model_key
from ce_gym.sim.substeps import DT, FRAME, HEIGHTS, look_up


def load_gradient_kernel(model: Model, options: StepOptions, dtype: str) -> Any:
    """Compile, or load from the cache, the kernel of the reverse mode of one sub-step."""
    key = f"step gradient {_key(model, options)}"
    return load_kernel(key, lambda: gradient_program(model, options), dtype)


def load_linearization_kernel(model: Model, options: StepOptions, dtype: str, whole_state: bool = False) -> Any:
    """Compile, or load from the cache, the kernel of the Jacobian of one sub-step."""
    kind = "step linearization of the whole state" if whole_state else "step linearization"
    key = f"{kind} {_key(model, options)}"
    return load_kernel(key, lambda: linearization_program(model, options, whole_state), dtype)


def _key(model: Model, options: StepOptions) -> str:
    return f"{model_key(model)} {options!r} {laws_key(model.mechanism, options)}"


class IterationTape:
    """The iterations of one sub-step with their iterates, and the reverse mode of those that were executed.

    Args:
        primal: One iteration of the step, see `primal_function`.
        adjoint: Its reverse mode, see `adjoint_function`.
        n: Most iterations.
        suffix: Ends the names of the buffers, for programs with several sub-steps.

    Attributes:
        iterates: Buffers of the iterate before each iteration and after the last.
        active: Buffers of whether each iteration is needed, and of whether one more would be.
    """

    def __init__(self, primal: ca.Function, adjoint: ca.Function, n: int, suffix: str = "") -> None:
        self.primal, self.adjoint, self.n = primal, adjoint, n
        self.iterates = [f"iterate{suffix}{k}" for k in range(n + 1)]
        self.active = [f"active{suffix}{k}" for k in range(n + 1)]

    def begin(self) -> Call:
        """Return the call that resets the iterate and activates the first iteration only.

        A skipped iteration does not write whether the next one is needed, so flags of the previous tile must not stay.
        """
        values = dict.fromkeys(self.active[1:], ca.DM(0)) | {self.active[0]: ca.DM(1)}
        if "iterate" in self.primal.name_in():
            values[self.iterates[0]] = ca.DM.zeros(self.primal.numel_in("iterate"))
        return assign(values)

    def forwards(self, n: int, before: Mapping[str, str], after: Mapping[str, str]) -> list[Call]:
        """Return the calls of the first n iterations.

        Args:
            n: Number of iterations.
            before: Buffers of the state before the sub-step, by name of its part.
            after: Buffers of the state and of outputs after the sub-step, by name.
        """
        return [self._call(self.primal, k, before, after, self.active[k] if k else "") for k in range(n)]

    def backwards(self, names: Mapping[str, str]) -> list[Call]:
        """Return the calls of the reverse mode after `forwards`; `names` are buffers by name of the argument."""
        return [self._reset(names), *(self._adjoint(k, self.active[k], names) for k in reversed(range(self.n)))]

    def guessed(self) -> list[Call]:
        """Return the calls of the reverse mode without `forwards`; they leave `sums` and `first_sums`.

        Each iteration is differentiated as if no robot of the tile needed another one; if one does, the gradient is
        computed again. Few tiles need a second iteration, and no tile executes an iteration apart from its adjoint,
        which contains the iteration. `first_sums` are for robots with one iteration, whatever the other robots need.
        """
        calls = [self._call(first_adjoint_function(self.adjoint), 0, NONE, {"sums": "first_sums"})]
        for k in range(1, self.n):
            calls += [self._reset(NONE, self.active[k]), self._adjoint(k, self.active[k])]
        return calls + [self._adjoint(k, self.active[k + 1]) for k in reversed(range(self.n - 1))]

    def _reset(self, names: Mapping[str, str], only_if: str = "") -> Call:
        """Return the call that starts the reverse mode: gradients of 0, the last executed iteration not found yet."""
        sizes = {x: self.adjoint.numel_in(x) for x in ("sums", "pending", "owed") if x in self.adjoint.name_in()}
        values = {x: ca.DM.zeros(size) for x, size in sizes.items()} | {"pending": ca.DM(1)}
        return assign({names.get(x, x): value for x, value in values.items()}, only_if=only_if)

    def _adjoint(self, k: int, only_if: str, names: Mapping[str, str] = NONE) -> Call:
        return self._call(self.adjoint, k, names, names, only_if)

    def _call(
        self, function: ca.Function, k: int, inputs: Mapping[str, str], outputs: Mapping[str, str], only_if: str = ""
    ) -> Call:
        """Return the call of iteration k or of its reverse mode."""
        read = {"iterate": self.iterates[k], "active": self.active[k], **inputs}
        written = {"iterate": self.iterates[k + 1], "unconverged": self.active[k + 1], **outputs}
        return call(function, read, written, only_if=only_if)


def gradient_program(model: Model, options: StepOptions) -> Program:
    """Return the program that turns the gradient `w_q`, `w_v`, ... after a sub-step into the gradient before it."""
    mechanism, layout = model.mechanism, model.robot.layout
    primal = primal_function(mechanism, options)
    tape = IterationTape(primal, adjoint_function(mechanism, options, leads_on=True), iterations_of(mechanism, options))
    sizes = {name: primal.numel_in(name) for name in primal.name_in()}
    weights = adjoint_weights(primal, layout)
    others = input_gradients(primal)
    names = (*state_parts(primal), "diverged", DT, *(["parameters"] if "parameters" in sizes else []))
    buffers = [Buffer(name, sizes[name], "tiles") for name in names] + _ground_buffers(options)
    buffers += [Buffer("target", sizes["target"], "rows_in")] if "target" in sizes else []
    buffers += [Buffer(variable.name, variable.size, "tiles") for variable in weights.values()]
    buffers += [Buffer(variable.name, variable.size, "rows_out", "float64") for variable in others.values()]
    gradients = [*weights.values(), *others.values()]
    steps = (*_ground_calls(model, options), tape.begin(), *tape.guessed(), _split(tape, gradients))
    name = f"{model.robot.name} {model.transmission} step gradient"
    return _program(name, buffers, steps)


def _split(tape: IterationTape, gradients: list[Variable]) -> Call:
    """Return the call that splits the sums, or the first sums of robots with one iteration, into gradients."""
    sizes = [variable.size for variable in gradients]
    first, ends = SX.sym("first", sum(sizes)), list(accumulate(sizes, initial=0))
    sums, again = SX.sym("sums", first.numel()), SX.sym("again")
    inputs, total = {"first_sums": first}, first
    if tape.n > 1:
        inputs = {tape.active[1]: again, "sums": sums, "first_sums": first}
        total = ca.if_else(again, sums, first)
    parts = ca.vertsplit(total, ends)
    return call(traced("split", inputs, {x.name: part for x, part in zip(gradients, parts, strict=True)}))


def linearization_program(model: Model, options: StepOptions, whole_state: bool = False) -> Program:
    """Return the program that writes `ends`: the derivative of the state after a sub-step in each direction.

    Directions are the coordinates of the state before the sub-step, then the entries of the target.

    Args:
        model: The robot at a transmission level.
        options: The scene.
        whole_state: Whether the state is [q; v; load; anchor], as far as the scene has them, instead of [q; v].
    """
    linear = Linearization(model.mechanism, options, whole_state)
    columns = _LinearizationCalls(linear, iterations_of(model.mechanism, options))
    looked_up = ("ground", "region_points", "places")
    sizes = {name: x.numel() for name, x in linear.given.inputs().items() if name not in looked_up}
    buffers = [Buffer(name, size, "rows_in" if name == "target" else "tiles") for name, size in sizes.items()]
    buffers += _ground_buffers(options)
    buffers.append(Buffer(ENDS, linear.size * linear.places["end"], "rows_out", "float64"))
    buffers += columns.buffers()
    name = f"{model.robot.name} {model.transmission} step linearization"
    return _program(name, buffers, (*_ground_calls(model, options), *columns.calls()))


def _program(name: str, buffers: list[Buffer], steps: tuple[Step, ...]) -> Program:
    """Return a program with all further buffers as scratch."""
    scratch = scratch_buffers(steps, {buffer.name for buffer in buffers})
    return Program(name, (*buffers, *scratch), steps, compact=True)


def _ground_buffers(options: StepOptions) -> list[Buffer]:
    return [Buffer(HEIGHTS, 0, "table"), Buffer(FRAME, 3, "tiles")] if options.ground == "field" else []


def _ground_calls(model: Model, options: StepOptions) -> tuple[Step, ...]:
    return tuple(look_up(model.mechanism, options)) if options.ground == "field" else ()


ENDS, CONTACT_ACTS = "ends", "contact_acts"
"""Names of the buffers of the result of `linearization_program`, and of whether a contact acts."""
TRIED_ITERATE, TRIED_DIVERGED, VDOT_BEFORE = "tried_iterate", "tried_diverged", "vdot_before"
"""Names of the buffers of results of an iteration, and of the acceleration of the previous iteration."""


@dataclass(frozen=True)
class _Block:
    """A block of directions, one column after the other.

    Attributes:
        count: Number of directions.
        start: Number of the first value in `ENDS`.
        buffers: Buffers of the columns, by name of the argument: changes of the equation of motion ("change"), of the
            acceleration ("column"), of gains of the iteration before ("gains", "direct" at constant acceleration), and
            of the state after the step ("end", "still" at constant acceleration).
    """

    count: int
    start: int
    buffers: dict[str, str]


class _LinearizationCalls:
    """The calls of the linearization: iteration by iteration, and in each iteration by group of directions.

    Args:
        linear: The traced functions.
        n: Most iterations.
    """

    def __init__(self, linear: Linearization, n: int) -> None:
        self.linear, self.n = linear, n
        self.iterate, self.first = linear.iteration_function(), linear.solve_function(first=True)
        self.solve, self.end = linear.solve_function(), linear.end_function()
        drifts = bool(linear.drift.nnz())
        self.drift = linear.drift_function() if drifts else None
        self.pressed_drift = linear.pressed_drift_function() if drifts and linear.local else None
        self.gains = linear.gains_function() if linear.chained else None
        self.pass_on = linear.pass_on_function() if linear.chained else None
        self.changes = [linear.change_function(group) for group in linear.groups]
        self.presses = [linear.press_function(group) for group in linear.groups]
        self.stills = [linear.still_function(group) for group in linear.groups]
        self.blocks = list(self._blocks())

    def _blocks(self) -> Iterator[list[_Block]]:
        """Yield the blocks of each group; the functions of the group have an output for each block."""
        linear = self.linear
        directs = iter(output_names(self.gains)[2:] if self.gains else ())
        for group, change, still in zip(linear.groups, self.changes, self.stills, strict=True):
            members = []
            for (name, i, count), *shared in zip(blocks(group), output_names(change), output_names(still), strict=True):
                buffers = {argument: f"{argument}_{name}{i}" for argument in ("column", "gains", "end")}
                buffers |= dict(zip(("change", "still", "direct"), (*shared, next(directs, "")), strict=True))
                members.append(_Block(count, linear.size * (linear.places[name] + i), buffers))
            yield members

    def buffers(self) -> list[Buffer]:
        """Return the buffers that are parts of `ENDS`."""
        size, every = self.linear.size, [block for group in self.blocks for block in group]
        return [Buffer(x.buffers["end"], size * x.count, "scratch", within=ENDS, start=x.start) for x in every]

    def calls(self) -> Iterator[Call]:
        """Yield all calls in order."""
        linear = self.linear
        zeros = {"iterate": linear.iterate.numel()} | dict.fromkeys(map(_active, range(1, self.n)), 1)
        if linear.keeps_gains:
            size = linear.wrt["gains"].numel()
            zeros |= {block.buffers["gains"]: size * block.count for group in self.blocks for block in group}
        yield assign({name: ca.DM.zeros(size) for name, size in zeros.items() if size} | {_active(0): ca.DM(1)})
        for k in range(self.n):
            yield from self._iteration(k)
        yield from self._ends()

    def _iteration(self, k: int) -> Iterator[Call]:
        """Yield iteration k: the acceleration, then its change in each direction."""
        only_if, chained = _active(k) if k else "", k > 0 and self.linear.chained
        if k:
            yield _copy(TRIED_ITERATE, "iterate", self.linear.iterate.numel(), only_if)
        if chained:
            yield _copy("vdot", VDOT_BEFORE, self.linear.nv, only_if)
        results = {"iterate": TRIED_ITERATE, "diverged": TRIED_DIVERGED, "unconverged": _active(k + 1)}
        yield call(self.iterate, outputs=results, only_if=only_if)
        if self.drift:
            yield call(self.drift, only_if=only_if)
        if self.pressed_drift:
            yield call(self.pressed_drift, only_if=CONTACT_ACTS)
        if chained and self.gains:
            yield call(self.gains, {"vdot": VDOT_BEFORE}, only_if=only_if)
        for change, press, group in zip(self.changes, self.presses, self.blocks, strict=True):
            yield call(change, only_if=only_if)
            if press:
                yield call(press, only_if=CONTACT_ACTS)
            for block in group:
                bound = block.buffers | {"active": _active(k)}
                if chained and self.pass_on:
                    yield call(self.pass_on, bound, bound, only_if=only_if, times=block.count)
                solve = self.solve if k else self.first
                yield call(solve, bound, bound, only_if=only_if, times=block.count)
        if any(self.presses):
            yield assign({CONTACT_ACTS: ca.DM(0)}, only_if=only_if)

    def _ends(self) -> Iterator[Call]:
        """Yield the calls that compute the derivative of the step from the derivative of the acceleration."""
        state = {"diverged": TRIED_DIVERGED}
        yield call(self.linear.slope_function(), state)
        for group, still in zip(self.blocks, self.stills, strict=True):
            yield call(still, state)
            for block in group:
                yield call(self.end, state | block.buffers, block.buffers, times=block.count)


def _active(k: int) -> str:
    """Return the name of the buffer that says whether iteration k is needed."""
    return f"active{k}"


def _copy(source: str, target: str, size: int, only_if: str) -> Call:
    value = SX.sym(source, size)
    return call(traced("copy", {source: value}, {target: value}), only_if=only_if)
