"""Pairs of links that may collide: pairs that do not overlap in the standing pose."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.self_collision import nearest
from ce_gym.dynamics.standing import Standing, standing_pose
from ce_gym.model.checks.collisions import capsules_of, separate_links
from ce_gym.model.description import Capsule
from ce_gym.model.mechanism import Mechanism


def apart_when_standing(mechanism: Mechanism) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links that are not adjacent and whose capsules do not overlap in the standing pose."""
    standing, robot = standing_pose(mechanism), mechanism.robot
    return tuple(
        (first, second)
        for first, second in separate_links(robot)
        if all(distance(standing, a, b) > 0 for a in capsules_of(robot, first) for b in capsules_of(robot, second))
    )


def distance(standing: Standing, a: Capsule, b: Capsule) -> float:
    """Return the distance of two capsules [m], negative if they overlap."""
    points = [(capsule.body, np.array(end)) for capsule in (a, b) for end in (capsule.start, capsule.end)]
    ends = [standing.p[body] + standing.R[body] @ point for body, point in points]
    shares = nearest(*[SX(ca.DM(end)) for end in ends], long=(a.start != a.end, b.start != b.end))
    s, t = (float(ca.evalf(SX(share))) for share in shares)
    apart = ends[0] + s * (ends[1] - ends[0]) - ends[2] - t * (ends[3] - ends[2])
    return float(np.linalg.norm(apart)) - a.radius - b.radius
