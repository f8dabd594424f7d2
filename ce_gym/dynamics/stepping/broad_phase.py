"""Broad phase: pairs of links, and contacts other than feet, are evaluated only where they may touch in a step.

Culled groups are the groups of contacts except feet, and all pairs of links. Whether a group of a robot is in range
follows from the robot's own state alone. Tiles in which no robot has a group in range skip the group with the same
bits, so results do not depend on neighbours. Two bodies are in range if their distance is below `MARGIN`, or will be
within `STEPS` steps at their present approach velocity. A body that an impact accelerates further than that within the
step begins to act in the next step.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import Touch

MARGIN = 0.01
"""Bodies that are closer are in range [m]."""
STEPS = 2.0
"""Bodies that come closer than `MARGIN` within this many steps are in range, too."""


def any_in_range(touches: Sequence[Touch], dt: float) -> SX:
    """Return 1 if one of the contacts or pairs is in range or loaded, else 0."""
    reach = [touch.depth - STEPS * dt * ca.fmin(ca.dot(touch.normal, touch.velocity), 0) for touch in touches]
    loads = ca.vertcat(*[touch.load for touch in touches])
    return ca.logic_or(ca.mmax(ca.vertcat(*reach)) > -MARGIN, ca.sum1(loads) > 0)
