"""Sensors that a robot carries: rate gyros, accelerometers and foot switches, as observation terms.

Errors that stay for an episode are the terms' own; noise is the task's, `noise={"gyro": 0.05}`.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.recursion.kinematics import BodyState, constant
from ce_gym.envs.terms.context import TermContext


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


def _link(s: TermContext, term: str, name: str) -> BodyState:
    bodies = s.kinematics.bodies
    name = name or s.mechanism.robot.bodies[0].name
    if name not in bodies:
        raise ValueError(f"observation term {term!r}: link={name!r}; expected one of {', '.join(bodies)}")
    return bodies[name]
