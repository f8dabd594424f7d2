"""The reverse mode of a time step, iteration by iteration, as traced functions.

A step with an active set is made of iterations on the same state, each from the iterate of the previous one. The
adjoint of the last executed iteration is accumulated into the gradient with respect to the state and the iterate, whose
adjoint is then propagated to the previous iteration. Decisions (touching, sticking, slipping, an active limit) are
differentiated as decided. The gradient of a diverged robot is zero.
"""

from __future__ import annotations

from itertools import accumulate

import casadi as ca

from ce_gym.dynamics.algebra.integration import tangent_basis
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import output_names, traced
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.scene_laws import iterate_size, iterations_needed
from ce_gym.dynamics.stepping.trace import iteration_function, step_function
from ce_gym.dynamics.stepping.variables import Variables
from ce_gym.model.coordinates import Layout
from ce_gym.model.mechanism import Mechanism


def iterations_of(mechanism: Mechanism, options: StepOptions) -> int:
    """Return the most iterations of a step that are differentiated one by one; 1 if a step is one expression."""
    plan = METHODS[options.method]
    alone = plan.is_euler and iterate_size(mechanism, options) > 0
    return 1 + min(plan.stages[0].iterations, iterations_needed(mechanism, options)) if alone else 1


def primal_function(mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...] = ()) -> ca.Function:
    """Trace the function to be differentiated: an iteration of the step, or the step if that is one expression.

    Raises:
        ValueError: If the step size is controlled, because step sizes would have to be differentiated, too.
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
        outputs: Names among `OUTPUTS` that the differentiated quantity depends on besides the state.
        leads_on: Whether to return two results of the iteration itself, too: `iterate` and `unconverged`.

    Returns:
        Function (*inputs of `primal_function`, *`adjoint_weights`, `sums`, `pending`, `active`, `owed`) -> (`sums`,
        `pending`, `owed`). `sums` stacks the accumulated gradients with respect to the state, the target and the
        parameters. `pending` is 1 until the last executed iteration has been processed. Where `active` is 0 nothing
        changes. `owed` is the gradient with respect to the iterate, if there is one. Gradients with respect to `q` are
        in the tangent space of positions.
    """
    primal, layout = primal_function(mechanism, options, outputs), mechanism.robot.layout
    inputs = {name: SX.sym(name, primal.numel_in(name)) for name in primal.name_in()}
    after = dict(zip(output_names(primal), primal.call(list(inputs.values())), strict=True))
    parts, weights = state_parts(primal), adjoint_weights(primal, layout, outputs)
    weight, pending, active = weights.symbols(), SX.sym("pending"), SX.sym("active")
    is_last = ca.logic_and(pending, active)
    seeds = [_ambient(name, after, weight[name], layout) for name in parts] + [weight[name] for name in outputs]
    seeds = [ca.if_else(is_last, seed, 0) for seed in seeds]
    wrt = {name: inputs[name] for name in (*parts, "target", "parameters") if name in inputs}
    wrt["iterate"] = inputs.get("iterate", SX(0, 1))
    owed = SX.sym("owed", wrt["iterate"].numel())
    results = [*(after[name] for name in (*parts, *outputs)), after.get("iterate", SX(0, 1))]
    gradient = ca.jtimes(ca.vertcat(*results), ca.vertcat(*wrt.values()), ca.vertcat(*seeds, owed), True)
    ends = list(accumulate((value.numel() for value in wrt.values()), initial=0))
    gradients = dict(zip(wrt, ca.vertsplit(gradient, ends), strict=True))
    gradients["q"] = tangent_basis(inputs["q"], layout).T @ gradients["q"]
    of_iterate = gradients.pop("iterate")
    total = ca.vertcat(*gradients.values())
    sums, counts = SX.sym("sums", total.numel()), ca.logic_and(active, after["diverged"] < 0.5)
    inputs |= weights.named(weight) | {"sums": sums, "pending": pending, "active": active, "owed": owed}
    adjoint = {"sums": sums + ca.if_else(counts, total, 0), "pending": ca.if_else(active, 0, pending)}
    adjoint["owed"] = ca.if_else(counts, of_iterate, 0)
    adjoint |= {name: after[name] for name in ("iterate", "unconverged") if leads_on and name in after}
    return traced("adjoint", _nonempty(inputs), _nonempty(adjoint))


def first_adjoint_function(adjoint: ca.Function) -> ca.Function:
    """Return the reverse mode of a first iteration that is also the last, which is 10 % shorter than in general.

    Returns:
        Function of those inputs of `adjoint` that are not constant there -> outputs but `owed` and `pending`.
    """
    known = {"iterate": 0, "sums": 0, "owed": 0, "pending": 1, "active": 1}
    sizes = {name: adjoint.numel_in(name) for name in adjoint.name_in()}
    inputs = {name: SX.sym(name, size) for name, size in sizes.items() if name not in known}
    values = [inputs[name] if name in inputs else known[name] * SX.ones(size) for name, size in sizes.items()]
    outputs = dict(zip(output_names(adjoint), adjoint.call(values), strict=True))
    return traced("first", inputs, {name: x for name, x in outputs.items() if name not in ("owed", "pending")})


def state_parts(primal: ca.Function) -> dict[str, int]:
    """Return the sizes of the parts of a state, `diverged` left out."""
    inputs, others = primal.name_in(), ("diverged", "iterate")
    return {name: primal.numel_in(name) for name in output_names(primal) if name in inputs and name not in others}


def adjoint_weights(primal: ca.Function, layout: Layout, outputs: tuple[str, ...] = ()) -> Variables:
    """Return the variables of the gradient with respect to the state after a step and to outputs, such as `w_q`.

    The gradient with respect to the state before the step replaces them.
    """
    sizes = state_parts(primal) | {"q": layout.nv}
    return Variables("w", sizes | {name: primal.numel_out(name) for name in outputs})


def input_gradients(primal: ca.Function) -> Variables:
    """Return the variables of the gradient with respect to the target and the parameters, as far as they exist."""
    names = [name for name in ("target", "parameters") if name in primal.name_in()]
    return Variables("by", {name: primal.numel_in(name) for name in names})


def _nonempty(values: dict[str, SX]) -> dict[str, SX]:
    return {name: value for name, value in values.items() if value.numel()}


def _ambient(name: str, after: dict[str, SX], weights: SX, layout: Layout) -> SX:
    """Return weights of coordinates that equal given weights of the tangent space for every motion."""
    if name != "q" or not layout.turns:
        return weights
    scale = SX.ones(layout.nv)  # a rotation moves the quaternion by half of its angle
    for _, row in layout.turns:
        scale[row : row + 3] = 4
    return tangent_basis(after["q"], layout) @ (scale * weights)
