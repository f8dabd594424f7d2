"""The kernels of derivatives of a sub-step: reverse mode, and the Jacobian by columns.

Both repeat the iterations that the step needs. The reverse mode then goes back through them; columns go along with
them, each iteration taking over what the one before passed on.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from ce_gym.compile import Buffer, Call, Program, Step, load_kernel
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.derivatives import adjoint_function, iterations_of, primal_function, state_parts
from ce_gym.dynamics.stepping.linearization import Linearization
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
        sizes = {"sums": self.adjoint.numel_in("sums"), "pending": 1}
        sizes |= {"owed": self.adjoint.numel_in("owed")} if "owed" in self.adjoint.name_in() else {}
        values = [SX.ones(1) if name == "pending" else SX(ca.DM.zeros(size)) for name, size in sizes.items()]
        calls = [Call(ca.Function("begin", [], values), (), tuple(names.get(name, name) for name in sizes))]
        for k in reversed(range(self.n)):
            here = {name: self.kept(name, k) for name in ("iterate", "active")} | names
            given = tuple(here.get(x, x) for x in self.adjoint.name_in())
            left = tuple(names.get(x, x) for x in (x.removesuffix("_next") for x in self.adjoint.name_out()))
            calls.append(Call(self.adjoint, given, left, only_if=self.kept("active", k)))
        return calls


def gradient_program(model: Model, options: StepOptions) -> Program:
    """Return the program: the iterations of the step, then back through those that were needed."""
    primal, adjoint = (make(model.mechanism, options) for make in (primal_function, adjoint_function))
    n, parts = iterations_of(model.mechanism, options), state_parts(primal)
    chain = Chain(primal, adjoint, n)
    tried = {name: f"tried_{name}" for name in (*parts, "diverged")}
    ground, looks = _ground(model, options)
    buffers = [Buffer(name, primal.numel_in(name), "tiles") for name in (*parts, "diverged", DT)] + ground
    if "parameters" in primal.name_in():
        buffers.append(Buffer("parameters", primal.numel_in("parameters"), "tiles"))
    if "target" in primal.name_in():
        buffers.append(Buffer("target", primal.numel_in("target"), "rows_in"))
    buffers += [Buffer(f"w_{name}", adjoint.numel_in(f"w_{name}"), "rows_in", "float64") for name in parts]
    buffers.append(Buffer("sums", adjoint.numel_in("sums"), "rows_out", "float64"))
    steps = [*looks, chain.begun(), *chain.forwards(n - 1, {}, tried), *chain.backwards({})]
    known, scratch = {buffer.name for buffer in buffers}, dict[str, int]()
    for call in steps:
        if isinstance(call, Call):
            scratch |= {name: call.function.numel_out(i) for i, name in enumerate(call.outputs) if name not in known}
    buffers += [Buffer(name, size, "scratch") for name, size in scratch.items()]
    return Program(f"{model.robot.name} {model.transmission} step gradient", tuple(buffers), tuple(steps))


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
    n = iterations_of(model.mechanism, options)
    steps, sizes = _Columns(linear, n).steps, {}
    ground, looks = _ground(model, options)
    given = {name: x.numel() for name, x in linear.given.inputs().items() if name not in ("ground", "places")}
    buffers = [Buffer(name, size, "rows_in" if name == "target" else "tiles") for name, size in given.items()]
    buffers += ground
    buffers.append(Buffer("ends", linear.size * len(linear.directions), "rows_out", "float64"))
    for call in steps:  # every other buffer is as large as what is first written to it
        for i, name in enumerate(call.outputs):
            sizes.setdefault(name, call.function.numel_out(i))
    scratch = [Buffer(name, size, "scratch") for name, size in sizes.items() if name != "ends"]
    return Program(
        f"{model.robot.name} {model.transmission} step linearization", (*buffers, *scratch), (*looks, *steps)
    )


def _ground(model: Model, options: StepOptions) -> tuple[list[Buffer], tuple[Step, ...]]:
    """Return buffers and calls that find the ground under the contacts, if it is a field."""
    if options.ground != "field":
        return [], ()
    buffers, looks = look_up(model.mechanism, options)
    return [*buffers, Buffer(FRAME, 3, "tiles")], looks


class _Columns:
    """The calls of that program: iteration by iteration, and in each direction by direction."""

    def __init__(self, linear: Linearization, n: int) -> None:
        self.linear, self.chained = linear, linear.chained
        self.columns = [f"column{i}" for i in range(len(linear.directions))]
        self.changes = [linear.change_function(group) for group in linear.groups]
        self.iterate, self.solve = linear.iteration_function(), linear.solve_function()
        self.drift = [linear.drift_function()] if linear.turned else []
        self.presses = {g: press for g, group in enumerate(linear.groups) if (press := linear.press_function(group))}
        self.pressed_drift = [linear.pressed_drift_function()] if linear.local and self.drift else []
        if self.chained:
            self.gains, self.pass_on = linear.gains_function(), linear.pass_on_function()
        self.kept = [f"kept{i}" for i in range(len(self.columns))] if linear.keeps_gains else []
        sizes = {"iterate": linear.iterate.numel()} | dict.fromkeys(self.columns, linear.nv)
        sizes |= {name: linear.wrt["gains"].numel() for name in self.kept}
        sizes |= {f"active{k}": 1 for k in range(1, n)}
        zeros = {name: SX(ca.DM.zeros(size)) for name, size in sizes.items() if size} | {"active0": SX(1)}
        self.steps = [Call(ca.Function("begin", [], list(zeros.values())), (), tuple(zeros))]
        for k in range(n):
            self.steps += self._iteration(k)
        self.steps += self._ends()

    def _iteration(self, k: int) -> list[Call]:
        names = {"active": f"active{k}", "unconverged": f"active{k + 1}"}
        names |= {"iterate_next": "tried_iterate", "diverged_next": "tried_diverged"}
        only_if = f"active{k}" if k else ""

        def call(function: ca.Function, **further: str) -> Call:
            return _call(function, names | further, only_if)

        passes = k > 0 and self.chained
        steps = [call(_copy(self.linear.iterate.numel()), copied="iterate", original="tried_iterate")] if k else []
        steps += [call(_copy(self.linear.nv), copied="vdot_before", original="vdot")] if passes else []
        steps += [call(self.iterate), *map(call, self.drift)]
        steps += [_call(function, names, "contact_acts") for function in self.pressed_drift]
        steps += [call(self.gains, vdot="vdot_before")] if passes else []
        column, kept = iter(self.columns), iter(self.kept)
        for g, change in enumerate(self.changes):
            steps.append(call(change))
            steps += [_call(self.presses[g], names, "contact_acts")] if g in self.presses else []
            for i in range(change.n_out()):
                here = {"column": next(column), "change": f"change{i}"}
                here |= {"gains": next(kept)} if self.kept else {}
                here |= {f"{name}_next": buffer for name, buffer in here.items()}
                steps += [call(self.pass_on, direct=f"direct{g}_{i}", **here)] if passes else []
                steps.append(call(self.solve, **here))
        nothing = ca.Function("nothing", [], [SX(ca.DM.zeros(1))], [], ["contact_acts"])
        return steps + ([call(nothing)] if self.presses else [])

    def _ends(self) -> list[Call]:
        """The columns of the step's derivative from those of its acceleration."""
        linear, names = self.linear, {"diverged": "tried_diverged"}
        end, gather = linear.end_function(), linear.gather_function()
        kept = self.kept or self.columns
        each = [
            _call(end, {"column": name, "gains": gains, "end": f"end_{name}"})
            for name, gains in zip(self.columns, kept, strict=True)
        ]
        return [
            _call(linear.slope_function(), names),
            *each,
            _call(gather, names | {f"end{i}": f"end_{name}" for i, name in enumerate(self.columns)}),
        ]


def _call(function: ca.Function, names: dict[str, str], only_if: str = "") -> Call:
    """Return the call of a function with buffers called as what it takes and returns, or as `names` has it."""
    given = tuple(names.get(name, name) for name in function.name_in())
    return Call(function, given, tuple(names.get(x, x.removesuffix("_next")) for x in function.name_out()), only_if)


def _copy(size: int) -> ca.Function:
    x = SX.sym("x", size)
    return ca.Function("copy", [x], [x], ["original"], ["copied"])
