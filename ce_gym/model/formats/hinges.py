"""A ball joint as three revolute joints through one point, which is what it is inside closed loops.

The last one is the spin about an axis of the body. A rod with ball joints at both ends spins about the line through
them as it likes: along that axis the spin is one independent joint, and the loop determines the two others. They are
singular where the body has swung by a right angle, as cardan joints are; at zero they are furthest from it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ce_gym.model.description import Body, Inertial, Joint
from ce_gym.model.errors import invalid_value
from ce_gym.model.frames import ORIGIN, ZERO, Vec3

_MASSLESS = Inertial(0.0, ZERO, (ZERO, ZERO, ZERO))


def coincident_hinges(body: Body, along: Vec3) -> tuple[Body, Body, Body]:
    """Return three bodies on revolute joints in place of one on a ball joint.

    The body keeps its name, which is that of its spin; the massless ones before it are `NAME_swing_1` and
    `NAME_swing_2`. Each joint has the damping of the ball joint, which is right near zero; there are no limits,
    springs or dry friction.

    Args:
        body: On a ball joint.
        along: Axis of the spin in the frame of the body, of any length but 0.

    Raises:
        RobotError: The joint is no ball joint, or the axis has no length.
    """
    if body.joint.type != "ball":
        raise invalid_value(body.name, "joint type", body.joint.type, "ball")
    if not 0.0 < math.hypot(*along) < math.inf:
        raise invalid_value(body.name, "axis of the spin", along, "an axis of length other than 0")
    spin = np.array(along) / math.hypot(*along)
    first = np.cross(spin, np.eye(3)[int(np.argmin(np.abs(spin)))])
    first = first / np.linalg.norm(first)
    axes = [_tuple(axis) for axis in (first, np.cross(spin, first), spin)]
    swing_1, swing_2, spun = (Joint("revolute", axis, damping=body.joint.damping) for axis in axes)
    names = f"{body.name}_swing_1", f"{body.name}_swing_2"
    return (
        Body(names[0], body.kind, body.parent, body.placement, swing_1, _MASSLESS),
        Body(names[1], body.kind, names[0], ORIGIN, swing_2, _MASSLESS),
        replace(body, parent=names[1], placement=ORIGIN, joint=spun),
    )


def _tuple(axis: np.ndarray) -> Vec3:
    x, y, z = (float(x) + 0.0 for x in axis)
    return (x, y, z)
