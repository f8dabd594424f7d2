"""The quantities of a mechanism on numpy arrays, and their derivatives.

Every quantity is traced once, on first use, into a CasADi function, and evaluated on arrays with any leading batch
shape.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.algebra.batched import evaluate
from ce_gym.dynamics.constraints.closure import closures, reference_guess
from ce_gym.dynamics.constraints.continuation import follow
from ce_gym.dynamics.derivatives import gradient_function, jacobian_function, product_function
from ce_gym.dynamics.functions import FUNCTIONS
from ce_gym.model.coordinates import unit_quaternions
from ce_gym.model.errors import check_names, listed_names
from ce_gym.model.mechanism import Mechanism

Array = NDArray[np.float64]


class Evaluator:
    """Evaluates the quantities of one mechanism.

    Args:
        mechanism: The robot at a transmission level.

    Attributes:
        guess: Dependent coordinates that no formula gives, at the reference pose, shape (n_guess,).
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.robot, self.mechanism = mechanism.robot, mechanism
        self.guess = reference_guess(mechanism)
        self._has_loops = any(closures(mechanism))
        self._functions: dict[str, ca.Function] = {}
        self._derivatives: dict[tuple[str, tuple[str, ...]], Derivatives] = {}

    @property
    def nv(self) -> int:
        """Number of independent velocities, six for a floating base included."""
        return self.robot.layout.nv

    @property
    def nq(self) -> int:
        """Number of position coordinates, seven for a floating base included."""
        return self.robot.layout.nq

    @cached_property
    def standing_q(self) -> Array:
        """The standing pose, upright at the origin, shape (nq,)."""
        return np.array(self.robot.standing_q)

    def casadi_function(self, name: str) -> ca.Function:
        """Return a quantity as a CasADi SX function of column vectors.

        Args:
            name: "forward_dynamics" (q, v, tau) -> vdot; "inverse_dynamics" (q, v, vdot) -> tau; "mass_matrix" q -> M;
                "bias_force" (q, v) -> tau at vdot = 0; "spanning" (q, v) -> (q_span, v_span); "implicit_constraint"
                (q, v) -> (K, k); "body_poses" q -> positions (3, n), rotations (3, 3 n); "body_velocities" (q, v) ->
                angular (3, n), linear (3, n); "contact_points" (q, v) -> positions (3, n), velocities (3, n);
                "contact_accelerations" (q, v, vdot) -> accelerations (3, n); "energy" (q, v) -> kinetic, potential.
                Robots with loops that no formula closes have one input more, see `dependent_guess`. Quaternions in q
                must have unit length: a traced function neither checks nor scales them.

        Raises:
            KeyError: If there is no such quantity.
        """
        if name not in self._functions:
            if name not in FUNCTIONS:
                raise KeyError(f"no function {name!r}; expected one of {listed_names(name, FUNCTIONS)}")
            self._functions[name] = FUNCTIONS[name](self.mechanism)
        return self._functions[name]

    def n_instructions(self, name: str) -> int:
        """Return the number of instructions of a traced quantity, the cost measure of the paper."""
        return self.casadi_function(name).n_instructions()

    def loop_gap(self, q: ArrayLike) -> Array:
        """Return the norm of the residuals of all loops, rods and functions, redundant rows included, shape (...).

        In metres for loops and rods; 0 if there are none, not a number where loops cannot be closed by their formulas.
        """
        return self._evaluate("loops", q)[1][..., 0, 0]

    def nearness(self, q: ArrayLike) -> Array:
        """Return how far a configuration is from a singularity of the independent joints, shape (...).

        It is 1 at the reference pose, and smaller or negative nearer to or beyond a singularity: the smallest
        determinant among the blocks of the constraint Jacobian of the dependent joints, relative to that pose. It is -1
        where the loops cannot be closed.
        """
        return self._evaluate("loops", q)[2][..., 0, 0]

    def dependent_guess(self, q: ArrayLike) -> Array:
        """Return the dependent coordinates that no formula gives, followed from the reference pose to `q`.

        Args:
            q: Positions, shape (..., nq).

        Returns:
            The input `guess` of the traced functions [rad or m], shape (..., n_guess).

        Raises:
            ValueError: If a loop does not close at `q` or on the straight way there.
        """
        q = np.asarray(q, dtype=float)
        if q.ndim == 0 or q.shape[-1] != self.nq:
            raise ValueError(f"q has shape {q.shape}; expected (..., {self.nq})")
        flat = self.unit(q).reshape(-1, self.nq)
        if self.guess.size == 0 or len(flat) == 0:
            return np.zeros((*q.shape[:-1], len(self.guess)))
        guess, gap, nearness = follow(self.casadi_function("loops"), self.standing_q, self.guess, flat)
        if not nearness > 0.0:
            raise ValueError(f"the loops of {self.robot.name} pass a singularity on the way to this q")
        if not gap < 1e-9:
            raise ValueError(f"the loops of {self.robot.name} do not close at this q: gap {gap:.2g}")
        return guess.reshape(*q.shape[:-1], len(self.guess))

    def derivatives(self, name: str, wrt: Sequence[str]) -> Derivatives:
        """Return the derivatives of a quantity, traced on first use.

        Args:
            name: Of a quantity, see `casadi_function`.
            wrt: Its inputs by name, and figures of the robot: "gravity", "rotor_inertia", "ratio", "added_mass:BODY" or
                "com_shift:BODY", see `ce_gym.dynamics.laws.scene_laws.PARAMETERS`.

        Raises:
            ValueError: If there is no such quantity, or it depends on no such thing.

        Examples:
            What heavier rotors would cost in acceleration:

            >>> model = ce_gym.Model("mini_cheetah")
            >>> derivatives = model.derivatives("forward_dynamics", wrt=["rotor_inertia"])
            >>> derivatives.jacobian(model.standing_q, np.zeros(18), np.ones(18))["vdot", "rotor_inertia"].shape
            (18, 1)
        """
        check_names("wrt", wrt, wrt, "an input among")
        key = name, tuple(wrt)
        if key not in self._derivatives:
            self._derivatives[key] = Derivatives(self, *key)
        return self._derivatives[key]

    def forward_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> tuple[Array, Array, Array]:
        """Return how `forward_dynamics` changes with `q`, `v` and `tau`, each of shape (..., nv, nv).

        `q` in its tangent space: a rotation of the base, a translation of it, both in base axes, rotations of ball
        joints, then the other joints.
        The last is the inverse of the mass matrix.
        """
        inputs = ("q", "v", "tau")
        jacobians = self.derivatives("forward_dynamics", inputs).jacobian(q, v, tau)
        return jacobians["vdot", "q"], jacobians["vdot", "v"], jacobians["vdot", "tau"]

    def inverse_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> tuple[Array, Array, Array]:
        """Return how `inverse_dynamics` changes with `q`, `v` and `vdot`, each of shape (..., nv, nv).

        `q` in its tangent space, see `forward_dynamics_derivatives`. The last is the mass matrix.
        """
        inputs = ("q", "v", "vdot")
        jacobians = self.derivatives("inverse_dynamics", inputs).jacobian(q, v, vdot)
        return jacobians["tau", "q"], jacobians["tau", "v"], jacobians["tau", "vdot"]

    def unit(self, q: Array) -> Array:
        """Return positions, shape (..., nq), with quaternions of unit length; ValueError if they are far from it."""
        fits = q.ndim > 0 and q.shape[-1] == self.nq  # other shapes are refused where they are used
        return unit_quaternions(q, [i for i, _ in self.robot.layout.turns]) if fits else q

    def _evaluate(self, name: str, *arguments: ArrayLike) -> list[Array]:
        """Evaluate a traced quantity on arrays that share leading batch dimensions; outputs (..., rows, columns)."""
        return self.evaluate(self.casadi_function(name), *arguments)

    def evaluate(self, function: ca.Function, *arguments: ArrayLike) -> list[Array]:
        """Evaluate a function of `q`, among others, on arrays that share leading batch dimensions.

        Args:
            function: Of column vectors, perhaps a guess of dependent coordinates as the last.
            arguments: All but that guess, shape (..., n) each.

        Returns:
            Its outputs, shape (..., rows, columns).

        Raises:
            ValueError: If a shape is wrong, or a loop does not close at `q`.
        """
        arrays = [np.asarray(a, dtype=float) for a in arguments]
        arrays = [self.unit(a) if name == "q" else a for name, a in zip(function.name_in(), arrays, strict=False)]
        if "guess" in function.name_in():
            arrays.append(self.dependent_guess(arrays[0]))
        results = evaluate(function, arrays)
        unusable, given = any(np.isnan(r).any() for r in results), not any(np.isnan(a).any() for a in arrays)
        if self._has_loops and function.name() != "loops" and unusable and given:
            raise ValueError(f"{function.name()}: the loops of {self.robot.name} cannot be closed at this q")
        return results


class Derivatives:
    """Derivatives of one quantity; made by `Model.derivatives`.

    Positions are differentiated in their tangent space: a rotation of the base, a translation of it, both in base axes,
    rotations of ball joints, then the other joints. Figures of the robot are differentiated at the values that it has.

    Args:
        evaluator: Of the mechanism.
        name: Of the quantity.
        wrt: With respect to what.
    """

    def __init__(self, evaluator: Evaluator, name: str, wrt: tuple[str, ...]) -> None:
        if not wrt:
            raise ValueError(f"derivatives of {name} with respect to nothing; expected names of inputs or figures")
        self._evaluator, self.name, self.wrt = evaluator, name, wrt
        self._functions: dict[str, ca.Function] = {}
        self.casadi_function("product")  # raises what there is to raise

    def casadi_function(self, kind: str) -> ca.Function:
        """Return a derivative as a CasADi SX function: "jacobian", "product" or "gradient"."""
        make = {"jacobian": jacobian_function, "product": product_function, "gradient": gradient_function}
        if kind not in self._functions:
            self._functions[kind] = make[kind](self._evaluator.mechanism, self.name, self.wrt)
        return self._functions[kind]

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what the quantity consists of."""
        return tuple(self._evaluator.casadi_function(self.name).name_out())

    def jacobian(self, *arguments: ArrayLike) -> dict[tuple[str, str], Array]:
        """Return the Jacobians by output and what it is differentiated by, shape (..., n_output, n_input) each.

        Args:
            arguments: Inputs of the quantity, shape (..., n) each.
        """
        results = self._evaluator.evaluate(self.casadi_function("jacobian"), *arguments)
        return dict(zip([(output, x) for output in self.outputs for x in self.wrt], results, strict=True))

    def product(self, *arguments: ArrayLike, directions: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Return how the outputs change along a direction, shape (..., n_output) each: forward mode.

        Args:
            arguments: Inputs of the quantity, shape (..., n) each.
            directions: Of all that it is differentiated by, tangents of positions, shape (..., n_input) each.
        """
        given = [directions[x] for x in self.wrt]
        results = self._evaluator.evaluate(self.casadi_function("product"), *arguments, *given)
        return {name: result[..., 0] for name, result in zip(self.outputs, results, strict=True)}

    def gradient(self, *arguments: ArrayLike, weights: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Return the gradient of the weighted sum of all outputs, shape (..., n_input) each: reverse mode.

        Args:
            arguments: Inputs of the quantity, shape (..., n) each.
            weights: Of all outputs, shape (..., n_output) each.
        """
        given = [weights[name] for name in self.outputs]
        results = self._evaluator.evaluate(self.casadi_function("gradient"), *arguments, *given)
        return {name: result[..., 0] for name, result in zip(self.wrt, results, strict=True)}
