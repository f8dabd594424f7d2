"""Contacts over the plane that the ground is nearby: for SX and numpy arrays alike.

A contact that rolls is a sphere whose centre moves on a circle about an axis to where it is deepest in the ground: a
rim, like a wheel on a plane. With the sine `s` of the angle between axis and normal, its deepest point
is a radius times `s` below the centre of the circle, in the direction of `n - (n . a) a`, which has none left where the
disc lies flat. There `s` is taken as `sqrt(s^2 + FLAT^2)`, in the direction and in the depth alike, so that force and
depth are still those of one potential: the point goes smoothly to the centre of the disc.
"""

from __future__ import annotations

from typing import Any

FLAT = 0.01
"""How far a disc leans whose point is 0.7 of the way out [rad]; a wheel is larger by half of its square, as a share."""


def above(z: Any, height: Any, slope_x: Any, slope_y: Any) -> Any:
    """Return the distance of a point from the ground, along its normal [m].

    Args:
        z: Of the point [m].
        height: Of the ground under it [m].
        slope_x: dz/dx there.
        slope_y: dz/dy there.
    """
    return _cosine(slope_x, slope_y) * (z - height)


def lift(distance: Any, z: Any, height: Any, slope_x: Any, slope_y: Any) -> Any:
    """Return how far to raise a point for it to be at a distance from the ground [m]; arguments as for `above`."""
    return distance / _cosine(slope_x, slope_y) - (z - height)


def reach(radius: Any, rim: Any, axis: Any, slope_x: Any = 0.0, slope_y: Any = 0.0) -> Any:
    """Return how far a contact reaches from its centre towards the ground [m].

    Args:
        radius: Of the sphere [m].
        rim: Radius of the circle on which it moves [m]; 0 for a sphere that does not.
        axis: Of the circle, in the world, shape (3, ...).
        slope_x: dz/dx of the ground.
        slope_y: dz/dy of the ground.
    """
    return radius + rim * sine(_cosine(slope_x, slope_y) * (axis[2] - slope_x * axis[0] - slope_y * axis[1]))


def above_deepest(radius: Any, rim: Any, normal: Any, axis: Any, cosine: Any) -> Any:
    """Return the way from a contact's deepest point to its centre [m], in the axes of both `normal` and `axis`.

    Args:
        radius: Of the sphere [m].
        rim: Radius of the circle on which it moves [m].
        normal: Unit normal of the ground.
        axis: Of the circle, a unit vector.
        cosine: Of the angle between them.
    """
    return radius * normal + rim * ((normal - cosine * axis) / sine(cosine))


def sine(cosine: Any) -> Any:
    """Return the sine of an angle between an axis and a normal, `FLAT` at the least."""
    return (1 - cosine * cosine + FLAT * FLAT) ** 0.5


def _cosine(slope_x: Any, slope_y: Any) -> Any:
    return 1 / (1 + (slope_x * slope_x + slope_y * slope_y)) ** 0.5
