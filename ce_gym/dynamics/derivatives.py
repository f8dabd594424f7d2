"""Derivatives of the quantities of a mechanism: Jacobians, and products with them in forward and reverse mode.

Positions are differentiated in their tangent space, in the order of `v`: base rotation, base translation, both in base
axes, rotations of ball joints in the axes of the bodies that turn, then the other joints. Closed loops move with the
independent joints: dependent coordinates that Newton's method found are differentiated through its iterations, which
start from the solution and so give its exact derivative.

The Jacobians of forward dynamics follow from those of inverse dynamics,

    d vdot / dx = -M^-1 d ID(q, v, vdot) / dx,    d vdot / d tau = M^-1,

which takes a third of the instructions of differentiating the articulated-body recursion.

Source: Carpentier, Mansard, "Analytical Derivatives of Rigid Body Dynamics Algorithms", RSS 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX, quaternion_product, quaternion_to_rotation
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.functions import FUNCTIONS
from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
from ce_gym.dynamics.parameters import with_parameters
from ce_gym.model.coordinates import Layout
from ce_gym.model.errors import check_names, listed_names
from ce_gym.model.mechanism import Mechanism

PLAIN_FIGURES, BODY_FIGURES = ("gravity", "rotor_inertia", "ratio"), ("added_mass", "com_shift")
"""Parameters that are figures of the mechanism, not of a scene: of the whole, and of each link."""


def tangent_basis(q: SX, layout: Layout) -> SX:
    """Return how positions (nq,) change with their tangent, shape (nq, nv)."""
    turning = [_turning(q[i : i + 4]) for i, _ in layout.turns]
    if layout.floating:
        turning[0] = ca.blockcat([[SX(3, 3), quaternion_to_rotation(q[3:7])], [turning[0], SX(4, 3)]])
    return ca.diagcat(*turning, SX.eye(layout.joints))


def _turning(quaternion: SX) -> SX:
    """Return how a quaternion changes with a rotation about the axes of what it turns, shape (4, 3)."""
    return ca.horzcat(*[quaternion_product(quaternion, ca.vertcat(0, SX.eye(3)[:, i])) / 2 for i in range(3)])


@dataclass(frozen=True)
class Quantity:
    """A quantity as expressions of its inputs, which figures of the mechanism may be among.

    Attributes:
        inputs: Symbols by name, in the order of the function; positions, if there are any, are "q".
        figures: Symbols of figures by name, with the values that the robot has.
        outputs: Expressions by name.
        layout: Which rows of `q` are what.
    """

    inputs: dict[str, SX]
    figures: dict[str, tuple[SX, np.ndarray]]
    outputs: dict[str, SX]
    layout: Layout

    def along(self, name: str) -> tuple[SX, SX]:
        """Return the symbol of an input or figure, and how it changes with its tangent."""
        x = self.inputs[name] if name in self.inputs else self.figures[name][0]
        return x, tangent_basis(x, self.layout) if name == "q" else SX.eye(x.numel())

    def function(self, name: str, given: dict[str, SX], results: list[SX]) -> ca.Function:
        """Trace expressions at the robot's own figures; a guess of dependent coordinates stays the last input."""
        symbols = [symbol for symbol, _ in self.figures.values()]
        results = ca.substitute(results, symbols, [SX(ca.DM(value)) for _, value in self.figures.values()])
        inputs = dict(self.inputs)
        guess = {"guess": inputs.pop("guess")} if "guess" in inputs else {}
        return traced(name, inputs | given | guess, {f"result{i}": result for i, result in enumerate(results)})


def make_quantity(mechanism: Mechanism, name: str, wrt: tuple[str, ...]) -> Quantity:
    """Return a quantity whose inputs, and figures among `wrt`, are symbols.

    Args:
        mechanism: The mechanism.
        name: Of the quantity, one of `FUNCTIONS`.
        wrt: Inputs of it by name, and figures of the mechanism by their names as parameters.

    Raises:
        ValueError: If there is no such quantity, or it depends on no such thing.
    """
    if name not in FUNCTIONS:
        raise ValueError(f"derivatives of {name!r}; expected one of {listed_names(name, FUNCTIONS)}")
    plain = FUNCTIONS[name](mechanism).name_in()
    figures = tuple(x for x in wrt if x not in plain or x == "guess")
    bodies = [body.name for body in mechanism.robot.bodies if body.kind == "link"]
    known = {*PLAIN_FIGURES, *(f"{figure}:{body}" for figure in BODY_FIGURES for body in bodies)}
    given = [x for x in plain if x != "guess"]
    listed = ", ".join([*given, *PLAIN_FIGURES, *(f"{figure}:BODY" for figure in BODY_FIGURES)])
    check_names(f"derivatives of {name}: wrt", wrt, [*given, *known], "some of", listed=f"{listed}, BODY being a link")
    defaults = parameter_defaults(mechanism.robot, mechanism.robot.material, figures)
    symbols = {x: SX.sym("figure", len(value)) for x, value in defaults.items()}
    named = with_parameters(mechanism, symbols) if figures else mechanism
    function = FUNCTIONS[name](named)
    inputs = {x: SX.sym(x, function.numel_in(i)) for i, x in enumerate(function.name_in())}
    outputs = dict(zip(function.name_out(), function.call(list(inputs.values())), strict=True))
    return Quantity(inputs, {x: (symbols[x], defaults[x]) for x in symbols}, outputs, mechanism.robot.layout)


def jacobian_function(mechanism: Mechanism, name: str, wrt: tuple[str, ...]) -> ca.Function:
    """Trace Jacobians of a quantity: of each output, with respect to each of `wrt`, in the tangent space of positions.

    Returns:
        Function of the quantity's inputs -> matrices, of the same output one after the other.
    """
    if name == "forward_dynamics":
        return _forward_dynamics_jacobian(mechanism, wrt)
    quantity = make_quantity(mechanism, name, wrt)
    return quantity.function("jacobian", {}, _jacobians(quantity, wrt))


def product_function(mechanism: Mechanism, name: str, wrt: tuple[str, ...]) -> ca.Function:
    """Trace how a quantity changes along a direction (forward mode): at most two to three times its work.

    Returns:
        Function (*inputs, direction of each of `wrt`) -> change of each output, as a column.
    """
    quantity = make_quantity(mechanism, name, wrt)
    x, basis = (list(parts) for parts in zip(*[quantity.along(name) for name in wrt], strict=True))
    directions = [SX.sym("direction", tangent.shape[1]) for tangent in basis]
    moved = ca.vertcat(*[tangent @ direction for tangent, direction in zip(basis, directions, strict=True)])
    changes = [ca.jtimes(ca.vec(output), ca.vertcat(*x), moved) for output in quantity.outputs.values()]
    given = {f"direction{i}": direction for i, direction in enumerate(directions)}
    return quantity.function("product", given, changes)


def gradient_function(mechanism: Mechanism, name: str, wrt: tuple[str, ...]) -> ca.Function:
    """Trace the gradient of a weighted sum of all outputs (reverse mode): about three times their work, whatever `wrt`.

    Returns:
        Function (*inputs, weights of each output) -> gradient with respect to each of `wrt`.
    """
    quantity = make_quantity(mechanism, name, wrt)
    x, basis = (list(parts) for parts in zip(*[quantity.along(name) for name in wrt], strict=True))
    weights = {f"weights{i}": SX.sym("weights", out.numel()) for i, out in enumerate(quantity.outputs.values())}
    stacked = ca.vertcat(*[ca.vec(output) for output in quantity.outputs.values()])
    whole = ca.jtimes(stacked, ca.vertcat(*x), ca.vertcat(*weights.values()), True)
    parts = ca.vertsplit(whole, np.cumsum([0, *[symbol.numel() for symbol in x]]).tolist())
    gradients = [tangent.T @ part for tangent, part in zip(basis, parts, strict=True)]
    return quantity.function("gradient", weights, gradients)


def _jacobians(quantity: Quantity, wrt: tuple[str, ...]) -> list[SX]:
    pairs = [quantity.along(name) for name in wrt]
    return [ca.jacobian(ca.vec(output), x) @ basis for output in quantity.outputs.values() for x, basis in pairs]


def _forward_dynamics_jacobian(mechanism: Mechanism, wrt: tuple[str, ...]) -> ca.Function:
    forward = FUNCTIONS["forward_dynamics"](mechanism)
    inputs = {name: SX.sym(name, forward.numel_in(i)) for i, name in enumerate(forward.name_in())}
    vdot = forward(*inputs.values())
    to_acceleration = ca.triu2symm(ca.triu(ca.densify(ca.jacobian(vdot, inputs["tau"]))))  # M^-1, symmetric
    others = tuple(name for name in wrt if name != "tau")
    inverse = make_quantity(mechanism, "inverse_dynamics", others)
    forces = dict(zip(others, _jacobians(inverse, others), strict=True))
    at = [vdot if name == "vdot" else inputs[name] for name in inverse.inputs]
    results = ca.substitute([to_acceleration @ forces[x] for x in others], list(inverse.inputs.values()), at)
    results = [-results[others.index(x)] if x in others else to_acceleration for x in wrt]
    return Quantity(inputs, inverse.figures, {}, mechanism.robot.layout).function("jacobian", {}, results)
