"""Forces on the independent coordinates, linearly implicit in the step: motors, damping, joint limits.

Each is `tau - slope * ydd` with the force taken one step ahead, exactly as in contact.py; the slope joins `D` of the
cluster. A saturated motor gives a constant torque and has no slope. May know CasADi and descriptions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.spatial import SX
from ce_gym.model.description import Robot

LIMIT_FREQUENCY = 2 * math.pi * 20.0
"""Stiffness over damping of a soft joint limit [1/s]; the stop relaxes in the inverse of it, 8 ms."""


@dataclass
class JointForce:
    """A force on one coordinate, `tau - slope * ydd` over the step.

    Attributes:
        tau: At zero acceleration [N m or N].
        slope: [kg m^2 or kg].
    """

    tau: SX
    slope: SX | float

    def __add__(self, other: JointForce) -> JointForce:
        """Return both acting together."""
        return JointForce(self.tau + other.tau, self.slope + other.slope)


def position_motor(y: SX, yd: SX, target: SX, kp: float, kd: float, limit: float, dt: float) -> JointForce:
    """A proportional-derivative position controller with a torque limit, evaluated at the end of the step."""
    damping = kd + dt * kp
    tau = kp * (target - y) - damping * yd
    if math.isinf(limit):
        return JointForce(tau, dt * damping)
    saturated = ca.fabs(tau) > limit
    return JointForce(ca.fmax(-limit, ca.fmin(limit, tau)), ca.if_else(saturated, 0, dt * damping))


def torque_motor(command: SX, limit: float) -> JointForce:
    """A motor that delivers the commanded torque up to its limit."""
    return JointForce(command if math.isinf(limit) else ca.fmax(-limit, ca.fmin(limit, command)), 0.0)


def viscous_damping(yd: SX, damping: float, dt: float) -> JointForce:
    """Friction proportional to speed."""
    return JointForce(-damping * yd, dt * damping)


def limit_stop(y: SX, yd: SX, limits: tuple[float, float], stiffness: float, damping: float, dt: float) -> JointForce:
    """One-sided springs at the ends of a joint's range, active if it will be beyond one by the end of the step."""
    total, slope = JointForce(SX(0), 0.0), damping + dt * stiffness
    for bound, side in ((limits[0], 1.0), (limits[1], -1.0)):
        if math.isinf(bound):
            continue
        depth, speed = side * (bound - y), side * yd
        push = stiffness * depth - slope * speed
        active = ca.logic_and(depth - dt * speed > 0, push > 0)
        total += JointForce(side * ca.if_else(active, push, 0), ca.if_else(active, dt * slope, 0))
    return total


def limit_stiffness(robot: Robot, name: str) -> tuple[float, float]:
    """Return stiffness [N m/rad] and damping [N m s/rad] of a joint's stops: full torque at 0.05 rad, well damped."""
    torque = robot.body(name).joint.torque
    stiffness = 20.0 * torque if math.isfinite(torque) else 1e3
    return stiffness, stiffness / LIMIT_FREQUENCY
