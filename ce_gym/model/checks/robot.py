"""Checks of complete robot descriptions, from files or from code.

Each check raises a `RobotError` of one line for the first thing that is wrong.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import fields
from fnmatch import fnmatchcase
from functools import cache

import numpy as np

from ce_gym.model.checks.body import (
    RELATIVE_TOLERANCE,
    check_body,
    check_finite,
    check_not_negative,
    moves_inertia,
    violates_triangle_inequality,
)
from ce_gym.model.checks.collisions import adjacent, capsules_of
from ce_gym.model.checks.constraint import check_constraint
from ce_gym.model.checks.supply import check_supply
from ce_gym.model.clusters import Cluster, cluster_tree
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.coordinates import UNIT_TOLERANCE
from ce_gym.model.description import Robot
from ce_gym.model.drives import DriveFriction
from ce_gym.model.errors import InertiaWarning, invalid_value, listed_names, unknown_name

MOST_BODIES = 500
"""Most bodies of a robot: what is done with them takes more than in proportion, and none has as many."""
LIMIT_TOLERANCE = 1e-6
"""How far a standing pose may be over a joint's limit, where both were rounded [rad or m]."""
LONGEST_NAME = 200
"""Most characters of a name."""


def check_robot(robot: Robot) -> None:
    """Check a whole robot.

    Raises:
        RobotError: Something cannot be.

    Warns:
        InertiaWarning: An inertia violates the triangle inequality, and the robot does not say that it is kept
            knowingly; said once per process and robot.
    """
    file = robot.source or robot.name
    _check_names(robot, file)
    _check_tree(robot, file)
    supported = {body.parent for body in robot.bodies} | _dependent(robot)
    for body in robot.bodies:
        check_body(body, file, may_be_massless=body.name in supported and body.joint.type != "free")
    _check_constraints(robot, file)
    _check_independent(robot, file)
    _check_something_moves(robot, file)
    _check_contacts(robot, file)
    _check_motors(robot, file)
    check_supply(robot, file)
    _check_elastic(robot, file)
    _check_pose_and_gains(robot, file)
    _check_inertia(robot, file)


def _check_names(robot: Robot, file: str) -> None:
    """Names can be printed, on one line: an escape sequence in a file moves nobody's cursor."""
    if len(robot.bodies) > MOST_BODIES:
        raise invalid_value(file, "number of bodies", len(robot.bodies), f"at most {MOST_BODIES}")
    names = {"name": [robot.name], "task": [name for name, _ in robot.tasks]}
    names |= {f"{kind} name": [body.name for body in robot.bodies if body.kind == kind] for kind in ("link", "rotor")}
    names["constraint name"] = [constraint.name for constraint in robot.constraints]
    names["contact name"] = [contact.name for contact in robot.contacts]
    names["contact group"] = [contact.group for contact in robot.contacts]
    for key, given in names.items():
        for name in given:
            if not name or not name.isprintable() or len(name) > LONGEST_NAME:
                raise invalid_value(file, key, name, f"1 to {LONGEST_NAME} characters that can be printed")


def _check_inertia(robot: Robot, file: str) -> None:
    """Warn of figures that no rigid body can have, unless they are kept knowingly."""
    impossible = [body.name for body in robot.bodies if violates_triangle_inequality(body)]
    _check_unique(file, "kept_inertia", robot.kept_inertia)
    for pattern in robot.kept_inertia:
        if not any(fnmatchcase(name, pattern) for name in impossible):
            expected = f"one of {listed_names(pattern, impossible)}" if impossible else "none: no inertia is impossible"
            raise invalid_value(file, "kept_inertia", pattern, expected)
    unknowing = [name for name in impossible if not any(fnmatchcase(name, pattern) for pattern in robot.kept_inertia)]
    if unknowing:
        _warn_of_inertia(robot.name, tuple(unknowing))


def _dependent(robot: Robot) -> set[str]:
    """Bodies that others move: such a body, or one that carries another, can be so light that its mass is left out."""
    tied = {name for constraint in robot.constraints for name in constraint.bodies}
    return tied - set(robot.independent)


def _check_tree(robot: Robot, file: str) -> None:
    """Names are unique, parents come first, and only the first body may be free."""
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
    _check_unique(file, "constraint name", [constraint.name for constraint in robot.constraints])
    for constraint in robot.constraints:
        check_constraint(constraint, robot, file)


def _check_independent(robot: Robot, file: str) -> None:
    names = [body.name for body in robot.bodies if body.joint.nv == 1]
    for joint in robot.independent:
        if joint not in names:
            expected = "the name of a body whose joint has one degree of freedom"
            raise unknown_name(file, "independent", joint, names, expected)
    _check_unique(file, "independent", robot.independent)
    for cluster in cluster_tree(robot).clusters:
        if cluster.linear and robot.body(cluster.bodies[0]).joint.nv == 1:
            _check_determined(cluster, file)  # others are solved to be checked: a Model does


def _check_determined(cluster: Cluster, file: str) -> None:
    """The constraints of a cluster must determine its dependent coordinates from the independent ones."""
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
    """The joint of a body that carries nothing and is tied to nothing must move some inertia."""
    tied = {name for constraint in robot.constraints for name in constraint.bodies}
    for body in robot.bodies:
        if body.name not in tied | {other.parent for other in robot.bodies} and not moves_inertia(body):
            expected = "a mass or an inertia that its joint moves"
            raise invalid_value(file, f"{body.kind} {body.name!r} inertia", body.inertial.inertia, expected)


def _check_contacts(robot: Robot, file: str) -> None:
    _check_unique(file, "contact name", [contact.name for contact in robot.contacts])
    names = [body.name for body in robot.bodies]
    for contact in robot.contacts:
        key = f"contacts.{contact.name}"
        if contact.body not in names:
            raise unknown_name(file, f"{key}.body", contact.body, names, "the name of a body")
        if robot.body(contact.body).kind == "rotor":
            raise invalid_value(file, f"{key}.body", contact.body, "a link, because rotors spin inside transmissions")
        check_finite(file, f"{key}.position", contact.position)
        check_not_negative(file, f"{key}.radius", contact.radius, " [m]")
        check_not_negative(file, f"{key}.rim", contact.rim, " [m]")
        if len(contact.axis) != 3 or not math.isclose(math.hypot(*contact.axis), 1.0, rel_tol=RELATIVE_TOLERANCE):
            raise invalid_value(file, f"{key}.axis", contact.axis, "a unit axis")
    _check_capsules(robot, file)
    for name in ("stiffness", "damping", "friction", "bristle", "dissipation"):
        value = getattr(robot.material, name)
        if value is not None:
            check_not_negative(file, f"material.{name}", value)
    if not 0.0 < robot.material.slip_speed < math.inf:
        raise invalid_value(file, "material.slip_speed", robot.material.slip_speed, "more than 0 [m/s]")


def _check_capsules(robot: Robot, file: str) -> None:
    links = [body.name for body in robot.bodies if body.kind == "link"]
    for capsule in robot.capsules:
        key = f"capsules.{capsule.body}"
        if capsule.body not in links:
            raise unknown_name(file, key, capsule.body, links, "the name of a link")
        check_finite(file, key, (*capsule.start, *capsule.end))
        if not 0.0 < capsule.radius < math.inf:
            raise invalid_value(file, f"{key} radius", capsule.radius, "more than 0 [m]")
    _check_unique(file, "self_collisions", [" and ".join(sorted(pair)) for pair in robot.self_collisions])
    for pair in robot.self_collisions:
        for name in pair:
            if name not in links:
                raise unknown_name(file, "self_collisions", name, links, "the name of a link")
            if not capsules_of(robot, name):
                expected = "a link with a box, cylinder, sphere, or one of `capsules`"
                raise invalid_value(file, "self_collisions", name, expected)
        one, other = robot.body(pair[0]), robot.body(pair[1])
        if adjacent(one, other):
            raise invalid_value(file, "self_collisions", pair, "two links of which none carries the other")


def _check_motors(robot: Robot, file: str) -> None:
    rotors = [body.name for body in robot.rotors()]
    _check_unique(file, "motors", [motor.rotor for motor in robot.motors])
    for motor in robot.motors:
        if motor.rotor not in rotors:
            raise unknown_name(file, "motors", motor.rotor, rotors, "the name of a rotor")
        for name in ("torque", "velocity", "stall", "damping", "friction"):
            value = getattr(motor, name)
            if name in ("damping", "friction"):
                check_not_negative(file, f"motors.{motor.rotor}.{name}", value)
            elif value is not None and not value >= 0.0:
                raise invalid_value(file, f"motors.{motor.rotor}.{name}", value, "0 or more")
        if motor.velocity == 0.0:
            raise invalid_value(file, f"motors.{motor.rotor}.velocity", 0.0, "more than 0 [rad/s]")
        if not motor.bandwidth > 0.0:
            raise invalid_value(file, f"motors.{motor.rotor}.bandwidth", motor.bandwidth, "more than 0 [Hz]")
        if motor.drive_friction is not None:
            _check_drive_friction(motor.drive_friction, file, f"motors.{motor.rotor}.friction")


def _check_drive_friction(friction: DriveFriction, file: str, key: str) -> None:
    for field in fields(friction):
        value, name = getattr(friction, field.name), f"{key}.{field.name}"
        if field.name.endswith("efficiency"):
            if not 0.0 <= value <= 1.0 or (field.name == "efficiency" and value == 0.0):
                raise invalid_value(file, name, value, "a share of at most 1")
        elif field.name in ("stribeck_speed", "stribeck_exponent"):
            if not value > 0.0:
                raise invalid_value(file, name, value, "more than 0")
        else:
            check_not_negative(file, name, value)
    at_rest = [f.name for f in fields(friction) if f.name.startswith("stribeck") and f.default == 0.0]
    if math.isinf(friction.stribeck_speed) and any(getattr(friction, name) for name in at_rest):
        expected = "the speed at which what is added at rest falls [rad/s]"
        raise invalid_value(file, f"{key}.stribeck_speed", None, expected)


def _check_elastic(robot: Robot, file: str) -> None:
    """An elastic transmission is one linear tie, in which the rotor follows from joints and nothing from the rotor."""
    rotors = [body.name for body in robot.rotors()]
    _check_unique(file, "elastic", [elastic.rotor for elastic in robot.elastic])
    for elastic in robot.elastic:
        key = f"elastic.{elastic.rotor}"
        if elastic.rotor not in rotors:
            raise unknown_name(file, "elastic", elastic.rotor, rotors, "the name of a rotor")
        ties = [tie for tie in robot.constraints if elastic.rotor in tie.bodies]
        if len(ties) != 1 or not ties[0].linear or elastic.rotor in robot.independent:
            raise invalid_value(
                file, key, elastic.rotor, "a rotor that follows from joints by one linear tie, and nothing from it"
            )
        if elastic.stretch in (body.name for body in robot.bodies):
            raise invalid_value(file, "body name", elastic.stretch, f"another one: {elastic.rotor!r} is elastic")
        if not 0.0 < elastic.stiffness < math.inf:
            raise invalid_value(file, f"{key}.stiffness", elastic.stiffness, "more than 0 [N m/rad]")
        check_not_negative(file, f"{key}.damping", elastic.damping, " [N m s/rad]")
        check_not_negative(file, f"{key}.backlash", elastic.backlash, " [rad]")
        if not elastic.preload > 0.0:
            raise invalid_value(file, f"{key}.preload", elastic.preload, "more than 0 [N m]")
        if elastic.backlash and math.isfinite(elastic.preload):
            raise invalid_value(file, f"{key}.preload", elastic.preload, "none where there is backlash")


def _check_pose_and_gains(robot: Robot, file: str) -> None:
    check_finite(file, "pose.height", (robot.pose.height,))
    check_finite(file, "gravity", robot.gravity)
    _check_joint_values(robot, file, "pose.joints", robot.pose.joints)
    _check_unique(file, "pose.balls", [name for name, _ in robot.pose.balls])
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
            check_not_negative(file, f"{key}.{joint}", gain)
            if joint in robot.passive:
                raise invalid_value(file, f"{key}.{joint}", gain, "none for a passive joint, whose largest torque is 0")
        for joint in robot.driven:
            if pairs and joint not in dict(pairs):
                raise invalid_value(file, f"{key}.{joint}", None, "a gain for every independent joint or for none")


def _check_within_limits(robot: Robot, file: str) -> None:
    pose, limits = dict(robot.pose.joints), {body.name: body.joint.position for body in robot.bodies}
    for joint in robot.independent:
        (lower, upper), angle = limits[joint], pose.get(joint, 0.0)
        if not lower - LIMIT_TOLERANCE <= angle <= upper + LIMIT_TOLERANCE:
            expected = f"a standing pose within the joint's limits, {lower:g} to {upper:g}"
            raise invalid_value(file, f"pose.joints.{joint}", angle, expected)


def _check_assembly(robot: Robot, file: str) -> None:
    dependent = [b.name for b in robot.bodies if b.joint.nv == 1 and b.name not in robot.independent]
    _check_unique(file, "assembly", [joint for joint, _ in robot.assembly])
    for joint, value in robot.assembly:
        if joint not in dependent:
            raise unknown_name(file, "assembly", joint, dependent, "the name of a dependent joint")
        check_finite(file, f"assembly.{joint}", (value,))


def _check_joint_values(robot: Robot, file: str, key: str, pairs: tuple[tuple[str, float], ...]) -> None:
    _check_unique(file, key, [joint for joint, _ in pairs])
    for joint, value in pairs:
        if joint not in robot.independent:
            raise unknown_name(file, key, joint, robot.independent, "the name of an independent joint")
        check_finite(file, f"{key}.{joint}", (value,))


def _check_unique(file: str, key: str, names: Iterable[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise invalid_value(file, key, name, "a name that is used once")
        seen.add(name)


@cache
def _warn_of_inertia(robot: str, bodies: tuple[str, ...]) -> None:
    """Warn once: the cache keeps the second call with the same arguments from running."""
    names = ", ".join(bodies)
    message = f"{robot}: the inertia of {names} violates the triangle inequality; it is kept as it is"
    warnings.warn(message, InertiaWarning, stacklevel=2)
