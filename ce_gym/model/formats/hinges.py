"""A ball joint inside a closed loop as three revolute joints through one point.

The last joint is the spin about an axis of the body. A rod with ball joints at both ends can spin freely about the line
through the joints: the spin about that axis is one independent joint, and the loop determines the other two joints.
Like a cardan joint, the three joints are singular when the body has swung by a right angle.
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

    The body keeps its name for the spin; the massless bodies before it are `NAME_swing_1` and `NAME_swing_2`. Each
    joint has the damping of the ball joint, which is correct near zero. Limits, springs and dry friction are left out.

    Args:
        body: A body on a ball joint.
        along: Axis of the spin in the frame of the body, of any length but 0.

    Raises:
        RobotError: The joint is not a ball joint, or the axis has length 0.
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
