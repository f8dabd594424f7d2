"""The kernels of derivatives of a sub-step: reverse mode, and the Jacobian by columns.

Both repeat the iterations that the step needs. Columns go along with them, each iteration taking over what the one
before passed on. The reverse mode goes back through an iteration as soon as it gets there, as if it were the last.
"""

from __future__ import annotations

from functools import cached_property
from itertools import accumulate
from typing import Any

import casadi as ca

from ce_gym.compile import Buffer, Call, Program, Step, load_kernel
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.derivatives import (
    adjoint_function,
    first_adjoint_function,
    iterations_of,
    primal_function,
    state_parts,
)
from ce_gym.dynamics.stepping.linearization import Block, Linearization, blocks
from ce_gym.sim.kernel_key import laws_key, model_key
from ce_gym.sim.substeps import DT, FRAME, look_up


def _key(model: Model, options: StepOptions) -> str:
    return f"{model_key(model)} {options!r} {laws_key(model.mechanism, options)}"


def load_gradient_kernel(model: Model, options: StepOptions, dtype: str) -> Any:
    """Compile, or load from the cache, the kernel of the reverse mode of one sub-step."""

    def build() -> Program:
        return gradient_program(model, options)

    return load_kernel(f"step gradient {_key(model, options)}", build, dtype)


class Chain:
    """The iterations of one sub-step, what each begins with kept, and the way back through those that were needed.

    Args:
        primal: An iteration of the step, see `primal_function`.
        adjoint: Its reverse mode, see `adjoint_function`.
        n: How many iterations there may be.
        at: Ends the names of the buffers of what is kept: iterates and which iterations were needed.
    """

    def __init__(self, primal: ca.Function, adjoint: ca.Function, n: int, at: str = "") -> None:
        self.primal, self.adjoint, self.n, self.at = primal, adjoint, n, at

    def kept(self, name: str, k: int) -> str:
        """Name of the buffer of "iterate" or "active" of iteration k."""
        return f"{name}{self.at}{k}"

    def begun(self) -> Call:
        """Return a call that begins with no iterate, and with no iteration but the first.

        Iterations that are skipped leave alone whether the next one is needed: what another tile left must not say so.
        """
        values = {self.kept("active", k): SX(ca.DM.zeros(1)) for k in range(1, self.n + 1)}
        values[self.kept("active", 0)] = SX.ones(1)
        if "iterate" in self.primal.name_in():
            values[self.kept("iterate", 0)] = SX(ca.DM.zeros(self.primal.numel_in("iterate")))
        return Call(ca.Function("begin", [], list(values.values())), (), tuple(values))

    def forwards(self, n: int, before: dict[str, str], after: dict[str, str]) -> list[Call]:
        """Return calls of the first n iterations; buffers of what they are given and leave are called so by name."""
        calls = []
        for k in range(n):
            here = {"iterate": self.kept("iterate", k)} | before
            there = {"iterate": self.kept("iterate", k + 1), "unconverged": self.kept("active", k + 1)} | after
            given = tuple(here.get(x, x) for x in self.primal.name_in())
            left = tuple(there[x.removesuffix("_next")] for x in self.primal.name_out())
            calls.append(Call(self.primal, given, left, only_if=self.kept("active", k) if k else ""))
        return calls

    def backwards(self, names: dict[str, str]) -> list[Call]:
        """Return calls of the way back, from no gradient; buffers are called as the functions do, or by name."""
        back = [self._call(self.adjoint, k, names, self.kept("active", k)) for k in reversed(range(self.n))]
        return [Call(self._nothing, (), tuple(names.get(x, x) for x in self._nothing.name_out())), *back]

    def guessed(self) -> list[Call]:
        """Return calls of the way back alone, whose adjoint leads on; they leave `sums` and `first_sums`.

        An iteration is gone back through as if no robot of the tile needed another; if one does, that counts for
        nothing but for what it hands on. Few tiles need a second one, and none of these makes an iteration without
        its adjoint, which contains it. `first_sums` are for robots that needed one iteration, whatever others did.
        """
        calls = [self._call(first_adjoint_function(self.adjoint), 0, {"sums": "first_sums"})]
        for k in range(1, self.n):
            calls.append(Call(self._nothing, (), tuple(self._nothing.name_out()), self.kept("active", k)))
            calls.append(self._call(self.adjoint, k, {}, self.kept("active", k)))
        return calls + [
            self._call(self.adjoint, k, {}, self.kept("active", k + 1)) for k in reversed(range(self.n - 1))
        ]

    @cached_property
    def _nothing(self) -> ca.Function:
        """What the way back begins with."""
        sizes = {"sums": self.adjoint.numel_in("sums"), "pending": 1}
        sizes |= {"owed": self.adjoint.numel_in("owed")} if "owed" in self.adjoint.name_in() else {}
        values = [SX.ones(1) if name == "pending" else SX(ca.DM.zeros(size)) for name, size in sizes.items()]
        return ca.Function("begin", [], values, [], list(sizes))

    def _call(self, adjoint: ca.Function, k: int, names: dict[str, str], only_if: str = "") -> Call:
        """Return the way back through iteration k."""
        here = {name: self.kept(name, k) for name in ("iterate", "active")} | names
        there = {"iterate": self.kept("iterate", k + 1), "unconverged": self.kept("active", k + 1)} | names
        given = tuple(here.get(x, x) for x in adjoint.name_in())
        left = tuple(there.get(x, x) for x in (x.removesuffix("_next") for x in adjoint.name_out()))
        return Call(adjoint, given, left, only_if)


def gradient_program(model: Model, options: StepOptions) -> Program:
    """Return the program: `w_{part}`, of the state after the step, becomes the gradient to that before it."""
    primal = primal_function(model.mechanism, options)
    adjoint = adjoint_function(model.mechanism, options, leads_on=True)
    chain, parts = Chain(primal, adjoint, iterations_of(model.mechanism, options)), state_parts(primal)
    ground, looks = _ground(model, options)
    buffers = [Buffer(name, primal.numel_in(name), "tiles") for name in (*parts, "diverged", DT)] + ground
    if "parameters" in primal.name_in():
        buffers.append(Buffer("parameters", primal.numel_in("parameters"), "tiles"))
    if "target" in primal.name_in():
        buffers.append(Buffer("target", primal.numel_in("target"), "rows_in"))
    carried = {f"w_{name}": adjoint.numel_in(f"w_{name}") for name in parts}
    others = {f"by_{name}": primal.numel_in(name) for name in ("target", "parameters") if name in primal.name_in()}
    buffers += [Buffer(name, size, "tiles") for name, size in carried.items()]
    buffers += [Buffer(name, size, "rows_out", "float64") for name, size in others.items()]
    steps = [*looks, chain.begun(), *chain.guessed(), _split(chain, carried | others)]
    known, scratch = {buffer.name for buffer in buffers}, dict[str, int]()
    for call in steps:
        if isinstance(call, Call):
            scratch |= {name: call.function.numel_out(i) for i, name in enumerate(call.outputs) if name not in known}
    buffers += [Buffer(name, size, "scratch") for name, size in scratch.items()]
    name = f"{model.robot.name} {model.transmission} step gradient"
    return Program(name, tuple(buffers), tuple(steps), compact=True)


def _split(chain: Chain, sizes: dict[str, int]) -> Call:
    """Return the call that chooses between sums, and takes them apart."""
    sums, ends = SX.sym("sums", sum(sizes.values())), list(accumulate(sizes.values(), initial=0))
    if chain.n == 1:
        return Call(ca.Function("split", [sums], ca.vertsplit(sums, ends)), ("first_sums",), tuple(sizes))
    first, again = SX.sym("first", sums.numel()), SX.sym("again")
    chosen = ca.vertsplit(ca.if_else(again, sums, first), ends)
    given = (chain.kept("active", 1), "sums", "first_sums")
    return Call(ca.Function("split", [again, sums, first], chosen), given, tuple(sizes))


def load_linearization_kernel(model: Model, options: StepOptions, dtype: str, whole_state: bool = False) -> Any:
    """Compile, or load from the cache, the kernel of the Jacobian of one sub-step."""

    def build() -> Program:
        return linearization_program(model, options, whole_state)

    kind = "step linearization of the whole state" if whole_state else "step linearization"
    return load_kernel(f"{kind} {_key(model, options)}", build, dtype)


def linearization_program(model: Model, options: StepOptions, whole_state: bool = False) -> Program:
    """Return the program: `ends` becomes the derivatives of a state, for each direction of that state and the target.

    Args:
        model: The robot at a transmission level.
        options: The scene.
        whole_state: Whether the state is [q; v; load; anchor], what of these there is, in place of [q; v].
    """
    linear = Linearization(model.mechanism, options, whole_state)
    columns = _Columns(linear, iterations_of(model.mechanism, options))
    ground, looks = _ground(model, options)
    given = {
        name: x.numel()
        for name, x in linear.given.inputs().items()
        if name not in ("ground", "region_points", "places")
    }
    buffers = [Buffer(name, size, "rows_in" if name == "target" else "tiles") for name, size in given.items()]
    buffers += ground
    buffers.append(Buffer("ends", linear.size * linear.places["end"], "rows_out", "float64"))
    buffers += columns.parts
    sizes = dict[str, int]()
    for call in columns.steps:  # every other buffer is as large as what is first written to it
        for i, name in enumerate(call.outputs):
            sizes.setdefault(name, call.times * call.function.numel_out(i))
    known = {buffer.name for buffer in buffers}
    buffers += [Buffer(name, size, "scratch") for name, size in sizes.items() if name not in known]
    name = f"{model.robot.name} {model.transmission} step linearization"
    return Program(name, tuple(buffers), (*looks, *columns.steps), compact=True)


def _ground(model: Model, options: StepOptions) -> tuple[list[Buffer], tuple[Step, ...]]:
    """Return buffers and calls that find the ground under the contacts, if it is a field."""
    if options.ground != "field":
        return [], ()
    buffers, looks = look_up(model.mechanism, options)
    return [*buffers, Buffer(FRAME, 3, "tiles")], looks


class _Columns:
    """The calls of that program: iteration by iteration, and in each group of directions by group.

    Attributes:
        steps: The calls.
        parts: Buffers that are parts of `ends`, one for each block of directions.
    """

    def __init__(self, linear: Linearization, n: int) -> None:
        self.linear, self.chained = linear, linear.chained
        self.blocks = [blocks(group) for group in linear.groups]
        self.changes = [linear.change_function(group) for group in linear.groups]
        self.iterate, self.first, self.solve = (
            linear.iteration_function(),
            linear.solve_function(first=True),
            linear.solve_function(),
        )
        self.drift = [linear.drift_function()] if linear.turned else []
        self.presses = {g: press for g, group in enumerate(linear.groups) if (press := linear.press_function(group))}
        self.pressed_drift = [linear.pressed_drift_function()] if linear.local and self.drift else []
        if self.chained:
            self.gains, self.pass_on = linear.gains_function(), linear.pass_on_function()
        sizes = {"iterate": linear.iterate.numel()} | {f"active{k}": 1 for k in range(1, n)}
        if linear.keeps_gains:
            each = linear.wrt["gains"].numel()
            sizes |= {f"kept_{name}{i}": count * each for group in self.blocks for name, i, count in group}
        zeros = {name: SX(ca.DM.zeros(size)) for name, size in sizes.items() if size} | {"active0": SX(1)}
        self.steps = [Call(ca.Function("begin", [], list(zeros.values())), (), tuple(zeros))]
        for k in range(n):
            self.steps += self._iteration(k)
        self.parts = list[Buffer]()
        self.steps += self._ends()

    def _iteration(self, k: int) -> list[Call]:
        names = {"active": f"active{k}", "unconverged": f"active{k + 1}"}
        names |= {"iterate_next": "tried_iterate", "diverged_next": "tried_diverged"}
        only_if = f"active{k}" if k else ""

        def call(function: ca.Function, times: int = 1, **further: str) -> Call:
            return _call(function, names | further, only_if, times)

        passes = k > 0 and self.chained
        steps = [call(_copy(self.linear.iterate.numel()), copied="iterate", original="tried_iterate")] if k else []
        steps += [call(_copy(self.linear.nv), copied="vdot_before", original="vdot")] if passes else []
        steps += [call(self.iterate), *map(call, self.drift)]
        steps += [_call(function, names, "contact_acts") for function in self.pressed_drift]
        steps += [call(self.gains, vdot="vdot_before")] if passes else []
        for g, change in enumerate(self.changes):
            steps.append(call(change))
            steps += [_call(self.presses[g], names, "contact_acts")] if g in self.presses else []
            for j, block in enumerate(self.blocks[g]):
                here, count = self._here(block) | {"change": f"change{j}_{block[2]}"}, block[2]
                here |= {f"{name}_next": buffer for name, buffer in here.items()}
                steps += [call(self.pass_on, count, direct=f"direct{g}_{j}_{count}", **here)] if passes else []
                steps.append(call(self.solve if k else self.first, count, **here))
        nothing = ca.Function("nothing", [], [SX(ca.DM.zeros(1))], [], ["contact_acts"])
        return steps + ([call(nothing)] if self.presses else [])

    def _here(self, block: Block) -> dict[str, str]:
        """Buffers of a block's columns, by the names that functions have for them."""
        name, i, _ = block
        return {"column": f"column_{name}{i}"} | ({"gains": f"kept_{name}{i}"} if self.linear.keeps_gains else {})

    def _ends(self) -> list[Call]:
        """The columns of the step's derivative from those of its acceleration."""
        linear, names = self.linear, {"diverged": "tried_diverged"}
        steps, end = [_call(linear.slope_function(), names)], linear.end_function()
        for group, parts in zip(linear.groups, self.blocks, strict=True):
            steps.append(_call(linear.still_function(group), names))
            for j, (name, i, count) in enumerate(parts):
                start = linear.size * (linear.places[name] + i)
                self.parts.append(Buffer(f"ends_{name}{i}", linear.size * count, "scratch", within="ends", start=start))
                here = self._here((name, i, count)) | {"still": f"still{j}_{count}", "end": f"ends_{name}{i}"}
                steps.append(_call(end, names | here, times=count))
        return steps


def _call(function: ca.Function, names: dict[str, str], only_if: str = "", times: int = 1) -> Call:
    """Return the call of a function with buffers called as what it takes and returns, or as `names` has it."""
    given = tuple(names.get(name, name) for name in function.name_in())
    left = tuple(names.get(x, x.removesuffix("_next")) for x in function.name_out())
    return Call(function, given, left, only_if, times)


def _copy(size: int) -> ca.Function:
    x = SX.sym("x", size)
    return ca.Function("copy", [x], [x], ["original"], ["copied"])
