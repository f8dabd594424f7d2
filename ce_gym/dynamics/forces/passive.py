"""Viscous friction, stops and springs of the joints, dependent ones included, taken one step ahead."""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.integration import rotation_vector
from ce_gym.dynamics.algebra.spatial import SX, mirrored
from ce_gym.dynamics.forces.law import JointForce
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.model.description import Joint, Robot
from ce_gym.model.mechanism import Mechanism

LIMIT_FREQUENCY = 2 * math.pi * 20.0
"""Stiffness over damping of a soft joint limit [1/s]; the stop relaxes in the inverse of it, 8 ms."""


def passive_forces(robot: Robot, y: SX, yd: SX, dt: float) -> JointForce:
    """Return viscous friction and stops of all independent joints with one coordinate."""
    total = [_viscous_damping(yd[i], robot.body(name).joint.damping, dt) for i, name in enumerate(robot.independent)]
    for i, name in enumerate(robot.independent):
        stiffness, damping = limit_stiffness(robot, name)
        tau, slope = _stop(y[i], yd[i], robot.body(name).joint.position, stiffness, damping, dt)
        total[i] = total[i][0] + tau, total[i][1] + slope
    tau, slopes = ca.vertcat(SX(0, 1), *[t for t, _ in total]), ca.vertcat(SX(0, 1), *[s for _, s in total])
    return JointForce(tau, ca.diag(slopes))


def ball_forces(robot: Robot, q: SX, v: SX, dt: float) -> JointForce:
    """Return viscous friction, stops and springs of all ball joints, at positions (nq,) and velocities (nv,).

    The stop is a spring along the axis about which the joint is turned, where the angle is beyond the limit: the rate
    of that angle is the velocity along this axis.
    """
    taus, slopes = [SX(0, 1)], []
    for name, (i, j) in zip(robot.balls, robot.layout.ball_turns, strict=True):
        joint, w = robot.body(name).joint, v[j : j + 3]
        tau, slope = SX(-joint.damping * w), dt * joint.damping * SX.eye(3)
        turned = rotation_vector(q[i : i + 4])
        if joint.stiffness:  # a turn by dt w changes the rotation vector by about as much
            tau, slope = tau - joint.stiffness * (turned + dt * w), slope + dt**2 * joint.stiffness * SX.eye(3)
        if not math.isinf(joint.position[1]):
            angle = ca.sqrt(ca.sumsqr(turned) + 1e-24)  # never zero, so that the axis stays finite
            axis, limits = turned / angle, (-math.inf, joint.position[1])
            push, slope_along = _stop(angle, ca.dot(axis, w), limits, *limit_stiffness(robot, name), dt)
            tau, slope = tau + push * axis, slope + slope_along * mirrored(axis @ axis.T)
        taus.append(tau)
        slopes.append(slope)
    return JointForce(ca.vertcat(*taus), ca.diagcat(SX(0, 0), *slopes))


def yielding_joints(mechanism: Mechanism) -> list[tuple[int, Joint, str]]:
    """Return joints with one coordinate that have springs, and dependent ones that are damped or have stops.

    Each with the index of its cluster and the name of the body it moves; for damping and stops of others see
    `passive_forces`.
    """
    robot, found = mechanism.robot, []
    for k, cluster in enumerate(mechanism.tree.clusters):
        for name in cluster.bodies:
            joint = robot.body(name).joint
            follows = name not in robot.independent and (joint.damping or any(map(math.isfinite, joint.position)))
            if joint.nv == 1 and (joint.stiffness or follows):
                found.append((k, joint, name))
    return found


def yielding_forces(mechanism: Mechanism, kinematics: Kinematics, dt: float) -> list[JointForce]:
    """Return springs of joints with one coordinate, and viscous friction and stops of dependent ones.

    With `W` its row of the constraint Jacobian a joint moves at `W yd`, and its torque on the independent joints is
    `W^T tau`. Near the end of a loop's reach `W` grows without bound, and with it what a stop there can resist: no stop
    of an independent joint could.
    """
    robot, found, layout = mechanism.robot, [], mechanism.robot.layout
    for k, joint, name in yielding_joints(mechanism):
        coordinates = kinematics.coordinates[k]
        assert coordinates is not None
        way, row = SX(1, layout.joints), coordinates.index[name]
        way[[row - layout.joints_v for row in kinematics.rows[k]]] = coordinates.G[row, :]
        q, qd, follows = coordinates.q[row], coordinates.qd[row], name not in robot.independent
        damping = (joint.damping if follows else 0.0) + dt * joint.stiffness
        tau, slope = -joint.stiffness * (q - joint.springref) - damping * qd, dt * damping
        if follows:
            push, more = _stop(q, qd, joint.position, *limit_stiffness(robot, name), dt)
            tau, slope = tau + push, slope + more
        found.append(JointForce(tau * way.T, slope * (way.T @ way)))
    return found


def limit_stiffness(robot: Robot, name: str) -> tuple[float, float]:
    """Return stiffness [N m/rad] and damping [N m s/rad] of a joint's stops: full torque at 0.02 rad, well damped.

    Passive joints have no torque to go by, infinite or 0 in their files.
    """
    torque = robot.body(name).joint.torque
    stiffness = 50.0 * torque if 0.0 < torque < math.inf else 1e3
    return stiffness, stiffness / LIMIT_FREQUENCY


def _viscous_damping(yd: SX, damping: float, dt: float) -> tuple[SX, SX]:
    return SX(-damping * yd), SX(dt * damping)


def _stop(y: SX, yd: SX, limits: tuple[float, float], stiffness: float, damping: float, dt: float) -> tuple[SX, SX]:
    """One-sided springs at the ends of a joint's range, active if it will be beyond one by the end of the step."""
    tau, total, slope = SX(0), SX(0), damping + dt * stiffness
    for bound, side in ((limits[0], 1.0), (limits[1], -1.0)):
        if math.isinf(bound):
            continue
        depth, speed = side * (bound - y), side * yd
        push = stiffness * depth - slope * speed
        active = ca.logic_and(depth - dt * speed > 0, push > 0)
        tau, total = tau + side * ca.if_else(active, push, 0), total + ca.if_else(active, dt * slope, 0)
    return tau, total
