"""Derivatives of the quantities of a mechanism: Jacobians, and products with them in forward and reverse mode.

Positions are differentiated in their tangent space, in the order of `v`: base rotation, base translation, both in base
axes, rotations of ball joints in the axes of the moving bodies, then the other joints. Closed loops move with the
independent joints: dependent coordinates that Newton's method found are differentiated through its iterations, which
start from the solution and so give its exact derivative.

The Jacobians of inverse dynamics give the Jacobians of forward dynamics,

    d vdot / dx = -M^-1 d ID(q, v, vdot) / dx,    d vdot / d tau = M^-1,

which takes a third of the instructions of differentiating the articulated-body recursion.

Source: Carpentier, Mansard, "Analytical Derivatives of Rigid Body Dynamics Algorithms", RSS 2018.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.algebra.integration import tangent_basis
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.functions import trace
from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
from ce_gym.dynamics.parameters import with_parameters
from ce_gym.model.coordinates import Layout
from ce_gym.model.errors import check_names
from ce_gym.model.mechanism import Mechanism

Array = NDArray[np.float64]

ROBOT_PARAMETERS = ("gravity", "rotor_inertia", "ratio")
"""Parameters of the whole mechanism."""
LINK_PARAMETERS = ("added_mass", "com_shift")
"""Parameters of each link of the mechanism."""


class Derivatives:
    """Derivatives of one quantity; made by `Model.derivatives`.

    Positions are differentiated in their tangent space: rotation of the base, translation of the base, both in base
    axes, rotations of ball joints, then the other joints. Parameters are differentiated at the robot's own values.

    Args:
        mechanism: The mechanism.
        name: Name of the quantity.
        wrt: Inputs and parameters with respect to which the quantity is differentiated.
        evaluate: `Model.evaluate` of the mechanism.
    """

    def __init__(
        self, mechanism: Mechanism, name: str, wrt: tuple[str, ...], evaluate: Callable[..., list[Array]]
    ) -> None:
        if not wrt:
            raise ValueError(f"derivatives of {name} with respect to nothing; expected names of inputs or figures")
        self.name, self.wrt = name, wrt
        self._mechanism, self._evaluate = mechanism, evaluate
        self._quantity = make_quantity(mechanism, name, wrt)
        self._functions: dict[str, ca.Function] = {}

    def casadi_function(self, kind: str) -> ca.Function:
        """Return a derivative as a CasADi SX function: "jacobian", "product" or "gradient"."""
        if kind not in self._functions:
            if kind == "jacobian" and self.name == "forward_dynamics":
                self._functions[kind] = _forward_dynamics_jacobian(self._mechanism, self.wrt)
            else:
                make = {"jacobian": jacobian_function, "product": product_function, "gradient": gradient_function}
                self._functions[kind] = make[kind](self._quantity, self.wrt)
        return self._functions[kind]

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of the quantity."""
        return tuple(self._quantity.outputs)

    def jacobian(self, *arguments: ArrayLike) -> dict[tuple[str, str], Array]:
        """Return the Jacobian of each output by each input or parameter, shape (..., n_output, n_input) each.

        Args:
            arguments: Inputs of the quantity, shape (..., n) each.
        """
        results = self._evaluate(self.casadi_function("jacobian"), *arguments)
        return dict(zip([(output, x) for output in self.outputs for x in self.wrt], results, strict=True))

    def product(self, *arguments: ArrayLike, directions: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Return the derivative of each output along a direction, shape (..., n_output) each: forward mode.

        Args:
            arguments: Inputs of the quantity, shape (..., n) each.
            directions: Direction for each of `wrt`, tangents for positions, shape (..., n_input) each.
        """
        columns = [directions[x] for x in self.wrt]
        results = self._evaluate(self.casadi_function("product"), *arguments, *columns)
        return {name: result[..., 0] for name, result in zip(self.outputs, results, strict=True)}

    def gradient(self, *arguments: ArrayLike, weights: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Return the gradient of the weighted sum of all outputs, shape (..., n_input) each: reverse mode.

        Args:
            arguments: Inputs of the quantity, shape (..., n) each.
            weights: Weights of all outputs, shape (..., n_output) each.
        """
        columns = [weights[name] for name in self.outputs]
        results = self._evaluate(self.casadi_function("gradient"), *arguments, *columns)
        return {name: result[..., 0] for name, result in zip(self.wrt, results, strict=True)}


@dataclass(frozen=True)
class Quantity:
    """A quantity as expressions of its inputs and of parameters of the mechanism.

    Attributes:
        inputs: Symbols by name, in the order of the function; positions are "q".
        parameters: Symbols of parameters by name, with the robot's own values.
        outputs: Expressions by name.
        layout: Which rows of `q` are what.
    """

    inputs: dict[str, SX]
    parameters: dict[str, tuple[SX, np.ndarray]]
    outputs: dict[str, SX]
    layout: Layout

    def along(self, name: str) -> tuple[SX, SX]:
        """Return the symbol of an input or parameter, and its derivative by its tangent."""
        x = self.inputs[name] if name in self.inputs else self.parameters[name][0]
        return x, tangent_basis(x, self.layout) if name == "q" else SX.eye(x.numel())

    def function(self, name: str, more_inputs: dict[str, SX], results: list[SX]) -> ca.Function:
        """Trace expressions at the robot's own parameters; a guess of dependent coordinates stays the last input."""
        symbols = [symbol for symbol, _ in self.parameters.values()]
        results = ca.substitute(results, symbols, [SX(ca.DM(value)) for _, value in self.parameters.values()])
        inputs = dict(self.inputs)
        guess = {"guess": inputs.pop("guess")} if "guess" in inputs else {}
        return traced(name, inputs | more_inputs | guess, {f"result{i}": result for i, result in enumerate(results)})


def make_quantity(mechanism: Mechanism, name: str, wrt: tuple[str, ...]) -> Quantity:
    """Return a quantity whose inputs, and parameters among `wrt`, are symbols.

    Args:
        mechanism: The mechanism.
        name: Name of the quantity, see `trace`.
        wrt: Names of inputs of the quantity and of parameters of the mechanism.

    Raises:
        ValueError: If there is no such quantity, input or parameter.
    """
    try:
        arguments = [x for x in trace(mechanism, name).name_in() if x != "guess"]
    except KeyError as error:
        raise ValueError(f"derivatives: {error.args[0]}") from None
    parameters = tuple(x for x in wrt if x not in arguments)
    links = [body.name for body in mechanism.robot.bodies if body.kind == "link"]
    known = {*ROBOT_PARAMETERS, *(f"{parameter}:{link}" for parameter in LINK_PARAMETERS for link in links)}
    listed = ", ".join([*arguments, *ROBOT_PARAMETERS, *(f"{parameter}:BODY" for parameter in LINK_PARAMETERS)])
    expected = f"{listed}, BODY being a link"
    check_names(f"derivatives of {name}: wrt", wrt, [*arguments, *known], "some of", listed=expected)
    defaults = parameter_defaults(mechanism.robot, mechanism.robot.material, parameters)
    symbols = {x: SX.sym("parameter", len(value)) for x, value in defaults.items()}
    named = with_parameters(mechanism, symbols) if symbols else mechanism
    function = trace(named, name)
    inputs = {x: SX.sym(x, function.numel_in(i)) for i, x in enumerate(function.name_in())}
    outputs = dict(zip(function.name_out(), function.call(list(inputs.values())), strict=True))
    return Quantity(inputs, {x: (symbols[x], defaults[x]) for x in symbols}, outputs, mechanism.robot.layout)


def jacobian_function(quantity: Quantity, wrt: tuple[str, ...]) -> ca.Function:
    """Trace the Jacobian of each output with respect to each of `wrt`, in the tangent space of positions.

    Returns:
        Function of the quantity's inputs -> Jacobians, output by output.
    """
    return quantity.function("jacobian", {}, _jacobians(quantity, wrt))


def product_function(quantity: Quantity, wrt: tuple[str, ...]) -> ca.Function:
    """Trace the derivative of a quantity along a direction (forward mode): at most two to three times its work.

    Returns:
        Function (*inputs, direction of each of `wrt`) -> derivative of each output, as a column.
    """
    x, basis = (list(parts) for parts in zip(*[quantity.along(name) for name in wrt], strict=True))
    directions = [SX.sym("direction", tangent.shape[1]) for tangent in basis]
    moved = ca.vertcat(*[tangent @ direction for tangent, direction in zip(basis, directions, strict=True)])
    changes = [ca.jtimes(ca.vec(output), ca.vertcat(*x), moved) for output in quantity.outputs.values()]
    inputs = {f"direction{i}": direction for i, direction in enumerate(directions)}
    return quantity.function("product", inputs, changes)


def gradient_function(quantity: Quantity, wrt: tuple[str, ...]) -> ca.Function:
    """Trace the gradient of a weighted sum of all outputs (reverse mode): about three times their work, whatever `wrt`.

    Returns:
        Function (*inputs, weights of each output) -> gradient with respect to each of `wrt`.
    """
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
    forward = trace(mechanism, "forward_dynamics")
    inputs = {name: SX.sym(name, forward.numel_in(i)) for i, name in enumerate(forward.name_in())}
    vdot = forward(*inputs.values())
    to_acceleration = ca.triu2symm(ca.triu(ca.densify(ca.jacobian(vdot, inputs["tau"]))))  # M^-1, symmetric
    others = tuple(name for name in wrt if name != "tau")
    inverse = make_quantity(mechanism, "inverse_dynamics", others)
    forces = dict(zip(others, _jacobians(inverse, others), strict=True))
    at = [vdot if name == "vdot" else inputs[name] for name in inverse.inputs]
    results = ca.substitute([to_acceleration @ forces[x] for x in others], list(inverse.inputs.values()), at)
    results = [-results[others.index(x)] if x in others else to_acceleration for x in wrt]
    return Quantity(inputs, inverse.parameters, {}, mechanism.robot.layout).function("jacobian", {}, results)
