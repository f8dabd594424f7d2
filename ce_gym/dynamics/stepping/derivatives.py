"""The reverse mode of a time step, iteration by iteration, as traced functions.

A step with an active set is made of iterations on the same state, each from the iterate that the one before left. Its
gradient is chained through all of them: the last one that was needed hands what it is owed to the state and to its
iterate, that to the iteration before, and so on. Decisions (touching, sticking, slipping, a limit that acts) are
differentiated as decided. A diverged robot's gradient is zero.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.derivatives import tangent_basis
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.scene_laws import iterate_size, iterations_needed
from ce_gym.dynamics.stepping.trace import iteration_function, step_function
from ce_gym.model.coordinates import Layout
from ce_gym.model.mechanism import Mechanism


def iterations_of(mechanism: Mechanism, options: StepOptions) -> int:
    """Return in how many iterations a step is differentiated: 1 where it is differentiated as one expression."""
    plan = METHODS[options.method]
    alone = plan.is_euler and iterate_size(mechanism, options) > 0
    return 1 + min(plan.stages[0].iterations, iterations_needed(mechanism, options)) if alone else 1


def primal_function(mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...] = ()) -> ca.Function:
    """Trace the function to differentiate: an iteration of the step, or the step itself if it is one expression.

    Raises:
        ValueError: If steps choose their lengths: these would have to be differentiated too.
    """
    if METHODS[options.method].controlled:
        others = " or ".join(repr(name) for name, plan in METHODS.items() if not plan.controlled)
        raise ValueError(f"derivatives of steps with method={options.method!r}; expected {others}")
    whole = iterations_of(mechanism, options) == 1
    return (step_function if whole else iteration_function)(mechanism, options, outputs, follows=True)


def adjoint_function(
    mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...] = (), leads_on: bool = False
) -> ca.Function:
    """Trace the reverse mode of one iteration.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Names among `OUTPUTS` that something depends on besides the state; each has weights `w_{name}`.
        leads_on: Whether to return also the results of the iteration itself, `iterate` and `unconverged`.

    Returns:
        Function (*inputs of `primal_function`, `w_{part}` of the state after the step, `sums`, `pending`, `active`,
        `owed`) -> (`sums`, `pending`, `owed`). `w_q` and the gradient to `q` are in the tangent space of positions.
        `sums` stacks the gradients to the state, the target and the parameters; `pending` is 1 until the iteration that
        ended the step has been met; where `active` is 0 nothing changes; `owed` is the gradient to the iterate, if
        there is one.
    """
    primal, layout = primal_function(mechanism, options, outputs), mechanism.robot.layout
    inputs = {name: SX.sym(name, primal.numel_in(i)) for i, name in enumerate(primal.name_in())}
    after = dict(zip(primal.name_out(), primal.call(list(inputs.values())), strict=True))
    weights = {
        f"w_{name}": SX.sym(f"w_{name}", layout.nv if name == "q" else size)
        for name, size in state_parts(primal).items()
    }
    weights |= {f"w_{name}": SX.sym(f"w_{name}", primal.numel_out(name)) for name in outputs}
    pending, active = SX.sym("pending"), SX.sym("active")
    last = ca.logic_and(pending, active)
    seeds = [ca.if_else(last, _ambient(name, after, weights[f"w_{name}"], layout), 0) for name in state_parts(primal)]
    seeds += [ca.if_else(last, weights[f"w_{name}"], 0) for name in outputs]
    results = [*(after[f"{name}_next"] for name in state_parts(primal)), *(after[name] for name in outputs)]
    owed = SX.sym("owed", inputs["iterate"].numel() if "iterate" in inputs else 0)
    if owed.numel():
        seeds.append(owed)
        results.append(after["iterate_next"])
    to = [name for name in ("target", "parameters") if name in inputs]
    wrt = [*state_parts(primal), *to, *(["iterate"] if owed.numel() else [])]
    gradient = ca.jtimes(ca.vertcat(*results), ca.vertcat(*[inputs[x] for x in wrt]), ca.vertcat(*seeds), True)
    ends = [sum(inputs[x].numel() for x in wrt[:i]) for i in range(len(wrt) + 1)]
    parts = dict(zip(wrt, ca.vertsplit(gradient, ends), strict=True))
    parts["q"] = tangent_basis(inputs["q"], layout).T @ parts["q"]
    back = parts.pop("iterate", SX(0, 1))
    whole = ca.vertcat(*parts.values())
    sums = SX.sym("sums", whole.numel())
    counts = ca.logic_and(active, after["diverged_next"] < 0.5)
    left = {"sums_next": sums + ca.if_else(counts, whole, 0), "pending_next": ca.if_else(active, 0, pending)}
    left |= {"owed_next": ca.if_else(counts, back, 0)} if owed.numel() else {}
    handed_on = ("iterate_next", "unconverged") if leads_on else ()
    left |= {name: after[name] for name in handed_on if name in after}
    given = weights | {"sums": sums, "pending": pending, "active": active}
    return traced("adjoint", inputs | given | ({"owed": owed} if owed.numel() else {}), left)


def first_adjoint_function(adjoint: ca.Function) -> ca.Function:
    """Return the reverse mode of a first iteration that is the last, too: a tenth less than for any iteration.

    Returns:
        Function of those inputs of `adjoint` that are not known then -> (`sums`, and the results of the iteration).
    """
    known = {"iterate": 0, "sums": 0, "owed": 0, "pending": 1, "active": 1}
    sizes = {name: adjoint.numel_in(name) for name in adjoint.name_in()}
    inputs = {name: SX.sym(name, size) for name, size in sizes.items() if name not in known}
    given = [inputs[name] if name in inputs else known[name] * SX.ones(size) for name, size in sizes.items()]
    left = dict(zip(adjoint.name_out(), adjoint.call(given), strict=True))
    return traced("first", inputs, {x: value for x, value in left.items() if x not in ("owed_next", "pending_next")})


def state_parts(primal: ca.Function) -> dict[str, int]:
    """Return the sizes of the parts of a state, `diverged` left out."""
    others = ("diverged_next", "iterate_next")
    names = [name.removesuffix("_next") for name in primal.name_out() if name.endswith("_next") and name not in others]
    return {name: primal.numel_in(name) for name in names}


def _ambient(name: str, after: dict[str, SX], weights: SX, layout: Layout) -> SX:
    """Return weights of coordinates that give the same for every motion as weights of their tangent."""
    if name != "q" or not layout.turns:
        return weights
    scale = SX.ones(layout.nv)  # a rotation moves the quaternion by half its angle
    for _, row in layout.turns:
        scale[row : row + 3] = 4
    return tangent_basis(after["q_next"], layout) @ (scale * weights)
