"""The standing pose of a robot whose file does not name an angle for every joint, or not the height of the base."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.clusters import Cluster, cluster_tree
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Body, Robot
from ce_gym.model.frames import rotation_matrix

Pairs = tuple[tuple[str, float], ...]
Array = NDArray[np.float64]


def complete_pose(pose: Pairs, bodies: Iterable[Body], independent: Sequence[str]) -> Pairs:
    """Return a pose of all independent joints; joints without angle are as near to zero as their limits allow.

    Args:
        pose: Pairs (body, angle) [rad or m].
        bodies: The robot's bodies.
        independent: Bodies whose joint coordinates are independent.
    """
    named, limits = dict(pose), {body.name: body.joint.position for body in bodies}
    nearest = [(joint, min(max(0.0, limits[joint][0]), limits[joint][1])) for joint in independent if joint in limits]
    return (*pose, *((joint, angle) for joint, angle in nearest if joint not in named and angle != 0.0))


def touching_height(robot: Robot) -> float | None:
    """Return the height of the base [m] at which the lowest contact touches flat ground in the standing pose.

    None without a floating base or contacts, or if the place of a contact depends on a closed loop: loops are assembled
    by `Model`, not by the readers of files.
    """
    if not (robot.floating and robot.contacts):
        return None
    coordinates: dict[str, float] = {}
    for cluster in cluster_tree(robot).clusters:
        if cluster.linear:
            coordinates |= _linear_coordinates(cluster, dict(robot.pose.joints))
    base = robot.bodies[0].name
    poses: dict[str | None, tuple[Array, Array]] = {base: (np.zeros(3), np.eye(3))}
    for body in robot.bodies[1:]:
        if body.parent in poses and (body.name in coordinates or body.joint.type == "ball"):
            position, rotation = poses[body.parent]
            place, turn = np.array(body.placement.position), rotation @ np.array(body.placement.rotation)
            shift, spin = _motion(robot, body, coordinates.get(body.name, 0.0))
            poses[body.name] = position + rotation @ place + turn @ shift, turn @ spin
    if any(contact.body not in poses for contact in robot.contacts):
        return None
    return -min(contact.lowest_point(*poses[contact.body]) for contact in robot.contacts)


def _linear_coordinates(cluster: Cluster, pose: dict[str, float]) -> dict[str, float]:
    """Return the coordinates of the joints of a cluster without loops [rad or m]."""
    known = {name: pose.get(name, 0.0) for name in cluster.independent}
    rows = [(dict(c.coefficients), c.offset) for c in cluster.constraints if isinstance(c, LinearConstraint)]
    dependent = [name for name in cluster.bodies if name not in known]
    if not rows:
        return known
    A = np.array([[row.get(name, 0.0) for name in dependent] for row, _ in rows])
    b = [offset - sum(row.get(name, 0.0) * x for name, x in known.items()) for row, offset in rows]
    return known | dict(zip(dependent, np.linalg.lstsq(A, np.array(b), rcond=None)[0].tolist(), strict=True))


def _motion(robot: Robot, body: Body, coordinate: float) -> tuple[Array, Array]:
    """Return the translation [m] and rotation of a joint in the frame of its body."""
    if body.joint.type == "ball":
        return np.zeros(3), rotation_matrix(np.array(robot.standing_balls[body.name]))
    axis, angle = np.array(body.joint.axis), body.joint.turn * coordinate
    quaternion = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])
    return body.joint.slide * coordinate * axis, rotation_matrix(quaternion)
