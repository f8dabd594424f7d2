"""Checks of mass properties, placement and joint of one body; each raises a `RobotError` of one line."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from ce_gym.model.description import Body, Joint
from ce_gym.model.errors import invalid_value
from ce_gym.model.frames import Placement
from ce_gym.model.ranges import LARGEST_FIGURE, check_fields

RELATIVE_TOLERANCE = 1e-9


def check_body(body: Body, file: str, *, may_be_massless: bool = True) -> None:
    """Check one body.

    A rotor may have mass 0. A link that `may_be_massless` may have mass 0 if its inertia is 0 too.
    """
    where = f"{body.kind} {body.name!r}"
    mass = body.inertial.mass
    massless = body.kind == "rotor" or (may_be_massless and not np.any(body.inertial.inertia))
    if not math.isfinite(mass) or mass < 0.0 or (mass == 0.0 and not massless):
        raise invalid_value(file, f"{where} mass", mass, "a mass of 0 or more" if massless else "a mass above 0 [kg]")
    check_finite(file, f"{where} mass", (mass,))
    check_finite(file, f"{where} centre of mass", body.inertial.com)
    _check_inertia(file, f"{where} inertia", np.array(body.inertial.inertia))
    check_placement(file, f"{where} ", body.placement)
    for shape in body.shapes:
        check_placement(file, f"{where} {shape.type} ", shape.placement)
    if body.joint.type != "free":
        _check_joint(file, where, body.joint)


def _check_joint(file: str, where: str, joint: Joint) -> None:
    check_fields(joint, file, f"{where} joint ")
    if joint.type == "ball" and joint.friction:
        expected = "0, because ball joints have no dry friction"
        raise invalid_value(file, f"{where} joint friction", joint.friction, expected)
    if joint.type == "ball" and not (joint.position[0] == -math.inf and joint.position[1] > 0.0):
        raise invalid_value(file, f"{where} joint limits", joint.position, "no lower one, and an angle above 0 [rad]")
    check_axis(file, f"{where} joint axis", joint.axis)
    lower, upper = joint.position
    if not lower <= upper:
        raise invalid_value(file, f"{where} joint limits", joint.position, "a lower limit that is not above the upper")


def check_placement(file: str, key: str, placement: Placement) -> None:
    """Check that a pose is finite and its rotation is a rotation matrix."""
    check_finite(file, f"{key}position", placement.position)
    rotation = np.array(placement.rotation)
    check_finite(file, f"{key}rotation", rotation.ravel().tolist())
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) or np.linalg.det(rotation) < 0.0:
        raise invalid_value(file, f"{key}rotation", placement.rotation, "a rotation matrix")


def check_finite(file: str, key: str, values: Iterable[float]) -> None:
    """Check that all values are finite and not larger than `LARGEST_FIGURE`."""
    if not all(abs(value) <= LARGEST_FIGURE for value in values):
        raise invalid_value(file, key, tuple(values), f"finite numbers, up to {LARGEST_FIGURE:g} in size")


def check_unique(file: str, key: str, names: Iterable[str]) -> None:
    """Check that no name occurs twice."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise invalid_value(file, key, name, "a name that is used once")
        seen.add(name)


def check_axis(file: str, key: str, axis: Sequence[float]) -> None:
    """Check that an axis has three numbers and unit length."""
    if len(axis) != 3 or not math.isclose(math.hypot(*axis), 1.0, rel_tol=RELATIVE_TOLERANCE):
        raise invalid_value(file, key, axis, "a unit axis")


def _check_inertia(file: str, key: str, inertia: np.ndarray) -> None:
    if inertia.shape != (3, 3):
        raise invalid_value(file, key, inertia.tolist(), "3 x 3 finite numbers")
    check_finite(file, key, inertia.ravel().tolist())
    scale = np.abs(inertia).max()
    if np.abs(inertia - inertia.T).max() > RELATIVE_TOLERANCE * scale:
        raise invalid_value(file, key, inertia.tolist(), "a symmetric matrix")
    if scale > 0.0 and np.linalg.eigvalsh(inertia / scale)[0] < -RELATIVE_TOLERANCE:
        raise invalid_value(file, key, inertia.tolist(), "a positive semidefinite matrix")


def violates_triangle_inequality(body: Body) -> bool:
    """Whether one principal moment exceeds the sum of the others, which no rigid body can have."""
    small, middle, large = np.linalg.eigvalsh(np.array(body.inertial.inertia))
    return bool(large > (small + middle) * (1.0 + RELATIVE_TOLERANCE))


def moves_inertia(body: Body) -> bool:
    """Whether every motion of a body's joint moves some of its inertia."""
    inertia, axis = np.array(body.inertial.inertia), np.array(body.joint.axis)
    if body.joint.type == "free":
        return bool(body.inertial.mass > 0.0 and np.linalg.matrix_rank(inertia) == 3)
    if body.joint.type == "ball":
        com = np.array(body.inertial.com)
        about_joint = inertia + body.inertial.mass * (com @ com * np.eye(3) - np.outer(com, com))
        return bool(np.linalg.matrix_rank(about_joint, hermitian=True) == 3)
    offset = np.cross(axis, np.array(body.inertial.com))
    turned = axis @ inertia @ axis + body.inertial.mass * (offset @ offset)
    return bool(body.joint.turn**2 * turned + body.joint.slide**2 * body.inertial.mass > 0.0)
