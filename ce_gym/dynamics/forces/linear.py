"""Forces that are linear in the accelerations over a step, and these accelerations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.recursion.ce_aba import Articulation


def is_moment(dt: SX | float) -> bool:
    """Whether a step has no length: the acceleration of the moment is wanted."""
    return isinstance(dt, float) and dt == 0


@dataclass
class JointForce:
    """A force on coordinates, `tau - slope @ ydd` over the step.

    Attributes:
        tau: At zero acceleration [N m or N], shape (n,).
        slope: Symmetric [kg m^2 or kg], shape (n, n).
    """

    tau: SX
    slope: SX

    def __add__(self, other: JointForce) -> JointForce:
        """Return the sum of both."""
        return JointForce(self.tau + other.tau, self.slope + other.slope)

    def at(self, ydd: SX) -> SX:
        """Return the force at an acceleration, shape (n,)."""
        return self.tau - self.slope @ ydd


@dataclass
class Motion:
    """The accelerations over a step.

    Attributes:
        ydd: Of the independent joints, shape (nj,).
        a: Of each body minus gravity, body coordinates, shape (6,) each.
        gravity: Acceleration of free fall, world axes, shape (3,).
        articulation: Inertias of the recursion that found them; None if it is unknown.
        gains: Change of the velocity of points in the step where it is known otherwise, by contact, shape (3,) each.
    """

    ydd: SX
    a: dict[str, SX]
    gravity: SX
    articulation: Articulation | None = None
    gains: Mapping[Any, SX] = field(default_factory=dict)
