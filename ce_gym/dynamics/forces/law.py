"""What every force on a robot is to a step: linear for one active set, which iterations find.

A contact acts or not, sticks or slips, a motor is at a limit or not: an active set. A `ForceLaw` linearises its force
about an iterate, which says the set that is assumed; given the accelerations that come of it, the `LinearForce` checks
whether that is the set it is in now, and returns the next iterate. This is Newton's method on the implicit step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ce_gym.dynamics.algebra.spatial import SX


def is_moment(dt: SX | float) -> bool:
    """Whether a step has no length: what is asked for is the acceleration of the moment."""
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
        """Return both acting together."""
        return JointForce(self.tau + other.tau, self.slope + other.slope)


@dataclass
class Motion:
    """The accelerations over a step.

    Attributes:
        ydd: Of the independent joints, shape (nj,).
        a: Of each body minus gravity, body coordinates, shape (6,) each.
        gravity: Acceleration of free fall in the axes of each body, shape (3,) each.
    """

    ydd: SX
    a: dict[str, SX]
    gravity: dict[str, SX]


class LinearForce(Protocol):
    """A force that is linear in the accelerations, with the active set of an iterate."""

    def check(self, motion: Motion) -> SX:
        """Return 1 if the active set is another one than was assumed, so that another iteration is needed; else 0."""
        ...

    def next_iterate(self, motion: Motion) -> SX:
        """Return the iterate for another iteration, shape (size,)."""
        ...


class ForceLaw(Protocol):
    """A force on a robot over one step.

    Attributes:
        size: How many numbers its iterate has; they are all zero at first.
    """

    @property
    def size(self) -> int:
        """See above."""
        ...

    def linearise(self, iterate: SX) -> LinearForce:
        """Linearise about an iterate, shape (size,)."""
        ...
