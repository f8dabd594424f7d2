"""Viscous friction and stops of independent joints, and the springs of ball joints, taken one step ahead."""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.integration import rotation_vector
from ce_gym.dynamics.algebra.spatial import SX, mirrored
from ce_gym.dynamics.forces.linear import JointForce
from ce_gym.dynamics.forces.stops import stop_energy, stop_force, stop_springs
from ce_gym.dynamics.laws.law import ForceLaw, PassiveForces, Start
from ce_gym.model.mechanism import Mechanism


class JointStops(ForceLaw):
    """Viscous friction and stops of independent joints, and springs of ball joints."""

    def place(self, start: Start) -> PassiveForces:
        """Return the forces at the start of a step."""
        mechanism, dt = start.scene.mechanism, start.dt
        balls = ball_forces(mechanism, start.state.q, start.state.v, dt)
        return PassiveForces([passive_forces(mechanism, start.y, start.yd, dt)], balls)

    def energy(self, start: Start) -> SX:
        """Return the energy of stops, and of the springs of ball joints [J]."""
        mechanism, total = start.scene.mechanism, SX(0)
        robot, springs = mechanism.robot, stop_springs(mechanism)
        for name, (row, _) in zip(robot.balls, robot.layout.ball_turns, strict=True):
            joint, turned = robot.body(name).joint, rotation_vector(start.state.q[row : row + 4])
            total += joint.stiffness * ca.sumsqr(turned) / 2
            if math.isfinite(joint.position[1]):
                beyond = ca.fmax(ca.norm_2(turned) - joint.position[1], 0)
                total += springs[name][0] * beyond**2 / 2
        for i, name in enumerate(robot.independent):
            total += stop_energy(mechanism, name, start.y[i])
        return total


def passive_forces(mechanism: Mechanism, y: SX, yd: SX, dt: float) -> JointForce:
    """Return viscous friction and stops of all independent joints with one coordinate."""
    robot, springs = mechanism.robot, stop_springs(mechanism)
    taus, slopes = [SX(0, 1)], [SX(0, 1)]
    for i, name in enumerate(robot.independent):
        joint = robot.body(name).joint
        tau, slope = stop_force(y[i], yd[i], joint.position, *springs[name], dt)
        taus.append(SX(-joint.damping * yd[i]) + tau)
        slopes.append(SX(dt * joint.damping) + slope)
    return JointForce(ca.vertcat(*taus), ca.diag(ca.vertcat(*slopes)))


def ball_forces(mechanism: Mechanism, q: SX, v: SX, dt: float) -> JointForce:
    """Return viscous friction, stops and springs of all ball joints, at positions (nq,) and velocities (nv,).

    The stop is a spring along the axis about which the joint is turned, where the angle is beyond the limit: the rate
    of that angle is the velocity along this axis.
    """
    robot, springs = mechanism.robot, stop_springs(mechanism)
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
            push, slope_along = stop_force(angle, ca.dot(axis, w), limits, *springs[name], dt)
            tau, slope = tau + push * axis, slope + slope_along * mirrored(axis @ axis.T)
        taus.append(tau)
        slopes.append(slope)
    return JointForce(ca.vertcat(*taus), ca.diagcat(SX(0, 0), *slopes))
