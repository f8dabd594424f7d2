"""Checks of complete robot descriptions, from files or from code.

Each check raises a `RobotError` of one line for the first mistake.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import fields, is_dataclass
from fnmatch import fnmatchcase
from functools import cache
from typing import Any

import numpy as np

from ce_gym.model.checks.body import (
    check_axis,
    check_body,
    check_finite,
    check_placement,
    check_unique,
    moves_inertia,
    violates_triangle_inequality,
)
from ce_gym.model.checks.collisions import adjacent, capsules_of
from ce_gym.model.checks.constraint import check_constraint
from ce_gym.model.checks.drives import check_elastic, check_motors
from ce_gym.model.clusters import Cluster, cluster_tree
from ce_gym.model.constraints import Constraint, LinearConstraint
from ce_gym.model.coordinates import UNIT_TOLERANCE
from ce_gym.model.description import Body, Robot
from ce_gym.model.errors import InertiaWarning, invalid_value, listed_names, unknown_name
from ce_gym.model.mechanism import without_stretches
from ce_gym.model.ranges import check_fields

MOST_BODIES = 500
"""Most bodies of a robot; costs grow faster than the number of bodies."""
LIMIT_TOLERANCE = 1e-6
"""Tolerance of joint limits in the standing pose, for rounded numbers [rad or m]."""
LONGEST_NAME = 200
"""Most characters of a name."""


def check_robot(robot: Robot) -> None:
    """Check a whole robot.

    Raises:
        RobotError: The robot is impossible.

    Warns:
        InertiaWarning: An inertia violates the triangle inequality and is not listed in `kept_inertia`; once per
            process and robot.
    """
    file = str(robot.source or robot.name)
    check_description(robot, file)
    robot = without_stretches(robot)
    _check_names(robot, file)
    _check_tree(robot, file)
    supported = {body.parent for body in robot.bodies} | _dependent(robot)
    for body in robot.bodies:
        check_body(body, file, may_be_massless=body.name in supported and body.joint.type != "free")
    _check_constraints(robot, file)
    _check_independent(robot, file)
    _check_something_moves(robot, file)
    _check_frames(robot, file)
    _check_contacts(robot, file)
    check_motors(robot, file)
    check_elastic(robot, file)
    _check_pose_and_gains(robot, file)
    _check_inertia(robot, file)


def check_description(description: Any, file: str, prefix: str = "") -> None:
    """Check the types and ranges of all fields of a description and of its parts.

    Args:
        description: A dataclass.
        file: Name of the file, for messages.
        prefix: Beginning of keys in messages.

    Raises:
        RobotError: A value has another type or is out of range.
    """
    check_fields(description, file, prefix)
    for field in fields(description):
        value = getattr(description, field.name)
        for part in value if isinstance(value, tuple) else (value,):
            if is_dataclass(part):
                check_description(part, file, _prefix(prefix, field.name, part))


def _prefix(prefix: str, field: str, part: Any) -> str:
    """Return the beginning of keys for a part of a description, in the words of robot files."""
    if isinstance(part, Body | Constraint):
        return f"{part.kind if isinstance(part, Body) else 'constraint'} {part.name!r} "
    if prefix.endswith(" "):
        return f"{prefix}{field} "
    label = next((f"{getattr(part, key)}." for key in ("name", "rotor", "body") if hasattr(part, key)), "")
    return f"{prefix}{field.removeprefix('drive_')}.{label}"


def _check_names(robot: Robot, file: str) -> None:
    """Check that names can be printed on one line, without escape sequences."""
    if len(robot.bodies) > MOST_BODIES:
        raise invalid_value(file, "number of bodies", len(robot.bodies), f"at most {MOST_BODIES}")
    names = {"name": [robot.name], "task": [name for name, _ in robot.tasks]}
    names |= {f"{kind} name": [body.name for body in robot.bodies if body.kind == kind] for kind in ("link", "rotor")}
    names["constraint name"] = [constraint.name for constraint in robot.constraints]
    names["contact name"] = [contact.name for contact in robot.contacts]
    names["frame name"] = [frame.name for frame in robot.frames]
    names["contact group"] = [contact.group for contact in robot.contacts]
    for key, listed in names.items():
        for name in listed:
            if not name or not name.isprintable() or len(name) > LONGEST_NAME:
                raise invalid_value(file, key, name, f"1 to {LONGEST_NAME} characters that can be printed")


def _check_inertia(robot: Robot, file: str) -> None:
    """Warn of inertias that no rigid body can have, unless `kept_inertia` lists them."""
    impossible = [body.name for body in robot.bodies if violates_triangle_inequality(body)]
    check_unique(file, "kept_inertia", robot.kept_inertia)
    for pattern in robot.kept_inertia:
        if not any(fnmatchcase(name, pattern) for name in impossible):
            expected = f"one of {listed_names(pattern, impossible)}" if impossible else "no pattern: all are possible"
            raise invalid_value(file, "kept_inertia", pattern, expected)
    unlisted = [name for name in impossible if not any(fnmatchcase(name, pattern) for pattern in robot.kept_inertia)]
    if unlisted:
        _warn_of_inertia(robot.name, tuple(unlisted))


def _dependent(robot: Robot) -> set[str]:
    """Return the bodies with dependent joints; such bodies, and bodies that carry others, may be massless."""
    tied = {name for constraint in robot.constraints for name in constraint.bodies}
    return tied - set(robot.independent)


def _check_tree(robot: Robot, file: str) -> None:
    """Check that names are unique, parents come first, and only the first body is free."""
    if not robot.bodies:
        expected = "at least one body that moves: a moving joint, or a root link with mass"
        raise invalid_value(file, "bodies", (), expected)
    seen: list[str] = []
    for body in robot.bodies:
        if body.name in seen:
            raise invalid_value(file, "body name", body.name, "a name that no other body has")
        if body.parent is not None and body.parent not in seen:
            raise unknown_name(file, f"{body.kind} {body.name!r} parent", body.parent, seen, "a body listed before it")
        if body.joint.type in ("ball", "prismatic") and body.kind == "rotor":
            expected = "revolute, because rotors spin"
            raise invalid_value(file, f"rotor {body.name!r} joint type", body.joint.type, expected)
        if body.joint.type == "free" and (seen or body.parent is not None):
            raise invalid_value(
                file, f"{body.kind} {body.name!r} joint type", "free", "free only for the first body, on the world"
            )
        seen.append(body.name)


def _check_constraints(robot: Robot, file: str) -> None:
    check_unique(file, "constraint name", [constraint.name for constraint in robot.constraints])
    for constraint in robot.constraints:
        check_constraint(constraint, robot, file)


def _check_independent(robot: Robot, file: str) -> None:
    names = [body.name for body in robot.bodies if body.joint.nv == 1]
    for joint in robot.independent:
        if joint not in names:
            expected = "the name of a body whose joint has one degree of freedom"
            raise unknown_name(file, "independent", joint, names, expected)
    check_unique(file, "independent", robot.independent)
    for cluster in cluster_tree(robot).clusters:
        if cluster.linear and robot.body(cluster.bodies[0]).joint.nv == 1:
            _check_determined(cluster, file)  # others are solved to be checked: a Model does


def _check_determined(cluster: Cluster, file: str) -> None:
    """Check that the constraints of a cluster determine its dependent coordinates from the independent ones."""
    rows = [dict(tie.coefficients) for tie in cluster.constraints if isinstance(tie, LinearConstraint)]
    count = len(cluster.bodies) - len(rows)
    key = f"independent joints among {', '.join(cluster.bodies)}"
    if count < 1:
        ties = tuple(constraint.name for constraint in cluster.constraints)
        expected = "fewer constraints than bodies"
        raise invalid_value(file, f"constraints among {', '.join(cluster.bodies)}", ties, expected)
    if len(cluster.independent) != count:
        expected = f"{count} of them, because {len(rows)} constraints tie the rest"
        raise invalid_value(file, key, cluster.independent, expected)
    dependent = [body for body in cluster.bodies if body not in cluster.independent]
    K = np.array([[row.get(body, 0.0) for body in dependent] for row in rows]).reshape(len(rows), len(rows))
    scale = np.abs(K).max(axis=1, initial=0.0, keepdims=True)
    if (scale == 0.0).any() or np.linalg.matrix_rank(K / scale) < len(rows):
        expected = f"joints that determine {', '.join(dependent)}; these do not"
        raise invalid_value(file, key, cluster.independent, expected)


def _check_something_moves(robot: Robot, file: str) -> None:
    """Check that the joint of each body without children and constraints moves some inertia."""
    tied = {name for constraint in robot.constraints for name in constraint.bodies}
    for body in robot.bodies:
        if body.name not in tied | {other.parent for other in robot.bodies} and not moves_inertia(body):
            expected = "a mass or an inertia that its joint moves"
            raise invalid_value(file, f"{body.kind} {body.name!r} inertia", body.inertial.inertia, expected)


def _check_frames(robot: Robot, file: str) -> None:
    bodies = [body.name for body in robot.bodies]
    check_unique(file, "frame name", [*bodies, *(frame.name for frame in robot.frames)])
    for frame in robot.frames:
        key = f"frames.{frame.name}"
        if frame.body is not None and frame.body not in bodies:
            raise unknown_name(file, f"{key}.body", frame.body, bodies, "the name of a body")
        check_placement(file, f"{key} ", frame.placement)


def _check_contacts(robot: Robot, file: str) -> None:
    check_unique(file, "contact name", [contact.name for contact in robot.contacts])
    names = [body.name for body in robot.bodies]
    for contact in robot.contacts:
        key = f"contacts.{contact.name}"
        if contact.body not in names:
            raise unknown_name(file, f"{key}.body", contact.body, names, "the name of a body")
        if robot.body(contact.body).kind == "rotor":
            raise invalid_value(file, f"{key}.body", contact.body, "a link, because rotors spin inside transmissions")
        check_finite(file, f"{key}.position", contact.position)
        check_axis(file, f"{key}.axis", contact.axis)
    _check_capsules(robot, file)


def _check_capsules(robot: Robot, file: str) -> None:
    links = [body.name for body in robot.bodies if body.kind == "link"]
    for capsule in robot.capsules:
        key = f"capsules.{capsule.body}"
        if capsule.body not in links:
            raise unknown_name(file, key, capsule.body, links, "the name of a link")
        check_finite(file, key, (*capsule.start, *capsule.end))
    check_unique(file, "self_collisions", [" and ".join(sorted(pair)) for pair in robot.self_collisions])
    for pair in robot.self_collisions:
        for name in pair:
            if name not in links:
                raise unknown_name(file, "self_collisions", name, links, "the name of a link")
            if not capsules_of(robot, name):
                expected = "a link with a box, cylinder, sphere, or one of `capsules`"
                raise invalid_value(file, "self_collisions", name, expected)
        first, second = robot.body(pair[0]), robot.body(pair[1])
        if adjacent(first, second):
            raise invalid_value(file, "self_collisions", pair, "two links that are not parent and child")


def _check_pose_and_gains(robot: Robot, file: str) -> None:
    check_finite(file, "gravity", robot.gravity)
    _check_joint_values(robot, file, "pose.joints", robot.pose.joints)
    check_unique(file, "pose.balls", [name for name, _ in robot.pose.balls])
    for name, quaternion in robot.pose.balls:
        if name not in robot.balls:
            raise unknown_name(file, "pose.balls", name, robot.balls, "the name of a body on a ball joint")
        if len(quaternion) != 4 or not abs(math.hypot(*quaternion) - 1.0) <= UNIT_TOLERANCE:
            expected = f"a quaternion (w, x, y, z) of norm 1 within {UNIT_TOLERANCE:g}: divide it by its norm"
            raise invalid_value(file, f"pose.balls.{name}", quaternion, expected)
    _check_within_limits(robot, file)
    _check_assembly(robot, file)
    for key, pairs in (("gains.kp", robot.gains.kp), ("gains.kd", robot.gains.kd)):
        _check_joint_values(robot, file, key, pairs)
        for joint, gain in pairs:
            if not gain >= 0.0:
                raise invalid_value(file, f"{key}.{joint}", gain, "0 or more")
            if joint in robot.passive:
                raise invalid_value(file, f"{key}.{joint}", gain, "no gain for a passive joint (torque limit 0)")


def _check_within_limits(robot: Robot, file: str) -> None:
    pose, limits = dict(robot.pose.joints), {body.name: body.joint.position for body in robot.bodies}
    for joint in robot.independent:
        (lower, upper), angle = limits[joint], pose.get(joint, 0.0)
        if not lower - LIMIT_TOLERANCE <= angle <= upper + LIMIT_TOLERANCE:
            expected = f"a standing pose within the joint's limits, {lower:g} to {upper:g}"
            raise invalid_value(file, f"pose.joints.{joint}", angle, expected)


def _check_assembly(robot: Robot, file: str) -> None:
    dependent = [b.name for b in robot.bodies if b.joint.nv == 1 and b.name not in robot.independent]
    check_unique(file, "assembly", [joint for joint, _ in robot.assembly])
    for joint, value in robot.assembly:
        if joint not in dependent:
            raise unknown_name(file, "assembly", joint, dependent, "the name of a dependent joint")
        check_finite(file, f"assembly.{joint}", (value,))


def _check_joint_values(robot: Robot, file: str, key: str, pairs: tuple[tuple[str, float], ...]) -> None:
    check_unique(file, key, [joint for joint, _ in pairs])
    for joint, value in pairs:
        if joint not in robot.independent:
            raise unknown_name(file, key, joint, robot.independent, "the name of an independent joint")
        check_finite(file, f"{key}.{joint}", (value,))


@cache
def _warn_of_inertia(robot: str, bodies: tuple[str, ...]) -> None:
    """Warn once: the cache keeps the second call with the same arguments from running."""
    names = ", ".join(bodies)
    message = f"{robot}: the inertia of {names} violates the triangle inequality; it is used unchanged"
    warnings.warn(message, InertiaWarning, stacklevel=2)
