"""Guesses of the feet, standing pose and gains of a robot whose files lack them.

These rules of thumb only fill the template of `python -m ce_gym new`, which a person then checks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.model.description import Body, ContactSphere, Pose, Robot, Shape

BEND = 0.5
"""Angle of the thighs in the standing pose; knees bend twice as far [rad]."""
FOOT_BAND = 0.15
"""A leaf of the tree is a foot if its height above the lowest leaf is at most this share of the robot's height."""
SOLE_BAND = 0.01
"""Points of a foot up to this height above its lowest point belong to the sole [m]."""
FULL_TORQUE_AT = 0.6
"""Position error at which the gain commands the full torque of a joint [rad or m]."""
DAMPING_TIME = 0.025
"""Velocity gain over position gain [s]."""
SIDEWAYS = 0.9
"""A joint bends a leg if the y component of its axis exceeds this."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Guesses:
    """Guessed contacts, pose and gains; empty for data that the files have.

    Attributes:
        contacts: Feet, and corners of the base.
        pose: Joint angles [rad] and the height at which the feet just touch the ground [m].
        gains: Triples (joint, kp, kd).
        no_torque: Joints without a known largest torque.
    """

    contacts: tuple[ContactSphere, ...]
    pose: Pose
    gains: tuple[tuple[str, float, float], ...]
    no_torque: tuple[str, ...]


def guess(robot: Robot, has_pose: bool) -> Guesses:
    """Guess the data that tasks need and that the files of a robot lack.

    Args:
        robot: The robot as its file describes it.
        has_pose: Whether the standing pose comes from the file; if not, legs are bent.
    """
    angles = dict(robot.pose.joints) | ({} if has_pose else _bent_legs(robot))
    posed = replace(robot, pose=Pose(robot.pose.height, tuple(angles.items())), contacts=())
    model = Model(posed)
    positions, rotations = model.body_poses(model.standing_q)
    frames = {name: (positions[i], rotations[i]) for i, name in enumerate(model.body_names)}
    contacts = robot.contacts or tuple(_contacts(robot, frames))
    torques = {body.name: body.joint.torque for body in robot.bodies}
    limited = [joint for joint in robot.independent if 0.0 < torques[joint] < np.inf]
    gains = [(joint, torques[joint] / FULL_TORQUE_AT) for joint in limited]
    return Guesses(
        contacts,
        Pose(_height(posed, contacts, frames), tuple(angles.items())),
        () if robot.gains.kp else tuple((joint, _rounded(kp), _rounded(kp * DAMPING_TIME)) for joint, kp in gains),
        tuple(joint for joint in robot.independent if joint not in limited),
    )


def _rounded(x: float) -> float:
    return float(f"{x:.2g}")


def _height(robot: Robot, contacts: tuple[ContactSphere, ...], frames: Mapping[str, tuple[Floats, Floats]]) -> float:
    """Return the height of the base at which the lowest contact just touches; without contacts, the file's height."""
    lowest = [
        (frames[c.body][0] + frames[c.body][1] @ np.array(c.position))[2] - c.radius for c in contacts if robot.floating
    ]
    return round(robot.pose.height - min(lowest), 6) if lowest else robot.pose.height


def _bent_legs(robot: Robot) -> dict[str, float]:
    """Return angles that bend the knees of straight legs: thigh, knee and ankle by -1, 2 and -1 times `BEND`."""
    angles: dict[str, float] = {}
    leaves = _leaves(robot)
    reach = {leaf.name: _zero_pose(robot, leaf)[1][2] for leaf in leaves}
    legs = [leaf for leaf in leaves if reach[leaf.name] < 0.5 * min(reach.values())]  # arms end higher up
    for leaf in legs:
        chain = [body for body in _chain(robot, leaf) if _bends_leg(robot, body)]
        if len(chain) < 2 or any(body.name not in robot.independent for body in chain):
            continue
        lower, upper = chain[1].joint.position
        sign = 1.0 if upper >= -lower else -1.0  # the direction with the larger range
        for body, factor in zip(chain[:3], (-1.0, 2.0, -1.0), strict=False):
            side = np.sign(_zero_pose(robot, body)[0][1] * _zero_pose(robot, chain[1])[0][1])
            angles[body.name] = float(np.clip(factor * sign * side * BEND, *body.joint.position))
    return angles


def _leaves(robot: Robot) -> list[Body]:
    carriers = {body.parent for body in robot.bodies if body.kind == "link"}
    return [body for body in robot.bodies if body.kind == "link" and body.name not in carriers]


def _chain(robot: Robot, leaf: Body) -> list[Body]:
    """Return the moving bodies from the base down to a leaf, without the base."""
    chain: list[Body] = []
    body: Body | None = leaf
    while body is not None and body.joint.type != "free":
        chain.insert(0, body)
        body = robot.body(body.parent) if body.parent else None
    return chain


def _zero_pose(robot: Robot, body: Body) -> tuple[Floats, Floats]:
    """Return a joint's axis, and its origin [m], in the base's frame when all coordinates are zero."""
    rotation, position = np.eye(3), np.zeros(3)
    for link in _chain(robot, body):
        position = position + rotation @ np.array(link.placement.position)
        rotation = rotation @ np.array(link.placement.rotation)
    return rotation @ np.array(body.joint.axis), position


def _bends_leg(robot: Robot, body: Body) -> bool:
    return body.joint.type == "revolute" and abs(_zero_pose(robot, body)[0][1]) > SIDEWAYS


def _contacts(robot: Robot, frames: Mapping[str, tuple[Floats, Floats]]) -> Iterator[ContactSphere]:
    """Iterate over feet, the lowest points of each low leaf, and the corners of the base's first shapes."""
    spheres = {leaf.name: list(_spheres(leaf)) for leaf in _leaves(robot) if leaf.joint.type != "free"}
    heights = {
        name: [float((frames[name][0] + frames[name][1] @ centre)[2]) - radius for centre, radius in leaf]
        for name, leaf in spheres.items()
    }
    base = robot.bodies[0]
    top = float(frames[base.name][0][2])
    ground = min((min(leaf) for leaf in heights.values()), default=top)
    for name, leaf in spheres.items():
        sole = min(heights[name])
        if sole > ground + FOOT_BAND * (top - ground):
            continue
        for i, (centre, radius) in enumerate(leaf):
            if heights[name][i] <= sole + SOLE_BAND:
                yield ContactSphere(f"{name}_{i + 1}", name, _rounded_point(centre), radius, "foot")
    if robot.floating:
        corners = list(_spheres(base)) if base.shapes else [(np.array(base.inertial.com), 0.05)]
        for i, (centre, radius) in enumerate(corners[:8]):
            yield ContactSphere(f"torso_{i + 1}", base.name, _rounded_point(centre), radius, "torso")


def _rounded_point(x: Floats) -> tuple[float, float, float]:
    return (round(float(x[0]), 6), round(float(x[1]), 6), round(float(x[2]), 6))


def _spheres(body: Body) -> Iterator[tuple[Floats, float]]:
    """Iterate over centres and radii [m] of spheres that can touch the ground.

    A body without shapes has one point, at twice the position of its centre of mass.
    """
    if not body.shapes:
        yield 2.0 * np.array(body.inertial.com), 0.0
    for shape in body.shapes:
        rotation, centre = np.array(shape.placement.rotation), np.array(shape.placement.position)
        for local, radius in _shape_spheres(shape):
            yield centre + rotation @ local, radius


def _shape_spheres(shape: Shape) -> list[tuple[Floats, float]]:
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
