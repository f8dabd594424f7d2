"""Sensors that a robot carries, as observation terms: rate gyros, accelerometers, foot switches, encoders, currents.

Errors that stay for an episode are the terms' own; noise is the task's, `noise={"gyro": 0.05}`.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.actuation import actuated_clusters, effort_matrix, encoder_map
from ce_gym.dynamics.recursion.kinematics import BodyState, constant
from ce_gym.envs.terms.context import TermContext
from ce_gym.model.errors import listed_names


def gyro(s: TermContext, link: str = "", scale: float = 0.25, bias: float = 0.0) -> SX:
    """Angular velocity of a link in its own axes, times `scale`, 0.25 [rad/s], shape (3,).

    Args:
        s: The robot.
        link: Name of the link; "" for the base.
        scale: What readings are multiplied by.
        bias: Largest error of each axis in an episode [rad/s].
    """
    reading = _link(s, "gyro", link).v[:3]
    return scale * (reading + bias * s.drift("bias", 3) if bias else reading)


def accelerometer(
    s: TermContext, link: str = "", position: Sequence[float] = (0.0, 0.0, 0.0), scale: float = 0.1, bias: float = 0.0
) -> SX:
    """Specific force at a place of a link in its axes, times `scale`, 0.1 [m/s^2], shape (3,); upwards g at rest.

    It is the mean over the control step: the change of the place's velocity in the world over time, less gravity,
    turned into the link's axes at the end. The first reading of an episode is that of a robot at rest.

    Args:
        s: The robot.
        link: Name of the link; "" for the base.
        position: The place, in the link's frame [m].
        scale: What readings are multiplied by.
        bias: Largest error of each axis in an episode [m/s^2].
    """
    three = isinstance(position, Sequence) and not isinstance(position, str) and len(position) == 3
    if not three or not all(isinstance(x, int | float) and np.isfinite(x) for x in position):
        raise ValueError(f"observation term 'accelerometer': position={position!r}; expected three lengths [m]")
    body = _link(s, "accelerometer", link)
    velocity = body.R @ body.point_velocity(constant(np.array(position, dtype=float)))
    before = ca.if_else(s.begins, velocity, s.recall("velocity", size=3))
    s.keep("velocity", velocity)
    force = (velocity - before) / s.control_dt - np.array(s.mechanism.robot.gravity)
    reading = body.R.T @ force
    return scale * (reading + bias * s.drift("bias", 3) if bias else reading)


def foot_contact_switches(s: TermContext, threshold: float = 5.0) -> SX:
    """Whether the ground pushes at each foot by more than `threshold`, 5 N, in the last sub-step, 0 or 1, (n_feet,)."""
    loads = s.foot_loads
    return ca.vertcat(SX(0, 1), *loads) > threshold


def joint_encoders(s: TermContext, counts: float = 4096, bias: float = 0.0) -> SX:
    """Joint positions as encoders at the rotors tell them, distance from the standing pose [rad], shape (n_joints,).

    A rotor's angle is known to a count; joints follow from it through the transmission, where a count is the smaller
    the larger the gear ratio is. What stretches in between is not seen. Joints without a motor have no encoder, and are
    told as they are. Steps have no slope: for derivatives of environments it is 0.

    Args:
        s: The robot.
        counts: Of a turn of a rotor.
        bias: Largest error of each joint in an episode [rad], as of a calibration.
    """
    if not (isinstance(counts, int | float) and 1 <= counts < np.inf):
        raise ValueError(f"observation term 'joint_encoders': counts={counts!r}; expected 1 or more of a turn")
    robot, step = s.mechanism.robot, 2 * np.pi / counts
    told = encoder_map(s.mechanism, s.kinematics) @ s.q[robot.layout.joints_q :]
    for cluster in actuated_clusters(s.mechanism, s.kinematics):
        off = step * ca.floor(cluster.angles / step + 0.5) - cluster.angles
        told[cluster.joints] += effort_matrix(cluster.W[:, : len(cluster.joints)]).T @ off
    drift = bias * s.drift("bias", told.numel()) if bias else 0.0
    return told - s.standing_joints + drift


def motor_torques(s: TermContext) -> SX:
    """Torque of each motor's windings, which its current is in proportion to, over its largest [-], shape (n_motors,).

    The mean over the last sub-step, before friction; what motors without a limit give is over 100 N m.
    """
    limits = [motor.torque for motor in s.mechanism.robot.motors]
    if not limits:
        return SX(0, 1)
    return s.motor_torque / np.array([limit if 0 < limit < np.inf else 100.0 for limit in limits])


def winding_temperatures(s: TermContext) -> SX:
    """How much windings of motors that grow warm are warmer than the air [100 K], shape (n_warm,)."""
    return s.motor_warmth[: s.motor_warmth.numel() // 2] / 100  # windings, then housings


def battery_sag(s: TermContext) -> SX:
    """How far the battery's voltage is below that without load, over the nominal one [-], shape (1,); () without."""
    battery = s.mechanism.robot.battery
    return SX(0, 1) if battery is None or not s.battery_sag.numel() else s.battery_sag / battery.nominal


def _link(s: TermContext, term: str, name: str) -> BodyState:
    bodies = s.kinematics.bodies
    name = name or s.mechanism.robot.bodies[0].name
    if name not in bodies:
        raise ValueError(f"observation term {term!r}: link={name!r}; expected one of {listed_names(name, bodies)}")
    return bodies[name]
