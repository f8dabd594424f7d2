"""Rotors in files that have no word for them.

Vendors write a rotor as a link on a fixed joint; or they give its moment about the axis alone (or the reflected one).
A published inertia of a link includes the motor in it. A rotor of which only the moment is known therefore is a thin
disc without mass, whose inertia at rest is taken out of the body that carries it: mass and inertia stay those of the
file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ce_gym.model.description import Body, Inertial, Shape
from ce_gym.model.formats.placement import mat3
from ce_gym.model.frames import ZERO, Placement, Vec3


@dataclass(frozen=True)
class FixedLink:
    """A link that no joint moves, kept apart from the body that carries it.

    Attributes:
        carrier: The body that carries it; None is the world.
        placement: Pose in that body.
        inertial: Its own mass properties, own frame.
        shapes: What is drawn of it, own frame.
    """

    carrier: str | None
    placement: Placement
    inertial: Inertial
    shapes: tuple[Shape, ...] = ()


def disc(moment: float, axis: Vec3) -> Inertial:
    """Return a thin disc without mass.

    Args:
        moment: Moment of inertia about the axis [kg m^2].
        axis: Unit axis.
    """
    u = np.array(axis)
    return Inertial(0.0, ZERO, mat3(0.5 * moment * (np.eye(3) + np.outer(u, u))))


def without_rotors(carrier: Inertial, rotors: Iterable[Body]) -> Inertial | None:
    """Return a carrier's mass properties without the inertia at rest of rotors; None if it has not that much."""
    rest = np.array(carrier.inertia)
    for rotor in rotors:
        axes = np.array(rotor.placement.rotation)
        rest = rest - axes @ np.array(rotor.inertial.inertia) @ axes.T
    if np.linalg.eigvalsh(rest)[0] <= 0.0:
        return None
    return Inertial(carrier.mass, carrier.com, mat3((rest + rest.T) / 2))
