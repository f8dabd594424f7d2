"""What a robot's files leave open, guessed from its links: feet, a standing pose, gains.

Rules of thumb, for a file that a person will go through. Nothing else in the package uses them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.model.description import Body, ContactSphere, Pose, Robot, Shape

BEND = 0.5
"""Angle of the thighs in the pose, half that of the knees [rad]."""
FOOT_BAND = 0.15
"""A leaf of the tree is a foot if it reaches as low as this part of the robot's height above the lowest."""
SOLE_BAND = 0.01
"""What belongs to the sole of a foot is this near to its lowest point [m]."""
FULL_TORQUE_AT = 0.6
"""Error at which the position gain asks for all the torque that a joint has [rad or m]."""
DAMPING_TIME = 0.025
"""Velocity gain over position gain [s]."""
SIDEWAYS = 0.9
"""Part of a joint's axis along y from which it counts as one that bends a leg."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Guesses:
    """What was guessed; empty where the files say it.

    Attributes:
        contacts: Feet, and corners of the base.
        pose: Joint angles [rad] and the height at which the feet just touch [m].
        gains: Pairs (joint, kp, kd).
        no_torque: Joints of whose largest torque nothing is known.
    """

    contacts: tuple[ContactSphere, ...]
    pose: Pose
    gains: tuple[tuple[str, float, float], ...]
    no_torque: tuple[str, ...]


def guess(robot: Robot, has_pose: bool) -> Guesses:
    """Guess what tasks need of a robot and its files do not say.

    Args:
        robot: What the links alone say.
        has_pose: Whether its standing pose is one that somebody chose.
    """
    angles = dict(robot.pose.joints) | ({} if has_pose else _bent(robot))
    posed = replace(robot, pose=Pose(robot.pose.height, tuple(angles.items())), contacts=())
    model = Model(posed)
    positions, rotations = model.body_poses(model.standing_q)
    frames = {name: (positions[i], rotations[i]) for i, name in enumerate(model.body_names)}
    contacts = robot.contacts or tuple(_contacts(robot, frames))
    known = {body.name: body.joint.torque for body in robot.bodies}
    gains = [(j, known[j] / FULL_TORQUE_AT) for j in robot.independent if 0.0 < known[j] < np.inf]
    return Guesses(
        contacts,
        Pose(_height(posed, contacts, frames), tuple(angles.items())),
        () if robot.gains.kp else tuple((joint, _rounded(kp), _rounded(kp * DAMPING_TIME)) for joint, kp in gains),
        tuple(joint for joint in robot.independent if not 0.0 < known[joint] < np.inf),
    )


def _rounded(x: float) -> float:
    return float(f"{x:.2g}")


def _height(robot: Robot, contacts: tuple[ContactSphere, ...], frames: Mapping[str, tuple[Floats, Floats]]) -> float:
    """Return the height of the base at which the lowest contact just touches; what the file says without contacts."""
    lowest = [
        (frames[c.body][0] + frames[c.body][1] @ np.array(c.position))[2] - c.radius for c in contacts if robot.floating
    ]
    return round(robot.pose.height - min(lowest), 6) if lowest else robot.pose.height


def _bent(robot: Robot) -> dict[str, float]:
    """Return angles that bend the knees of straight legs: thigh, knee and ankle by -1, 2 and -1 times `BEND`."""
    angles: dict[str, float] = {}
    leaves = _leaves(robot)
    reach = {leaf.name: _at_zero(robot, leaf)[1][2] for leaf in leaves}
    legs = [leaf for leaf in leaves if reach[leaf.name] < 0.5 * min(reach.values())]  # arms end higher up
    for leaf in legs:
        chain = [body for body in _chain(robot, leaf) if _turns_sideways(robot, body)]
        if len(chain) < 2 or any(body.name not in robot.independent for body in chain):
            continue
        lower, upper = chain[1].joint.position
        sign = 1.0 if upper >= -lower else -1.0  # the way that the knee has more room for
        for body, factor in zip(chain[:3], (-1.0, 2.0, -1.0), strict=False):
            same = np.sign(_at_zero(robot, body)[0][1] * _at_zero(robot, chain[1])[0][1])
            angles[body.name] = float(np.clip(factor * sign * same * BEND, *body.joint.position))
    return angles


def _leaves(robot: Robot) -> list[Body]:
    carriers = {body.parent for body in robot.bodies if body.kind == "link"}
    return [body for body in robot.bodies if body.kind == "link" and body.name not in carriers]


def _chain(robot: Robot, leaf: Body) -> list[Body]:
    """Return the moving bodies from the base down to a leaf, the base left out."""
    chain: list[Body] = []
    body: Body | None = leaf
    while body is not None and body.joint.type != "free":
        chain.insert(0, body)
        body = robot.body(body.parent) if body.parent else None
    return chain


def _at_zero(robot: Robot, body: Body) -> tuple[Floats, Floats]:
    """Return a joint's axis, and its origin [m], in the base's frame when all coordinates are zero."""
    rotation, position = np.eye(3), np.zeros(3)
    for link in _chain(robot, body):
        position = position + rotation @ np.array(link.placement.position)
        rotation = rotation @ np.array(link.placement.rotation)
    return rotation @ np.array(body.joint.axis), position


def _turns_sideways(robot: Robot, body: Body) -> bool:
    return body.joint.type == "revolute" and abs(_at_zero(robot, body)[0][1]) > SIDEWAYS


def _contacts(robot: Robot, frames: Mapping[str, tuple[Floats, Floats]]) -> Iterator[ContactSphere]:
    """Iterate over feet, the lowest spheres or points of each low leaf, and the corners of the base's first shapes."""
    points = {leaf.name: list(_points(leaf)) for leaf in _leaves(robot) if leaf.joint.type != "free"}
    under = {
        name: [float((frames[name][0] + frames[name][1] @ centre)[2]) - radius for centre, radius in of]
        for name, of in points.items()
    }
    heights = [height for of in under.values() for height in of]
    base = robot.bodies[0]
    top = float(frames[base.name][0][2])
    band = FOOT_BAND * (top - min(heights, default=top))
    for name, of in points.items():
        low = min(under[name])
        if low > min(heights) + band:
            continue
        for i, (centre, radius) in enumerate(of):
            if under[name][i] <= low + SOLE_BAND:
                yield ContactSphere(f"{name}_{i + 1}", name, _tuple(centre), radius, "foot")
    if robot.floating:
        corners = list(_points(base)) if base.shapes else [(np.array(base.inertial.com), 0.05)]
        for i, (centre, radius) in enumerate(corners[:8]):
            yield ContactSphere(f"torso_{i + 1}", base.name, _tuple(centre), radius, "torso")


def _tuple(x: Floats) -> tuple[float, float, float]:
    return (round(float(x[0]), 6), round(float(x[1]), 6), round(float(x[2]), 6))


def _points(body: Body) -> Iterator[tuple[Floats, float]]:
    """Iterate over centres and radii [m] of what could touch the ground; without shapes, twice as far as the mass."""
    if not body.shapes:
        yield 2.0 * np.array(body.inertial.com), 0.0
    for shape in body.shapes:
        rotation, centre = np.array(shape.placement.rotation), np.array(shape.placement.position)
        for local, radius in _of_shape(shape):
            yield centre + rotation @ local, radius


def _of_shape(shape: Shape) -> list[tuple[Floats, float]]:
    if shape.type == "sphere":
        return [(np.zeros(3), shape.size[0])]
    if shape.type == "capsule":
        return [(np.array([0.0, 0.0, side * shape.size[1] / 2]), shape.size[0]) for side in (1, -1)]
    if shape.type == "cylinder":
        radius, length = shape.size
        cross = ((1, 0), (0, 1), (-1, 0), (0, -1))
        return [(np.array([x * radius, y * radius, z * length / 2]), 0.0) for z in (1, -1) for x, y in cross]
    corners = np.array(np.meshgrid(*[(1, -1)] * 3)).reshape(3, 8).T
    return [(corner * np.array(shape.size) / 2, 0.0) for corner in corners]
