"""Only what is near: contacts that are declared to be seldom, and pairs of links, act where they may touch in a step.

A robot for which nothing of these is near makes the step without them. Whether it is follows from its own state alone,
and tiles in which no robot has anything near compute what is left of the same function, to the same bits, so that no
result depends on neighbours. Near is what is within a margin of the other, or would be within two steps at the speed at
which it approaches; what gets a speed from elsewhere in the step that takes it further begins to act in the step after
it.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import Touch
from ce_gym.dynamics.forces.scene import StepOptions

MARGIN = 0.01
"""What is nearer than this is near [m]."""
STEPS = 2.0
"""What comes as near as that within so many steps at the speed that it has is near, too."""


def chooses(options: StepOptions) -> bool:
    """Whether something of a scene acts only where it is near."""
    return bool(options.seldom or options.self_collisions)


def anything_near(touches: Sequence[Touch], dt: float) -> SX:
    """Return 1 if one of them is near or loaded, else 0."""
    reach = [touch.depth - STEPS * dt * ca.fmin(ca.dot(touch.normal, touch.velocity), 0) for touch in touches]
    loads = ca.vertcat(*[touch.load for touch in touches])
    return ca.logic_or(ca.mmax(ca.vertcat(*reach)) > -MARGIN, ca.sum1(loads) > 0)
