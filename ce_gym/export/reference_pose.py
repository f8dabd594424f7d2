"""Where every joint is when the robot stands: closed loops assembled, in numbers.

For whoever has to draw or write down a robot without its dynamics. It finds the configuration that the dynamics
starts from: the standing pose for independent joints, and for the others the solution of all constraints that is
nearest to the robot's `assembly`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ce_gym.export.joint_ties import Tie, clusters_with_loops, joint_ties
from ce_gym.model.clusters import Cluster
from ce_gym.model.description import LoopConstraint, Placement, Robot, RodConstraint, Vec3
from ce_gym.model.errors import RobotError
from ce_gym.model.mechanism import skew

Array = NDArray[np.float64]
Frame = tuple[Array, Array]
"""Rotation, shape (3, 3), whose columns are a body's axes, and origin [m], shape (3,), in the frame of the base."""

CLOSED = 1e-10
"""Largest residual of a loop that is closed [m, rad or -]."""
ITERATIONS = 200
LARGEST_STEP = 0.3
"""No joint moves further in one iteration [rad or m], so that the solution stays on the branch where it began."""


def reference_pose(robot: Robot, ties: Mapping[str, Tie] | None = None) -> dict[str, float]:
    """Return the coordinate [rad or m] of every joint but a floating base's, by the name of the body it moves.

    Args:
        robot: A robot without constraints that are functions.
        ties: Its `joint_ties`, if they are known.

    Raises:
        RobotError: The independent joints do not determine the others, or a loop does not close.
    """
    ties = joint_ties(robot) if ties is None else ties
    given = dict(robot.assembly) | dict(robot.pose.joints)
    kept = {name: given.get(name, 0.0) for name, tie in ties.items() if name in tie.ratios}
    for cluster in clusters_with_loops(robot):
        kept |= _closed(robot, cluster, {name: ties[name] for name in cluster.bodies}, kept)
    return {name: tie.at(kept) for name, tie in ties.items()}


def turned(axis: Array, angle: float) -> Array:
    """Return the rotation by an angle [rad] about a unit axis, shape (3, 3) (Rodrigues)."""
    u = skew(axis)
    return np.eye(3) + np.sin(angle) * u + (1.0 - np.cos(angle)) * u @ u


def _closed(robot: Robot, cluster: Cluster, ties: Mapping[str, Tie], given: Mapping[str, float]) -> dict[str, float]:
    """Return the joints that only the loops of a cluster determine, by a damped Gauss-Newton iteration from `given`."""
    free = [name for name, tie in ties.items() if name in tie.ratios and name not in cluster.independent]
    spread = np.array([[tie.ratios.get(name, 0.0) for name in free] for tie in ties.values()])
    kept, rows, gap = dict(given), _Rows(robot, cluster), np.inf
    for _ in range(ITERATIONS):
        phi, slope = rows.at({name: tie.at(kept) for name, tie in ties.items()})
        gap = float(np.abs(phi).max())
        if gap < 1e-15:
            break
        step = -np.linalg.lstsq(slope @ spread, phi, rcond=1e-10)[0]
        step *= min(1.0, LARGEST_STEP / max(np.abs(step).max(initial=0.0), 1e-300))
        kept |= {name: kept[name] + float(x) for name, x in zip(free, step, strict=True)}
    if not gap < CLOSED:
        names = ", ".join(tie.name for tie in cluster.constraints)
        raise RobotError(
            f"{robot.source or robot.name}: the cluster tied by {names} does not close at the standing pose, "
            f"gap {gap:.2g}: expected `pose` and `assembly` near"
        )
    return {name: kept[name] for name in free}


class _Rows:
    """What must vanish in a cluster's loops and rods, and how it changes with the joints of its bodies."""

    def __init__(self, robot: Robot, cluster: Cluster) -> None:
        self.robot, self.bodies = robot, cluster.bodies
        self.ties = [tie for tie in cluster.constraints if isinstance(tie, LoopConstraint | RodConstraint)]
        self.parents = {body.name: body.parent for body in robot.bodies}
        self.frames: dict[str | None, Frame] = {}

    def at(self, angles: Mapping[str, float]) -> tuple[Array, Array]:
        """Return all rows, shape (n,), and their derivatives by the cluster's joints, shape (n, n_bodies)."""
        self._place(angles)
        parts = [self._loop(tie) if isinstance(tie, LoopConstraint) else self._rod(tie) for tie in self.ties]
        return np.concatenate([phi for phi, _ in parts]), np.vstack([slope for _, slope in parts])

    def _place(self, angles: Mapping[str, float]) -> None:
        """Place all bodies; joints that are not named are at zero, and so is a floating base."""
        self.frames = {None: (np.eye(3), np.zeros(3))}
        for body in self.robot.bodies:
            R, p = self.frames[body.parent]
            axis, angle = np.array(body.joint.axis), angles.get(body.name, 0.0)
            p, R = p + R @ np.array(body.placement.position), R @ np.array(body.placement.rotation)
            if body.joint.type == "prismatic":
                p = p + R @ axis * angle
            elif body.joint.type == "revolute":
                R = R @ turned(axis, angle)
            self.frames[body.name] = R, p

    def _rod(self, rod: RodConstraint) -> tuple[Array, Array]:
        first, second = self._point(rod.first, rod.first_point), self._point(rod.second, rod.second_point)
        d, slope = first[0] - second[0], first[1] - second[1]
        return np.array([(d @ d / rod.length - rod.length) / 2]), (d @ slope / rod.length)[None]

    def _loop(self, loop: LoopConstraint) -> tuple[Array, Array]:
        ends = ((loop.first, loop.first_placement), (loop.second, loop.second_placement))
        first, second = (self._point(body, place.position) for body, place in ends)
        phi, slope = first[0] - second[0], first[1] - second[1]
        if loop.joint == "ball":
            return phi, slope
        first, second = (self._direction(body, place, loop.axis) for body, place in ends)
        return np.concatenate([phi, first[0] - second[0]]), np.vstack([slope, first[1] - second[1]])

    def _point(self, body: str | None, point: Vec3) -> tuple[Array, Array]:
        """Return where a point of a body is [m], shape (3,), and its derivatives, shape (3, n_bodies)."""
        R, p = self.frames[body]
        x, slope = p + R @ np.array(point), np.zeros((3, len(self.bodies)))
        for column, joint, axis, origin in self._movers(body):
            slope[:, column] = np.cross(axis, x - origin) if joint == "revolute" else axis
        return x, slope

    def _direction(self, body: str | None, place: Placement, axis: Vec3) -> tuple[Array, Array]:
        """Return where an axis of a frame on a body points, shape (3,), and its derivatives, shape (3, n_bodies)."""
        u, slope = self.frames[body][0] @ np.array(place.rotation) @ np.array(axis), np.zeros((3, len(self.bodies)))
        for column, joint, about, _ in self._movers(body):
            slope[:, column] = np.cross(about, u) if joint == "revolute" else 0.0
        return u, slope

    def _movers(self, body: str | None) -> list[tuple[int, str, Array, Array]]:
        """Return the cluster's joints that move a body: column, type, axis and a point on it."""
        found = []
        while body is not None:
            if body in self.bodies:
                joint, (R, p) = self.robot.body(body).joint, self.frames[body]
                found.append((self.bodies.index(body), joint.type, R @ np.array(joint.axis), p))
            body = self.parents[body]
        return found
