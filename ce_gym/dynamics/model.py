"""`Model`: one robot at one transmission level, and its dynamics on numpy arrays.

Each quantity is traced once, on first use, into a CasADi function, and compiled, see `Model.evaluate`. The methods take
arrays with any leading batch shape. To step thousands of robots in time, use `ce_gym.Simulator`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.batched_function import CLOSED, BatchedFunction
from ce_gym.dynamics.constraints.closure import closures, loop_report, reference_guess
from ce_gym.dynamics.constraints.continuation import Continuation
from ce_gym.dynamics.derivatives import Derivatives
from ce_gym.dynamics.functions import trace
from ce_gym.dynamics.quantities.configurations import neutral_positions, random_positions
from ce_gym.dynamics.quantities.forces import inertial_parameters
from ce_gym.dynamics.quantities.frames import frames_of
from ce_gym.dynamics.standing import check_standing
from ce_gym.model import Robot, check_robot, load_robot
from ce_gym.model.arguments import check_choice, check_whole
from ce_gym.model.clusters import ClusterTree
from ce_gym.model.coordinates import unit_quaternions
from ce_gym.model.errors import check_names
from ce_gym.model.frames import added
from ce_gym.model.mechanism import build_mechanism

Array = NDArray[np.float64]

REDUNDANT = {"float64": 1e-10, "float32": 1e-5}
"""Relative size of eigenvalues of `J M^-1 J^T` that count as zero, by type of numbers [-]."""


class Model:
    """The dynamics of one robot at one transmission level.

    `q = [base position (3) [m], base quaternion wxyz (4), quaternion of each ball joint (4), independent joint
    positions]`, `v = [base angular (3) [rad/s], base linear (3) [m/s], angular velocity of each ball joint (3) [rad/s],
    joint velocities]`. Base velocities are in the base frame. The angular velocity of a ball joint is relative to the
    parent, in the axes of the moving body. A fixed base has only the joints. `vdot` is the time derivative of `v`.
    Quaternions whose norm is within 1e-3 of 1 are scaled to unit length; others are refused with a ValueError.

    Args:
        robot: A description, the name of a robot that ships with the package, or a path to a robot file.
        transmission: "exact", "coupled", "armature" or "none"; or "elastic", where stretches of elastic transmissions
            (`Elasticity`, radians of the rotor) follow the joints in `q` and `v`.
        locked_rotors: Whether approximated rotors leave their mass and inertia at rest with their carrier, so that
            total mass is the same at every level. False deletes them, as the paper does in its figures.
        eliminate_rotors: Whether rotors that need no body are eliminated at the exact level. False runs the general
            algorithm, with every rotor a body: the same result, for more work.
        dtype: "float64" or "float32" for arithmetic and results.
        num_threads: Threads that share the robots of a call; results do not depend on the number.

    Attributes:
        guess: Dependent coordinates that no formula gives, at the reference pose [rad or m], shape (n_guess,).

    Raises:
        RobotError: If the robot file or the level is not valid, or the robot cannot stand in its standing pose: its
            mass matrix is not positive definite, a joint is beyond its limits, contacts are below ground.

    Examples:
        >>> model = ce_gym.Model("tello", transmission="exact")
        >>> model
        Model('tello', transmission='exact', nq=17, nv=16)
        >>> model.mass_matrix(np.tile(model.standing_q, (100, 1))).shape
        (100, 16, 16)
    """

    def __init__(
        self,
        robot: Robot | str | Path,
        transmission: str = "exact",
        *,
        locked_rotors: bool = True,
        eliminate_rotors: bool = True,
        dtype: str = "float64",
        num_threads: int = 1,
    ) -> None:
        check_choice("dtype", dtype, ("float64", "float32"))
        check_whole("num_threads", num_threads, 1)
        described = robot if isinstance(robot, Robot) else load_robot(robot)
        if described is robot:  # files have been checked
            check_robot(described)
        self.transmission, self.dtype, self.num_threads = transmission, dtype, num_threads
        self.locked_rotors = locked_rotors
        self.eliminate_rotors = eliminate_rotors
        self.mechanism = build_mechanism(
            described, transmission, locked_rotors=locked_rotors, eliminate=eliminate_rotors
        )
        self.robot = self.mechanism.robot
        self.guess = reference_guess(self.mechanism)
        self._has_loops = any(closures(self.mechanism))
        self._functions: dict[str, ca.Function] = {}
        self._batched: dict[str | ca.Function, BatchedFunction] = {}
        self._derivatives: dict[tuple[str, tuple[str, ...]], Derivatives] = {}
        check_standing(self.mechanism)

    def __repr__(self) -> str:
        return f"Model({self.robot.name!r}, transmission={self.transmission!r}, nq={self.nq}, nv={self.nv})"

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_batched": {}}  # kernels are loaded again

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

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the independent joints, in the order of the joint coordinates, see `Robot.joint_name`."""
        return self.robot.joint_names

    @property
    def joint_links(self) -> tuple[str, ...]:
        """The link that each independent joint moves, in the order of the joint coordinates."""
        return self.robot.commanded

    @property
    def cluster_tree(self) -> ClusterTree:
        """The clusters of the robot, parents first."""
        return self.mechanism.tree

    @property
    def total_mass(self) -> float:
        """Mass of all bodies, the same at every level unless locked rotors are deleted [kg]."""
        deleted = not self.locked_rotors and not self.mechanism.exact
        return self.robot.total_mass - (added(r.inertial.mass for r in self.robot.rotors()) if deleted else 0.0)

    @property
    def body_names(self) -> tuple[str, ...]:
        """All bodies, rotors included, in the order of `body_poses`."""
        return tuple(body.name for body in self.robot.bodies)

    @property
    def spanning_names(self) -> tuple[str, ...]:
        """The body that each spanning joint moves, in the order of `spanning`, the floating base not included."""
        return self.robot.joints

    @property
    def contact_names(self) -> tuple[str, ...]:
        """The contact spheres, in the order of contact outputs."""
        return tuple(contact.name for contact in self.robot.contacts)

    def casadi_function(self, name: str) -> ca.Function:
        """Return a quantity as a CasADi SX function of column vectors.

        Args:
            name: The quantity.

                - "forward_dynamics": (q, v, tau) -> vdot.
                - "inverse_dynamics": (q, v, vdot) -> tau.
                - "mass_matrix": q -> M.
                - "bias_force": (q, v) -> tau at vdot = 0.
                - "spanning": (q, v) -> q_span, v_span.
                - "implicit_constraint": (q, v) -> K, k.
                - "body_poses": q -> positions (3, n), rotations (3, 3 n).
                - "body_velocities": (q, v) -> angular (3, n), linear (3, n).
                - "contact_points": (q, v) -> positions (3, n), velocities (3, n).
                - "contact_accelerations": (q, v, vdot) -> accelerations (3, n).
                - "contact_jacobian": q -> J (3 n, nv).
                - "contact_bias_acceleration": (q, v) -> accelerations (3, n).
                - "contact_points:CONTACT,CONTACT" and so on: the same of some contacts, in this order.
                - "energy": (q, v) -> kinetic, potential.
                - "frame_pose:FRAME", "frame_jacobian:FRAME": q -> position, rotation; J.
                - "frame_velocity:FRAME", "frame_bias_acceleration:FRAME": (q, v) -> the method's result.
                - "center_of_mass", "center_of_mass_jacobian", "centroidal_momentum_matrix",
                  "gravity_force": q -> the method's result.
                - "center_of_mass_velocity", "center_of_mass_bias_acceleration", "centroidal_momentum",
                  "centroidal_momentum_bias", "coriolis_matrix": (q, v) -> the method's result.
                - "inertial_regressor": (q, v, vdot) -> Y.
                - "integrate", "difference": (q, dv) -> q; (q, q1) -> dv.

        Robots with loops that no formula closes have one more input, see `dependent_guess`. Quaternions in `q` must
        have unit length: a traced function neither checks nor scales them.

        Raises:
            KeyError: If there is no such quantity.
        """
        if name not in self._functions:
            self._functions[name] = trace(self.mechanism, name)
        return self._functions[name]

    def n_instructions(self, name: str) -> int:
        """Return the number of instructions of a traced quantity, the cost measure of the paper."""
        return self.casadi_function(name).n_instructions()

    def evaluate(self, function: str | ca.Function, *arguments: ArrayLike) -> list[Array]:
        """Evaluate a function of `q`, among others, on arrays that share leading batch dimensions.

        The first call compiles the function in 0.05 to 2 seconds; later processes find it in the folder of kernels.
        Functions of more than 25,000 instructions, such as Jacobians of large robots, are interpreted for the first
        5000 robots and then compiled. Interpreted and compiled results differ by rounding.

        Args:
            function: Name of a quantity, see `casadi_function`, or a function of column vectors.
            arguments: Its inputs but for the guess of dependent coordinates, shape (..., n) each.

        Returns:
            Its outputs, shape (..., rows, columns). Of a quantity but "loops", all entries of a robot are nan if an
            entry of `q` or of the results is not finite.

        Raises:
            ValueError: If a shape is wrong, or a loop does not close at `q`.
        """
        batched = self._batched.get(function) or self._batched_function(function)
        results, are_numbers = batched(*arguments)
        if not are_numbers:
            self._check_results(batched, arguments, results)
        return results

    def _batched_function(self, function: str | ca.Function) -> BatchedFunction:
        """Return the kernel of a quantity, see `evaluate`."""
        if function not in self._batched:
            traced: ca.Function = self.casadi_function(function) if isinstance(function, str) else function
            name = f"{self.robot.name} {self.transmission} {traced.name()}"
            turns = [i for i, _ in self.robot.layout.turns]
            nan_rows = isinstance(function, str) and function != "loops"  # which tells what does not close
            self._batched[function] = BatchedFunction(
                name, traced, turns, self._continuation, self.dtype, self.num_threads, nan_rows
            )
        return self._batched[function]

    def _check_results(self, batched: BatchedFunction, arguments: Sequence[ArrayLike], results: list[NDArray]) -> None:
        """Raise the error of a finite state that has no results."""
        arrays = {x: np.asarray(a, dtype=float) for x, a in zip(batched.inputs, arguments, strict=True)}
        are_finite = {x: np.isfinite(array).all(-1) for x, array in arrays.items()}
        if "q" in arrays:
            self.dependent_guess(np.where(np.expand_dims(are_finite["q"], -1), arrays["q"], self.standing_q))
        name, has_nan = batched.function.name(), np.any([np.isnan(r).any((-2, -1)) for r in results], axis=0)
        is_wrong = has_nan & np.all(np.broadcast_arrays(*are_finite.values()), axis=0)
        if self._has_loops and name != "loops" and is_wrong.any():
            raise ValueError(f"{name}: the loops of {self.robot.name} cannot be closed at this q")

    def forward_dynamics(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike, wrenches: dict[str, ArrayLike] | None = None
    ) -> Array:
        """Return the acceleration `vdot`, shape (..., nv), that forces produce.

        Args:
            q: Positions, shape (..., nq).
            v: Velocities, shape (..., nv).
            tau: Generalised forces [N m or N], base wrench [moment; force] in the base frame first, shape (..., nv).
            wrenches: Wrenches [moment about the world's origin; force] on bodies, world axes [N m, N], by name of the
                body, shape (..., 6) each.

        Raises:
            ValueError: If a shape is wrong, a body does not exist, or a loop does not close at `q`.

        Source: CE-ABA, Chignoli, Adrian, Kim, Wensing, "A Propagation Perspective on Recursive Forward Dynamics for
        Systems with Kinematic Loops", arXiv:2311.13732, Algorithm 1.

        Examples:
            >>> model = ce_gym.Model("mini_cheetah")
            >>> vdot = model.forward_dynamics(model.standing_q, np.zeros(model.nv), np.zeros(model.nv))
            >>> print(f"{vdot[5]:.2f} m/s²")
            -9.81 m/s²
        """
        if wrenches is None:
            return self.evaluate("forward_dynamics", q, v, tau)[0][..., 0]
        check_names("wrenches", wrenches, self.body_names, f"the name of a body of {self.robot.name}:")
        rows = [np.asarray(wrenches.get(name, np.zeros(6)), dtype=float) for name in self.body_names]
        stacked = np.concatenate(np.broadcast_arrays(*rows), axis=-1)
        return self.evaluate("forward_dynamics_with_wrenches", q, v, tau, stacked)[0][..., 0]

    def inverse_dynamics(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> Array:
        """Return the generalised force, shape (..., nv) [N m or N], that produces the acceleration `vdot` (..., nv)."""
        return self.evaluate("inverse_dynamics", q, v, vdot)[0][..., 0]

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return the mass matrix of the independent coordinates, shape (..., nv, nv)."""
        return self.evaluate("mass_matrix", q)[0]

    def bias_force(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return Coriolis, centrifugal, gyroscopic and gravity forces, `M vdot + bias = tau`, shape (..., nv)."""
        return self.evaluate("bias_force", q, v)[0][..., 0]

    def spanning(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """Return positions and velocities of every joint, rotors included, in the order of `robot.bodies`.

        A floating base has 7 positions and 6 velocities, a ball joint 4 and 3: shapes (..., nq_span) and
        (..., nv_span). `robot.spanning_rows` has the rows of each joint.
        """
        q_span, v_span = self.evaluate("spanning", q, v)
        return q_span[..., 0], v_span[..., 0]

    def from_spanning(self, q_span: ArrayLike, v_span: ArrayLike) -> tuple[Array, Array]:
        """Return the `q` and `v` of a configuration given by every joint, in the order of `spanning`.

        Args:
            q_span: Positions, shape (..., nq_span).
            v_span: Velocities, shape (..., nv_span).

        Raises:
            ValueError: If the constraints are not met, to 1e-6 or in single precision 1e-4, or are met in
                another way than the robot's reference pose is assembled.
        """
        q_span, v_span = np.asarray(q_span, dtype=float), np.asarray(v_span, dtype=float)
        span = self.robot.spanning_rows
        q = q_span[..., [row for name in self.robot.rows for row in span[name][0]]]
        q, v = self.unit(q), v_span[..., [row for name in self.robot.rows for row in span[name][1]]]
        expected, angles = self.spanning(q, v), [rows[0] for rows, _ in span.values() if len(rows) == 1]
        turned = np.exp(1j * (expected[0] - q_span)[..., angles]) - 1  # whole turns do not matter
        for name, error in (("q_span", turned), ("v_span", expected[1] - v_span)):
            if error.size and np.abs(error).max() > (1e-6 if self.dtype == "float64" else 1e-4):
                raise ValueError(f"{name} misses the constraints of {self.robot.name} by {np.abs(error).max():.2g}")
        return q, v

    def spanning_acceleration(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> Array:
        """Return accelerations of every joint, in the order of `spanning` velocities, shape (..., nv_span)."""
        return self.evaluate("spanning_acceleration", q, v, vdot)[0][..., 0]

    def explicit_constraint(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """Return `G` and `g`, which give the motion of every joint: `v_span = G v`, `vdot_span = G vdot + g`.

        Args:
            q: Positions, shape (..., nq).
            v: Velocities, shape (..., nv).

        Returns:
            `G`, shape (..., nv_span, nv), and `g`, shape (..., nv_span), rows in the order of `spanning` velocities.

        Raises:
            ValueError: If a shape is wrong, or a loop does not close at `q`.

        Source: arXiv:2311.13732, explicit constraints; the base's six velocities have ones in `G` and zeros in `g`.
        """
        g = self.spanning_acceleration(q, v, np.zeros(self.nv))
        G = self.evaluate("spanning_jacobian", q)[0]
        return np.broadcast_to(G, (*g.shape[:-1], *G.shape[-2:])), g

    def implicit_constraint(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """Return `K` and `k` of the constraints among all joints: `K v_span = 0`, `K vdot_span = k`.

        One row for each constraint that the others do not imply, cluster by cluster, the linear ones first. Away from
        singularities `K` has full rank, and its null space is the column space of `G`.

        Args:
            q: Positions, shape (..., nq).
            v: Velocities, shape (..., nv).

        Returns:
            `K`, shape (..., nv_span - nv, nv_span), and `k`, shape (..., nv_span - nv), columns in the order of
            `spanning` velocities. Rows of loops are in metres or without unit, of rods in square metres.

        Raises:
            ValueError: If a shape is wrong, or a loop does not close at `q`.

        Source: arXiv:2311.13732, implicit constraints `phi(q_span) = 0`.
        """
        K, k = self.evaluate("implicit_constraint", q, v)
        return K, k[..., 0]

    def actuator_matrix(self, q: ArrayLike, actuated: Sequence[str] | None = None) -> Array:
        """Return `W`, shape (..., n, nv), that takes efforts of actuators to generalised forces, `tau = W^T effort`.

        Row i is the velocity of actuator i for unit independent velocities, whichever joints are actuated and however
        many (footnote on general actuation of arXiv:2311.13732).

        Args:
            q: Positions, shape (..., nq).
            actuated: Bodies whose joints are actuated; the rotors of the robot's motors if None.

        Raises:
            ValueError: If a body does not exist.
        """
        chosen = [motor.rotor for motor in self.robot.motors] if actuated is None else actuated
        expected = f"the name of a body with a joint of {self.robot.name}:"
        check_names("actuated", chosen, self.spanning_names, expected)
        G = self.evaluate("spanning_jacobian", q)[0]
        return G[..., [row for name in chosen for row in self.robot.spanning_rows[name][1]], :]

    def body_poses(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return where all bodies are, in the order of `body_names`.

        Returns:
            Origins in the world [m], shape (..., n, 3), and rotations body to world, shape (..., n, 3, 3).
        """
        positions, rotations = self.evaluate("body_poses", q)
        n = positions.shape[-1]
        stacked = rotations.reshape(*rotations.shape[:-1], n, 3)  # (..., row, body, column)
        return np.swapaxes(positions, -1, -2), np.moveaxis(stacked, -2, -3)

    def body_velocities(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """Return how all bodies move, in the order of `body_names`.

        Returns:
            Angular velocities [rad/s] and velocities of the origins [m/s], world axes, each shape (..., n, 3).
        """
        angular, linear = self.evaluate("body_velocities", q, v)
        return np.swapaxes(angular, -1, -2), np.swapaxes(linear, -1, -2)

    def contact_points(self, q: ArrayLike, v: ArrayLike, contacts: Sequence[str] | None = None) -> tuple[Array, Array]:
        """Return centres [m] and velocities [m/s] of contact spheres in the world, each shape (..., n, 3).

        For a sphere that moves around a rim, the centre and velocity of the rim.

        Args:
            q: Positions, shape (..., nq).
            v: Velocities, shape (..., nv).
            contacts: Names of the contacts, some of `contact_names`; all if None.

        Raises:
            ValueError: If a shape is wrong, a contact does not exist, or a loop does not close at `q`.
        """
        position, velocity = self.evaluate(self._of_contacts("contact_points", contacts), q, v)
        return np.swapaxes(position, -1, -2), np.swapaxes(velocity, -1, -2)

    def contact_accelerations(
        self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike, contacts: Sequence[str] | None = None
    ) -> Array:
        """Return the accelerations of the centres of contact spheres in the world, shape (..., n, 3) [m/s^2].

        Second derivatives of their positions, for the acceleration `vdot` (..., nv): a robot at rest has none.
        `contacts` are as in `contact_points`.
        """
        return np.swapaxes(self.evaluate(self._of_contacts("contact_accelerations", contacts), q, v, vdot)[0], -1, -2)

    def energy(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """Return kinetic and potential energy [J], each shape (...)."""
        kinetic, potential = self.evaluate("energy", q, v)
        return kinetic[..., 0, 0], potential[..., 0, 0]

    @cached_property
    def frame_names(self) -> tuple[str, ...]:
        """Names of all frames.

        Bodies, rotors included; frames of the robot's file, such as links on fixed joints and sites of MJCF; contacts,
        if no other frame has the name. The frame of a body is at its joint. The frame of a contact is at the centre of
        the sphere and has the axes of the body.
        """
        return tuple(frames_of(self.mechanism))

    def frame_pose(self, q: ArrayLike, frame: str) -> tuple[Array, Array]:
        """Return where a frame is.

        Args:
            q: Positions, shape (..., nq).
            frame: Name of the frame, one of `frame_names`.

        Returns:
            Origin in the world [m], shape (..., 3), and rotation frame to world, shape (..., 3, 3).

        Raises:
            ValueError: If a shape is wrong, the frame does not exist, or a loop does not close at `q`.

        Examples:
            >>> model = ce_gym.Model("go1")
            >>> position, rotation = model.frame_pose(model.standing_q, "imu_link")
            >>> velocity = model.frame_jacobian(model.standing_q, "FL_foot") @ np.ones(model.nv)
        """
        position, rotation = self.evaluate(self._of_frame("frame_pose", frame), q)
        return position[..., 0], rotation

    def frame_velocity(self, q: ArrayLike, v: ArrayLike, frame: str) -> Array:
        """Return the velocity of a frame, [angular [rad/s]; linear [m/s]], shape (..., 6).

        Linear is the velocity of the frame's origin. Both are in the axes of the world, as with
        `LOCAL_WORLD_ALIGNED` in Pinocchio.
        """
        return self.evaluate(self._of_frame("frame_velocity", frame), q, v)[0][..., 0]

    def frame_jacobian(self, q: ArrayLike, frame: str) -> Array:
        """Return the Jacobian of a frame, `frame_velocity = J v`, shape (..., 6, nv).

        Rows are [angular; linear], at the frame's origin in the axes of the world. `J^T` takes a wrench [moment; force]
        at the frame's origin, in the axes of the world, to generalised forces.
        """
        return self.evaluate(self._of_frame("frame_jacobian", frame), q)[0]

    def frame_bias_acceleration(self, q: ArrayLike, v: ArrayLike, frame: str) -> Array:
        """Return the acceleration of a frame for `vdot = 0`, `Jdot v`, shape (..., 6).

        `frame_jacobian @ vdot + frame_bias_acceleration` is the time derivative of `frame_velocity`: [angular
        [rad/s^2]; second derivative of the origin's position [m/s^2]], in the axes of the world, without gravity.
        """
        return self.evaluate(self._of_frame("frame_bias_acceleration", frame), q, v)[0][..., 0]

    def _of_frame(self, quantity: str, frame: str) -> str:
        """Return the name of the traced function of a quantity of a frame."""
        if frame not in self.frame_names:
            check_names("frame", [frame], self.frame_names, f"a frame of {self.robot.name}:")
        return f"{quantity}:{frame}"

    def contact_jacobian(self, q: ArrayLike, contacts: Sequence[str] | None = None) -> Array:
        """Return the Jacobians of the centres of contact spheres, shape (..., n, 3, nv).

        `J v` are the velocities that `contact_points` returns, in the axes of the world.

        Args:
            q: Positions, shape (..., nq).
            contacts: Names of the contacts, some of `contact_names`; all if None.

        Raises:
            ValueError: If a shape is wrong, a contact does not exist, or a loop does not close at `q`.
        """
        J = self.evaluate(self._of_contacts("contact_jacobian", contacts), q)[0]
        return J.reshape(*J.shape[:-2], J.shape[-2] // 3, 3, self.nv)

    def contact_bias_acceleration(self, q: ArrayLike, v: ArrayLike, contacts: Sequence[str] | None = None) -> Array:
        """Return the accelerations of the centres of contact spheres for `vdot = 0`, shape (..., n, 3) [m/s^2].

        `contact_jacobian @ vdot + contact_bias_acceleration` are the `contact_accelerations`. `contacts` are as in
        `contact_jacobian`.
        """
        accelerations = self.evaluate(self._of_contacts("contact_bias_acceleration", contacts), q, v)[0]
        return np.swapaxes(accelerations, -1, -2)

    def _of_contacts(self, quantity: str, contacts: Sequence[str] | None) -> str:
        """Return the name of the traced function of a quantity of contacts."""
        if contacts is None:
            return quantity
        check_names("contacts", contacts, self.contact_names, f"a contact of {self.robot.name}:")
        return f"{quantity}:{','.join(contacts)}"

    def center_of_mass(self, q: ArrayLike) -> Array:
        """Return the centre of mass of the robot in the world [m], shape (..., 3)."""
        return self.evaluate("center_of_mass", q)[0][..., 0]

    def center_of_mass_velocity(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the velocity of the centre of mass, world axes [m/s], shape (..., 3)."""
        return self.evaluate("center_of_mass_velocity", q, v)[0][..., 0]

    def center_of_mass_jacobian(self, q: ArrayLike) -> Array:
        """Return the Jacobian of the centre of mass, `center_of_mass_velocity = J v`, shape (..., 3, nv)."""
        return self.evaluate("center_of_mass_jacobian", q)[0]

    def center_of_mass_bias_acceleration(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the acceleration of the centre of mass for `vdot = 0`, world axes [m/s^2], shape (..., 3)."""
        return self.evaluate("center_of_mass_bias_acceleration", q, v)[0][..., 0]

    def centroidal_momentum(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the momentum [angular [kg m^2/s]; linear [kg m/s]], shape (..., 6).

        Angular is about the centre of mass, both are in the axes of the world. Spinning rotors contribute at the levels
        whose equations of motion contain their coupling to the carrier, "exact" and "elastic".
        """
        return self.evaluate("centroidal_momentum", q, v)[0][..., 0]

    def centroidal_momentum_matrix(self, q: ArrayLike) -> Array:
        """Return the matrix `A` of `centroidal_momentum = A v`, shape (..., 6, nv)."""
        return self.evaluate("centroidal_momentum_matrix", q)[0]

    def centroidal_momentum_bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the time derivative of `centroidal_momentum` for `vdot = 0`, `Adot v`, shape (..., 6)."""
        return self.evaluate("centroidal_momentum_bias", q, v)[0][..., 0]

    def coriolis_matrix(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the matrix `C` of `M vdot + C v + g = tau`, shape (..., nv, nv); `Mdot - 2 C` is skew-symmetric.

        The factorisation has Christoffel's symbols, extended to the base and to ball joints, as in Pinocchio.
        """
        return self.evaluate("coriolis_matrix", q, v)[0]

    def gravity_force(self, q: ArrayLike) -> Array:
        """Return the generalised force `g` that holds the robot still, `M vdot + C v + g = tau`, shape (..., nv).

        Drake's gravity forces have the opposite sign.
        """
        return self.evaluate("gravity_force", q)[0][..., 0]

    def operational_space_inertia(self, q: ArrayLike, frame: str) -> Array:
        """Return the inertia of the robot at a frame, `(J M^-1 J^T)^-1`, shape (..., 6, 6).

        `J` is `frame_jacobian`: axes of the world, angular part first.

        Raises:
            ValueError: If a shape is wrong, the frame does not exist or cannot move in all six directions at `q`.

        Source: Khatib, "A unified approach for motion and force control of robot manipulators: the operational space
        formulation", IEEE J. Robotics and Automation 3, 1987.
        """
        J = self.frame_jacobian(q, frame)
        inverse = J @ np.linalg.solve(self.mass_matrix(q), np.swapaxes(J, -1, -2))
        values = np.linalg.eigvalsh(inverse)
        if (values[..., 0] <= REDUNDANT[inverse.dtype.name] * values[..., -1]).any():
            raise ValueError(f"frame={frame!r} cannot move in all six directions at this q; expected a frame that can")
        return np.linalg.inv(inverse).astype(J.dtype)

    def constrained_forward_dynamics(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike, frames: Sequence[str]
    ) -> tuple[Array, Array]:
        """Return the acceleration of a robot whose frames are held, and the forces that hold them.

        Solves `M vdot + h = tau + J^T f`, `J vdot + Jdot v = 0`: the origins of the frames do not accelerate, whatever
        the direction of the forces, so contacts neither slip nor lift off. Of redundant constraints, such as four
        corners of a sole, the forces with the smallest norm are returned. Constraints that contradict each other are
        met as closely as possible.

        Args:
            q: Positions, shape (..., nq).
            v: Velocities, shape (..., nv).
            tau: Generalised forces [N m or N], shape (..., nv).
            frames: Names of the frames, contacts for example.

        Returns:
            `vdot`, shape (..., nv), and the force on each frame's origin in the axes of the world [N], shape
            (..., n, 3).

        Raises:
            ValueError: If a shape is wrong, a frame does not exist, or a loop does not close at `q`.
        """
        check_names("frames", frames, self.frame_names, f"a frame of {self.robot.name}:")
        free = self.forward_dynamics(q, v, tau)
        batch = free.shape[:-1]
        if not frames:
            return free, np.zeros((*batch, 0, 3))
        J = np.concatenate([self.frame_jacobian(q, frame)[..., 3:, :] for frame in frames], axis=-2)
        bias = np.concatenate([self.frame_bias_acceleration(q, v, frame)[..., 3:] for frame in frames], axis=-1)
        response = np.linalg.solve(self.mass_matrix(q), np.swapaxes(J, -1, -2))  # M^-1 J^T
        acceleration = (J @ free[..., None])[..., 0] + bias
        inverse = np.linalg.pinv(J @ response, REDUNDANT[J.dtype.name], hermitian=True)
        force = -inverse @ acceleration[..., None]
        return free + (response @ force)[..., 0], force.reshape(*batch, len(frames), 3)

    def integrate(self, q: ArrayLike, dv: ArrayLike) -> Array:
        """Return the positions after unit time at the constant velocity `dv` (..., nv) from `q`, shape (..., nq).

        A floating base moves along a screw, because its velocity is constant in its axes: as in Pinocchio. MuJoCo's
        `mj_integratePos` moves it along a straight line.
        """
        return self.evaluate("integrate", q, dv)[0][..., 0]

    def difference(self, q0: ArrayLike, q1: ArrayLike) -> Array:
        """Return the velocity, shape (..., nv), that moves `q0` to `q1` in unit time: `integrate(q0, dv) = q1`.

        Rotations are at most half a turn.
        """
        return self.evaluate("difference", q0, self.unit(np.asarray(q1, dtype=float)))[0][..., 0]

    def neutral(self) -> Array:
        """Return positions with all joints at zero and no rotation of base and ball joints, shape (nq,).

        Closed loops need not close there; they do in `standing_q`.
        """
        return neutral_positions(self.robot.layout)

    def random_configuration(self, rng: np.random.Generator) -> Array:
        """Return random positions within the limits of the independent joints, with closed loops, shape (nq,).

        Joints are uniform between their limits; without a limit, up to half a turn or 1 m beyond the standing pose. The
        base is within 1 m of the origin along each axis, with a uniform orientation. Ball joints turn about random
        axes. If loops do not close, the joints are moved towards the standing pose until the loops close.
        """
        q, first = random_positions(self.robot, rng), self.robot.layout.joints_q
        drawn, standing = q[first:].copy(), self.standing_q[first:]
        for distance in 0.9 ** np.arange(100):
            if self._closes(q):
                break
            q[first:] = standing + distance * (drawn - standing)
        return q

    def _closes(self, q: Array) -> bool:
        """Whether the loops close at positions (nq,)."""
        loops = self.casadi_function("loops")
        try:
            guess = [self.dependent_guess(q)] if "guess" in loops.name_in() else []
        except ValueError:
            return False
        _, gap, nearness = loops(q, *guess)
        return float(gap) < 1e-9 and float(nearness) > 0.0

    @property
    def inertial_parameters(self) -> Array:
        """Ten parameters of each body, rotors included, in the order of `body_names`, shape (10 n_bodies,).

        Mass, mass times centre of mass (3), and xx, xy, yy, xz, yz, zz of the inertia about the body's origin, in its
        axes: the order of Pinocchio's `Inertia.toDynamicParameters`.
        """
        return inertial_parameters(self.robot)

    def inertial_regressor(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> Array:
        """Return the matrix `Y` of `inverse_dynamics = Y inertial_parameters`, shape (..., nv, 10 n_bodies)."""
        return self.evaluate("inertial_regressor", q, v, vdot)[0]

    def derivatives(self, name: str, wrt: Sequence[str]) -> Derivatives:
        """Return the derivatives of a quantity, traced on first use.

        Args:
            name: Name of the quantity, see `casadi_function`.
            wrt: Names of its inputs, and parameters of the robot: "gravity", "rotor_inertia", "ratio",
                "added_mass:BODY" or "com_shift:BODY", see `ce_gym.dynamics.laws.scene_laws.PARAMETERS`.

        Raises:
            ValueError: If there is no such quantity, input or parameter.

        Examples:
            The effect of heavier rotors on the acceleration:

            >>> model = ce_gym.Model("mini_cheetah")
            >>> derivatives = model.derivatives("forward_dynamics", wrt=["rotor_inertia"])
            >>> derivatives.jacobian(model.standing_q, np.zeros(18), np.ones(18))["vdot", "rotor_inertia"].shape
            (18, 1)
        """
        check_names("wrt", wrt, wrt, "an input among")
        key = name, tuple(wrt)
        if key not in self._derivatives:
            self._derivatives[key] = Derivatives(self.mechanism, *key, self.evaluate)
        return self._derivatives[key]

    def forward_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the derivatives of `vdot` of `forward_dynamics` by `q`, `v` and `tau`, each shape (..., nv, nv).

        Derivatives by `q` are in its tangent space: rotation of the base, translation of the base, both in base axes,
        rotations of ball joints, then the other joints. The derivative by `tau` is the inverse of the mass matrix.
        """
        inputs = ("q", "v", "tau")
        jacobians = self.derivatives("forward_dynamics", inputs).jacobian(q, v, tau)
        return jacobians["vdot", "q"], jacobians["vdot", "v"], jacobians["vdot", "tau"]

    def inverse_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the derivatives of `tau` of `inverse_dynamics` by `q`, `v` and `vdot`, each shape (..., nv, nv).

        Derivatives by `q` are in its tangent space, see `forward_dynamics_derivatives`. The derivative by `vdot` is the
        mass matrix.
        """
        inputs = ("q", "v", "vdot")
        jacobians = self.derivatives("inverse_dynamics", inputs).jacobian(q, v, vdot)
        return jacobians["tau", "q"], jacobians["tau", "v"], jacobians["tau", "vdot"]

    @cached_property
    def _continuation(self) -> Continuation | None:
        """What finds the dependent coordinates that no formula gives; None if there are none."""
        has_guess = self.guess.size > 0
        return Continuation(self.casadi_function("loops"), self.standing_q, self.guess) if has_guess else None

    def loop_gap(self, q: ArrayLike) -> Array:
        """Return the norm of the residuals of all loops, rods and functions, redundant rows included, shape (...).

        In metres for loops and rods; 0 if there are none, not a number where loops cannot be closed by their formulas.
        """
        return self.evaluate("loops", q)[1][..., 0, 0]

    def nearness(self, q: ArrayLike) -> Array:
        """Return how far a configuration is from a singularity of the independent joints, shape (...).

        It is 1 at the reference pose, and smaller or negative nearer to or beyond a singularity: the smallest
        determinant among the blocks of the constraint Jacobian of the dependent joints, relative to that pose. It is -1
        where the loops cannot be closed.
        """
        return self.evaluate("loops", q)[2][..., 0, 0]

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
        if self._continuation is None or len(flat) == 0:
            return np.zeros((*q.shape[:-1], len(self.guess)))
        guess, gap = self._continuation.follow(flat)
        if np.isnan(guess).any():
            raise ValueError(f"the loops of {self.robot.name} pass a singularity on the way to this q")
        if not gap.max() < CLOSED["float64"]:
            raise ValueError(f"the loops of {self.robot.name} do not close at this q: gap {gap.max():.2g}")
        return guess.reshape(*q.shape[:-1], len(self.guess))

    def unit(self, q: Array) -> Array:
        """Return positions, shape (..., nq), with quaternions of unit length; ValueError if they are far from it."""
        fits = q.ndim > 0 and q.shape[-1] == self.nq  # other shapes are refused where they are used
        return unit_quaternions(q, [i for i, _ in self.robot.layout.turns]) if fits else q

    def loop_report(self) -> str:
        """Return one line for each cluster with closed loops: its solution method and condition number."""
        return loop_report(self.mechanism)

    def describe(self) -> str:
        """Return a readable account of the robot: figures, and its cluster tree as text."""
        base, rotors = "floating" if self.robot.floating else "fixed", sum(1 for _ in self.robot.rotors())
        bodies = sum(body.kind != "stretch" for body in self.robot.bodies)
        eliminated = sum(map(len, self.mechanism.eliminated_rotors))
        lines = [
            f"{self.robot.name}: {base} base, {len(self.joint_links)} joints, "
            f"{bodies} bodies of which {rotors} rotors, {len(self.cluster_tree.clusters)} clusters, "
            f"{self.total_mass:.3f} kg",
            f"transmission {self.transmission}: {eliminated} rotors need no body of their own",
            "",
            self.cluster_tree.as_text(),
            *(["", self.loop_report()] if self.loop_report() else []),
        ]
        return "\n".join(lines)
