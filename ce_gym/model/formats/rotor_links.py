"""Rotors in file formats without rotors.

Vendors write a rotor as a link on a fixed joint, or publish only its moment of inertia about the axis (or the reflected
inertia). A published inertia of a link includes its motor. A rotor with a known moment only therefore becomes a thin
disc without mass, and its inertia at rest is subtracted from its carrier: total mass and inertia do not change.
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
    """A link on a fixed joint that is not merged into its carrier.

    Attributes:
        carrier: The body that carries the link; None for the world.
        placement: Pose in that body.
        inertial: Mass properties in the link's frame.
        shapes: Shapes to draw, in the link's frame.
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
    """Return a carrier's mass properties without the inertia of rotors at rest; None if the rest is not positive."""
    rest = np.array(carrier.inertia)
    for rotor in rotors:
        axes = np.array(rotor.placement.rotation)
        rest = rest - axes @ np.array(rotor.inertial.inertia) @ axes.T
    if np.linalg.eigvalsh(rest)[0] <= 0.0:
        return None
    return Inertial(carrier.mass, carrier.com, mat3((rest + rest.T) / 2))
