"""Poses, velocities and Jacobians of bodies, of named frames, and of the centres of contact spheres.

All are in the axes of the world at the origin of the frame, angular part first: `LOCAL_WORLD_ALIGNED` of Pinocchio.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.integration import tangent_basis
from ce_gym.dynamics.algebra.spatial import SX, axis_rotation, cross
from ce_gym.dynamics.constraints.cluster_constraints import ClusterCoordinates
from ce_gym.dynamics.quantities.inputs import function_of_state, state_symbols
from ce_gym.dynamics.recursion.ce_aba import gravity_acceleration
from ce_gym.dynamics.recursion.ce_rnea import outward_acceleration
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.model.description import ContactSphere, Frame
from ce_gym.model.frames import Placement
from ce_gym.model.mechanism import Mechanism


@dataclass(frozen=True)
class Motion:
    """Pose and velocity of a frame in the world.

    Attributes:
        R: Rotation, frame to world, shape (3, 3).
        p: Origin [m], shape (3,).
        w: Angular velocity, world axes [rad/s], shape (3,).
        v: Velocity of the origin, world axes [m/s], shape (3,).
    """

    R: SX
    p: SX
    w: SX
    v: SX

    def placed(self, placement: Placement) -> Motion:
        """Return the motion of a frame at a placement in this one."""
        r = self.R @ constant(np.array(placement.position))
        return Motion(self.R @ constant(np.array(placement.rotation)), self.p + r, self.w, self.v + cross(self.w, r))


def frames_of(mechanism: Mechanism) -> dict[str, Frame]:
    """Return all frames by name: bodies, then frames of the robot's file, then contacts with other names."""
    robot = mechanism.robot
    contacts = [Frame(contact.name, contact.body, Placement(contact.position)) for contact in robot.contacts]
    bodies = [Frame(body.name, body.name) for body in robot.bodies]
    frames: dict[str, Frame] = {}
    for frame in (*bodies, *robot.frames, *contacts):
        frames.setdefault(frame.name, frame)
    return frames


def body_motion(mechanism: Mechanism, kinematics: Kinematics, name: str | None) -> Motion:
    """Return the motion of a body, of an eliminated rotor, or of the world (None)."""
    if name is None:
        return Motion(SX.eye(3), SX(3, 1), SX(3, 1), SX(3, 1))
    if name in kinematics.bodies:
        state = kinematics.bodies[name]
        return Motion(state.R, state.p, state.R @ state.v[:3], state.R @ state.v[3:])
    rotor = mechanism.robot.body(name)
    coordinates: ClusterCoordinates = kinematics.coordinates[mechanism.tree.cluster_of(name)]  # type: ignore[assignment]
    home = body_motion(mechanism, kinematics, rotor.parent).placed(rotor.placement)
    axis = constant(np.array(rotor.joint.axis))
    turned = home.R @ axis_rotation(axis, coordinates.position(name)).T
    return Motion(turned, home.p, home.w + home.R @ axis * coordinates.qd[coordinates.index[name]], home.v)


def rate_of_change(x: SX, mechanism: Mechanism, q: SX, v: SX) -> SX:
    """Return the time derivative of an expression of positions and velocities for `vdot = 0`."""
    return ca.jtimes(x, q, tangent_basis(q, mechanism.robot.layout) @ v)


def _frame_motion(mechanism: Mechanism, frame: str) -> tuple[SX, SX, SX, Motion]:
    q, v, guess = state_symbols(mechanism)
    kinematics, place = outward_velocity_pass(mechanism, q, v, guess), frames_of(mechanism)[frame]
    return q, v, guess, body_motion(mechanism, kinematics, place.body).placed(place.placement)


def _frame_pose(mechanism: Mechanism, frame: str) -> ca.Function:
    q, _, guess, motion = _frame_motion(mechanism, frame)
    return function_of_state("frame_pose", guess, {"q": q}, {"position": motion.p, "rotation": motion.R})


def _frame_velocity(mechanism: Mechanism, frame: str) -> ca.Function:
    q, v, guess, motion = _frame_motion(mechanism, frame)
    velocity = ca.vertcat(motion.w, motion.v)
    return function_of_state("frame_velocity", guess, {"q": q, "v": v}, {"velocity": velocity})


def _frame_jacobian(mechanism: Mechanism, frame: str) -> ca.Function:
    q, v, guess, motion = _frame_motion(mechanism, frame)
    J = ca.jacobian(ca.vertcat(motion.w, motion.v), v)
    return function_of_state("frame_jacobian", guess, {"q": q}, {"J": J})


def _frame_bias_acceleration(mechanism: Mechanism, frame: str) -> ca.Function:
    q, v, guess, motion = _frame_motion(mechanism, frame)
    acceleration = rate_of_change(ca.vertcat(motion.w, motion.v), mechanism, q, v)
    return function_of_state("frame_bias_acceleration", guess, {"q": q, "v": v}, {"acceleration": acceleration})


def _contact_points(mechanism: Mechanism, contacts: Sequence[ContactSphere]) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    positions, velocities = [SX(3, 0)], [SX(3, 0)]
    for contact in contacts:
        body, r = kinematics.bodies[contact.body], constant(np.array(contact.position))
        positions.append(body.point_position(r))
        velocities.append(body.R @ body.point_velocity(r))
    outputs = {"positions": ca.horzcat(*positions), "velocities": ca.horzcat(*velocities)}
    return function_of_state("contact_points", guess, {"q": q, "v": v}, outputs)


def _contact_accelerations(mechanism: Mechanism, contacts: Sequence[ContactSphere]) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    accelerations = _accelerations_of(contacts, mechanism, outward_velocity_pass(mechanism, q, v, guess), vdot)
    inputs = {"q": q, "v": v, "vdot": vdot}
    return function_of_state("contact_accelerations", guess, inputs, {"accelerations": accelerations})


def _contact_bias_acceleration(mechanism: Mechanism, contacts: Sequence[ContactSphere]) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    accelerations = _accelerations_of(contacts, mechanism, kinematics, SX(*v.shape))
    return function_of_state("contact_bias_acceleration", guess, {"q": q, "v": v}, {"accelerations": accelerations})


def _accelerations_of(contacts: Sequence[ContactSphere], mechanism: Mechanism, kinematics: Kinematics, vdot: SX) -> SX:
    """Return the accelerations of contacts, world axes, without gravity [m/s^2], shape (3, n)."""
    a_bodies, _ = outward_acceleration(mechanism, kinematics, vdot)
    gravity, accelerations = gravity_acceleration(mechanism), [SX(3, 0)]
    for contact in contacts:
        body, a, r = kinematics.bodies[contact.body], a_bodies[contact.body], constant(np.array(contact.position))
        in_body_axes = a[3:] + cross(a[:3], r) + cross(body.v[:3], cross(body.v[:3], r))
        accelerations.append(body.R @ in_body_axes + gravity)
    return ca.horzcat(*accelerations)


def _contact_jacobian(mechanism: Mechanism, contacts: Sequence[ContactSphere]) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    points = [(contact.body, Placement(contact.position)) for contact in contacts]
    velocities = [body_motion(mechanism, kinematics, body).placed(place).v for body, place in points]
    J = ca.jacobian(ca.vertcat(SX(0, 1), *velocities), v)
    return function_of_state("contact_jacobian", guess, {"q": q}, {"J": J})


FRAME_FUNCTIONS: dict[str, Callable[[Mechanism, str], ca.Function]] = {
    "frame_pose": _frame_pose,
    "frame_velocity": _frame_velocity,
    "frame_jacobian": _frame_jacobian,
    "frame_bias_acceleration": _frame_bias_acceleration,
}
"""Quantities of one frame: functions of a mechanism and the name of the frame."""

CONTACT_FUNCTIONS: dict[str, Callable[[Mechanism, Sequence[ContactSphere]], ca.Function]] = {
    "contact_points": _contact_points,
    "contact_accelerations": _contact_accelerations,
    "contact_bias_acceleration": _contact_bias_acceleration,
    "contact_jacobian": _contact_jacobian,
}
"""Quantities of contacts: functions of a mechanism and the contacts."""
