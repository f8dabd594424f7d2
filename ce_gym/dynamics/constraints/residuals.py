"""The residual `phi(q)` of each kind of constraint, as a function of joint coordinates.

Closed loops and rods are expressed in the frame with the shortest expressions, because the expressions are later
differentiated and solved.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX, axis_rotation
from ce_gym.model.constraints import (
    Constraint,
    FunctionConstraint,
    LinearConstraint,
    LoopConstraint,
    PolynomialConstraint,
    RodConstraint,
    constraint_function,
)
from ce_gym.model.description import Body, Robot
from ce_gym.model.errors import RobotError, shown
from ce_gym.model.frames import Placement, Vec3
from ce_gym.model.mechanism import snapped

Angles = Mapping[str, SX]
Frame = tuple[SX, SX]
"""Rotation (columns are the frame's axes) and origin, seen from another frame."""


def residual(robot: Robot, constraint: Constraint, angles: Angles) -> SX:
    """Return the rows of one constraint.

    Args:
        robot: The robot.
        constraint: One of its constraints.
        angles: Joint coordinates by the name of the body they move.

    Returns:
        `phi`, zero where the constraint holds, shape (rows,): half the excess of squared length for rods [m^2], [m] for
        origins and [-] for axes of loops, the user's unit for functions.
    """
    return KINDS[type(constraint)].rows(robot, constraint, angles)


def gap(robot: Robot, constraint: Constraint, angles: Angles) -> SX:
    """Return the rows of one constraint, shape (rows,), with the rows of rods scaled to lengths [m]."""
    return residual(robot, constraint, angles) / KINDS[type(constraint)].scale(constraint)


def _linear(robot: Robot, constraint: LinearConstraint, angles: Angles) -> SX:
    return sum((a * angles[body] for body, a in constraint.coefficients), SX(-constraint.offset))


def _polynomial(robot: Robot, constraint: PolynomialConstraint, angles: Angles) -> SX:
    """Return the dependent coordinate less the polynomial, by Horner's rule."""
    value, argument = SX(0), angles[constraint.argument]
    for coefficient in reversed(constraint.coefficients):
        value = value * argument + coefficient
    return angles[constraint.dependent] - value


def _rod(robot: Robot, rod: RodConstraint, angles: Angles) -> SX:
    """`(|a|^2 + |b|^2 - L^2) / 2 - a.b`, with `a` and `b` measured from the joint of `first`."""
    (body, point), (other, other_point) = (rod.first, rod.first_point), (rod.second, rod.second_point)
    common = common_ancestor(robot, body, other)
    if body == common:
        (body, point), (other, other_point) = (other, other_point), (body, point)
    origin = _first_joint(robot, body, common).placement.position
    a, a_varying, a_constant = _reach(robot, body, common, point, origin, angles)
    b, b_varying, b_constant = _reach(robot, other, common, other_point, origin, angles)
    return a_varying + b_varying + (a_constant + b_constant - rod.length**2 / 2) - ca.dot(a, b)


def _first_joint(robot: Robot, body: str | None, ancestor: str | None) -> Body:
    """Return the body that leads from an ancestor towards another body."""
    chain = lineage(robot, body)
    return robot.body(str(chain[chain.index(ancestor) - 1]))


def _reach(
    robot: Robot, body: str | None, ancestor: str | None, point: Vec3, origin: Vec3, angles: Angles
) -> tuple[SX, SX, float]:
    """Return a point of a body relative to `origin` in the ancestor's frame, and half its squared distance from there.

    The square is summed joint by joint, `|o + R x|^2 = |o|^2 + |x|^2 + 2 o.(R x)`, in a varying and a constant part.
    """
    chain = lineage(robot, body)
    inside = chain[: chain.index(ancestor)]
    x, varying, fixed = constant(point), SX(0), _square(point) / 2
    for name in inside:
        part = robot.body(str(name))
        axis, home = constant(snapped(np.array(part.joint.axis))), constant(snapped(np.array(part.placement.rotation)))
        turn, slide, angle = part.joint.turn, part.joint.slide, angles[part.name]
        if not slide:
            x = home @ axis_rotation(axis, turn * angle).T @ x
        else:
            x = home @ ((axis_rotation(axis, turn * angle).T @ x if turn else x) + axis * (slide * angle))
            varying, fixed = ca.sumsqr(x) / 2, 0.0
        offset = np.array(part.placement.position) - (origin if name == inside[-1] else np.zeros(3))
        varying, fixed = varying + ca.dot(constant(offset), x), fixed + _square(offset) / 2
        x = constant(offset) + x
    if inside:
        return x, varying, fixed
    away = np.array(point) - origin
    return constant(away), SX(0), _square(away) / 2


def _square(vector: Sequence[float] | np.ndarray) -> float:
    """Return the squared length of a 3-vector, summed in order; the rounding of BLAS depends on the CPU."""
    x, y, z = map(float, vector)
    return x * x + y * y + z * z


def _loop(robot: Robot, loop: LoopConstraint, angles: Angles) -> SX:
    """Return the difference of the origins, along and across the axis of `second` at zero angles, then of the axes."""
    common = common_ancestor(robot, loop.first, loop.second)
    R1, p1 = within(frame_in(robot, loop.first, common, angles), loop.first_placement)
    R2, p2 = within(frame_in(robot, loop.second, common, angles), loop.second_placement)
    zero = {name: SX(0) for name in angles}
    home, _ = within(frame_in(robot, loop.second, common, zero), loop.second_placement)
    axis = np.array(loop.axis)
    across = np.array(across_axis(np.array(ca.DM(home).full()) @ axis))
    basis = constant(np.vstack([across, np.cross(across[0], across[1])]))
    gap = basis @ (p1 - p2)
    if loop.joint == "ball":
        return gap
    tilt = constant(np.array(across_axis(axis))) @ R2.T @ R1 @ constant(axis)
    return ca.vertcat(gap, tilt)


def _function(robot: Robot, constraint: FunctionConstraint, angles: Angles) -> SX:
    key = f"{robot.source or robot.name}: constraint {constraint.name!r}: function {constraint.function!r}"
    function = constraint_function(constraint.function)
    try:
        values = list(function([angles[body] for body in constraint.arguments]))
    except Exception as error:  # whatever users' own code raises
        reason = str(error).strip().split("\n")[0]
        raise RobotError(f"{key} fails with {type(error).__name__}: {reason}") from None
    for value in values:
        if not isinstance(value, SX | ca.DM | float | int) or SX(value).numel() != 1:
            raise RobotError(f"{key} returned {shown(value)}: expected numbers and expressions, one for each row")
    if constraint.dependent and len(values) != len(constraint.dependent):
        expected = f"expected {len(constraint.dependent)}, one for each dependent body"
        raise RobotError(f"{key} returned {len(values)} values: {expected}")
    explicit = [angles[body] for body in constraint.dependent]
    return ca.vertcat(*[q - value for q, value in zip(explicit, values, strict=True)] if explicit else values)


def common_ancestor(robot: Robot, first: str | None, second: str | None) -> str | None:
    """Return the nearest body that is, or carries, each of two bodies; None for the world."""
    above = lineage(robot, first)
    return next(body for body in lineage(robot, second) if body in above)


def lineage(robot: Robot, body: str | None) -> list[str | None]:
    """Return a body and its ancestors out to the world (None), nearest first."""
    chain = [body]
    while chain[-1] is not None:
        chain.append(robot.body(chain[-1]).parent)
    return chain


def frame_in(robot: Robot, body: str | None, ancestor: str | None, angles: Angles) -> Frame:
    """Return the frame of a body in the frame of its ancestor."""
    frame: Frame = (SX.eye(3), SX(3, 1))
    chain = lineage(robot, body)
    for name in reversed(chain[: chain.index(ancestor)]):
        part = robot.body(str(name))
        frame = within(frame, part.placement)
        axis, q, joint = constant(snapped(np.array(part.joint.axis))), angles[str(name)], part.joint
        turned = axis_rotation(axis, joint.turn * q).T if joint.turn else SX.eye(3)
        moved = axis * (joint.slide * q) if joint.slide else SX(3, 1)
        frame = frame[0] @ turned, frame[1] + frame[0] @ moved
    return frame


def within(frame: Frame, placement: Placement) -> Frame:
    """Return the frame at a placement in another frame."""
    R, p = frame
    return R @ constant(snapped(np.array(placement.rotation))), p + R @ constant(placement.position)


def across_axis(axis: np.ndarray) -> list[np.ndarray]:
    """Return two unit vectors across a unit axis; for a coordinate axis they are coordinate axes."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = snapped(np.cross(helper, axis) / np.linalg.norm(np.cross(helper, axis)))
    return [first, snapped(np.cross(axis, first))]


def constant(x: object) -> SX:
    """Return numbers as a sparse SX, so that zeros are structural."""
    return SX(ca.sparsify(ca.DM(np.asarray(x, dtype=float))))


@dataclass(frozen=True)
class Kind:
    """The equations of a kind of constraint.

    Attributes:
        rows: Function (robot, constraint, angles) -> residual rows, see `residual`.
        scale: Function constraint -> divisor that scales the rows to lengths or angles.
    """

    rows: Callable[[Robot, Any, Angles], SX]
    scale: Callable[[Any], float] = lambda constraint: 1.0


KINDS: dict[type[Constraint], Kind] = {
    LinearConstraint: Kind(_linear),
    PolynomialConstraint: Kind(_polynomial),
    LoopConstraint: Kind(_loop),
    RodConstraint: Kind(_rod, lambda rod: rod.length),
    FunctionConstraint: Kind(_function),
}
