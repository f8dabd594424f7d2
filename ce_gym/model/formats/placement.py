"""Changes of frame of poses and mass properties, for loaders that merge rigidly joined bodies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ce_gym.model.description import Body, Frame, Inertial
from ce_gym.model.frames import IDENTITY, Mat3, Placement, Vec3, added

# Entries this close to 0 or 1 come from a rounded right angle. They are made exact because the compiler of the
# dynamics drops multiplications by 0 and 1, but not by sin(pi) = 1.2e-16.
_RIGHT_ANGLE_TOLERANCE = 1e-12


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Mat3:
    """Return the rotation of a URDF `rpy` triple [rad]: Rz(yaw) Ry(pitch) Rx(roll), child axes in the parent."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return exact_right_angles(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )


def exact_right_angles(rotation: Sequence[Sequence[float]] | np.ndarray) -> Mat3:
    """Return `rotation` with entries within 1e-12 of 0 and +-1 made exactly so."""

    def exact(x: float) -> float:
        nearest = float(round(x))
        return nearest if abs(x - nearest) <= _RIGHT_ANGLE_TOLERANCE else x

    return mat3([[exact(float(x)) for x in row] for row in rotation])


def compose(outer: Placement, inner: Placement) -> Placement:
    """Return the pose of `inner`, given in the frame `outer`, in the parent of `outer`."""
    rotation = np.array(outer.rotation) @ np.array(inner.rotation)
    return Placement(transform_point(outer, inner.position), exact_right_angles(rotation))


def named_frames(frames: Mapping[str, tuple[str | None, Placement]], bodies: Iterable[Body]) -> tuple[Frame, ...]:
    """Return the frames that are no bodies, given the body and the pose of each by name."""
    names = {body.name for body in bodies}
    return tuple(Frame(name, *place) for name, place in frames.items() if name not in names)


def transform_point(frame: Placement, point: Vec3) -> Vec3:
    """Return in the parent frame a point [m] given in `frame`."""
    if frame.rotation == IDENTITY:  # keep published digits
        return vec3([a + b for a, b in zip(frame.position, point, strict=True)])
    return vec3(np.array(frame.rotation) @ point + frame.position)


def transform_inertial(frame: Placement, inertial: Inertial) -> Inertial:
    """Return in the parent frame the mass properties of a body given in `frame`."""
    if frame == Placement():
        return inertial
    rotation = np.array(frame.rotation)
    inertia = rotation @ np.array(inertial.inertia) @ rotation.T
    return Inertial(inertial.mass, transform_point(frame, inertial.com), mat3((inertia + inertia.T) / 2))


def merge_inertials(parts: Sequence[Inertial]) -> Inertial:
    """Return the mass properties of rigidly joined bodies, all given in one frame (parallel axis theorem)."""
    if len(parts) == 1:
        return parts[0]
    mass = added(part.mass for part in parts)
    if mass == 0.0:
        return Inertial(0.0, parts[0].com, mat3(np.sum([part.inertia for part in parts], axis=0)))
    com = np.average([part.com for part in parts], axis=0, weights=[part.mass for part in parts])
    inertia = np.zeros((3, 3))
    for part in parts:
        lever = np.array(part.com) - com
        inertia += np.array(part.inertia) + part.mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
    return Inertial(mass, vec3(com), mat3(inertia))


def symmetric(ixx: float, ixy: float, ixz: float, iyy: float, iyz: float, izz: float) -> Mat3:
    """Return the symmetric matrix with these entries (matrix entries, not negated products) [kg m^2]."""
    return ((ixx, ixy, ixz), (ixy, iyy, iyz), (ixz, iyz, izz))


def vec3(values: Sequence[float] | np.ndarray) -> Vec3:
    """Return three numbers as a tuple of floats."""
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def mat3(rows: Sequence[Sequence[float]] | np.ndarray) -> Mat3:
    """Return a 3 x 3 matrix as a tuple of tuples of floats."""
    a, b, c = (vec3(row) for row in rows)
    return (a, b, c)
