"""Sensors of the robot as observation terms: rate gyros, accelerometers, foot switches, encoders, motor currents.

Terms add biases that are constant over an episode. The task adds noise, as in `noise={"gyro": 0.05}`.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.actuation import actuated_clusters, effort_matrix, encoder_map
from ce_gym.dynamics.recursion.kinematics import BodyState, constant
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.grid import are_numbers, check_term
from ce_gym.model.errors import listed_names


def gyro(s: TermContext, link: str = "", scale: float = 0.25, bias: float = 0.0) -> SX:
    """Angular velocity of a link in its own axes, times `scale`, 0.25 [rad/s], shape (3,).

    Args:
        s: The robot.
        link: Name of the link; "" for the base.
        scale: Factor on the readings.
        bias: Largest bias of each axis, drawn for each episode [rad/s].
    """
    reading = _link(s, "gyro", link).v[:3]
    return scale * (reading + bias * s.drift("bias", 3) if bias else reading)


def accelerometer(
    s: TermContext, link: str = "", position: Sequence[float] = (0.0, 0.0, 0.0), scale: float = 0.1, bias: float = 0.0
) -> SX:
    """Specific force at a place of a link in axes of the link, times `scale`, 0.1 [m/s^2], shape (3,); g up at rest.

    The reading is a mean over the control step: the change of velocity in the world over time, minus gravity, in the
    axes of the link at the end of the step. The first reading of an episode is the reading of a robot at rest.

    Args:
        s: The robot.
        link: Name of the link; "" for the base.
        position: Place of the sensor in the link's frame [m].
        scale: Factor on the readings.
        bias: Largest bias of each axis, drawn for each episode [m/s^2].
    """
    check_term("accelerometer", "position", position, are_numbers(position, 3), "three lengths [m]")
    body = _link(s, "accelerometer", link)
    velocity = body.R @ body.point_velocity(constant(np.array(position, dtype=float)))
    previous = ca.if_else(s.begins, velocity, s.recall("velocity", size=3))
    s.keep("velocity", velocity)
    force = (velocity - previous) / s.control_dt - np.array(s.mechanism.robot.gravity)
    reading = body.R.T @ force
    return scale * (reading + bias * s.drift("bias", 3) if bias else reading)


def foot_contact_switches(s: TermContext, threshold: float = 5.0) -> SX:
    """Whether the normal force on each foot in the last sub-step is above `threshold`, 5 N, 0 or 1, (n_feet,)."""
    return ca.vertcat(SX(0, 1), *s.foot_loads) > threshold


def joint_encoders(s: TermContext, counts: float = 4096, bias: float = 0.0) -> SX:
    """Joint positions minus the standing pose, measured by encoders at the rotors [rad], shape (n_joints,).

    An encoder rounds the angle of its rotor to a count, and the transmission gives the joint positions; the larger the
    gear ratio, the smaller a count at the joint. Stretch of elastic transmissions is not measured. Joints without a
    motor are measured exactly. Rounding has no gradient, so derivatives of environments use 0.

    Args:
        s: The robot.
        counts: Counts for each turn of a rotor.
        bias: Largest calibration error of each joint, drawn for each episode [rad].
    """
    valid = isinstance(counts, int | float) and 1 <= counts < np.inf
    check_term("joint_encoders", "counts", counts, valid, "1 or more of a turn")
    robot, step = s.mechanism.robot, 2 * np.pi / counts
    measured = encoder_map(s.mechanism, s.kinematics) @ s.q[robot.layout.joints_q :]
    for cluster in actuated_clusters(s.mechanism, s.kinematics):
        rounding = step * ca.floor(cluster.angles / step + 0.5) - cluster.angles
        measured[cluster.joints] += effort_matrix(cluster.W[:, : len(cluster.joints)]).T @ rounding
    drift = bias * s.drift("bias", measured.numel()) if bias else 0.0
    return measured - s.standing_joints + drift


def motor_torques(s: TermContext) -> SX:
    """Electromagnetic torque of each motor, proportional to its current, over its limit [-], shape (n_motors,).

    The torque is a mean over the last sub-step, before friction. For motors without a limit it is divided by 100 N m.
    """
    limits = [motor.torque for motor in s.mechanism.robot.motors]
    if not limits:
        return SX(0, 1)
    return s.motor_torque / np.array([limit if 0 < limit < np.inf else 100.0 for limit in limits])


def winding_temperatures(s: TermContext) -> SX:
    """Temperatures of windings above the ambient temperature, for motors with thermal data [100 K], shape (n_warm,)."""
    return s.motor_warmth[: s.motor_warmth.numel() // 2] / 100  # windings, then housings


def battery_sag(s: TermContext) -> SX:
    """Voltage drop of the battery under load over its nominal voltage [-], shape (1,); empty without a battery."""
    battery = s.mechanism.robot.battery
    return SX(0, 1) if battery is None or not s.battery_sag.numel() else s.battery_sag / battery.nominal


def _link(s: TermContext, term: str, name: str) -> BodyState:
    bodies = s.kinematics.bodies
    name = name or s.mechanism.robot.bodies[0].name
    if name not in bodies:
        raise ValueError(f"observation term {term!r}: link={name!r}; expected one of {listed_names(name, bodies)}")
    return bodies[name]
