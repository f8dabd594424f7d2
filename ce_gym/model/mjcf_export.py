"""A robot as MJCF text, so that MuJoCo simulates the same machine at the same transmission level.

Knows descriptions, mechanisms and the MJCF schema (https://mujoco.readthedocs.io/en/stable/XMLreference.html); needs
no MuJoCo. What MJCF cannot say is said in `to_mjcf`.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.description import LinearConstraint, Robot, Shape
from ce_gym.model.errors import RobotError
from ce_gym.model.mechanism import Mechanism, MovingBody, build_mechanism

Array = NDArray[np.float64]

SMALLEST_MASS = 1e-12
"""Mass given to a massless rotor [kg]; MuJoCo refuses moving bodies without mass."""

SMALLEST_RADIUS = 1e-6
"""Radius given to a contact point [m]; MuJoCo refuses spheres without extent."""

NO_LIMIT = 1e6
"""Stands for the missing end of a one-sided joint range [rad or m]."""


@dataclass(frozen=True)
class Tie:
    """A joint coordinate as a linear function of the independent ones, `q = sum(ratio * y) + offset`.

    Attributes:
        ratios: Ratio for each independent joint that matters, by name.
        offset: Value when all of those are zero [rad or m].
    """

    ratios: dict[str, float]
    offset: float = 0.0


def to_mjcf(
    robot: Robot,
    transmission: str = "exact",
    *,
    timestep: float = 0.005,
    integrator: str = "implicitfast",
    ground: bool = True,
    solref: Sequence[float] | None = None,
    solimp: Sequence[float] | None = None,
) -> str:
    """Write a robot as MJCF.

    | level      | in MJCF                                                                                     |
    |------------|---------------------------------------------------------------------------------------------|
    | `exact`    | every rotor is a body with a hinge; gears are joint equalities, belts and differentials are |
    |            | fixed tendons with a tendon equality (soft constraints: MuJoCo has no exact ones)           |
    | `coupled`  | no rotor bodies; joint armature for gears, tendon armature for what spans several joints    |
    | `armature` | no rotor bodies; the diagonal of the reflected inertia as joint armature                    |
    | `none`     | no rotor bodies, no armature                                                                |

    A joint is called after the body it moves, and so are its actuator (position control with the robot's gains and
    torque limits) and its tendon. The keyframe "stand" is the standing pose. Only contact spheres collide, only with
    the ground. Limits of a motor's speed have no counterpart and are left out.

    MuJoCo's contacts are stated by time constant and impedance relative to an effective mass, not by stiffness and
    damping: of the robot's material only friction is exported, the rest is MuJoCo's default.

    MuJoCo refuses inertias that violate the triangle inequality, and its own `balanceinertia` would replace all three
    moments by their mean. Such an inertia is written with its two smaller principal moments raised equally until the
    inequality holds; `ce_gym.bench.mujoco_peer.load` puts the published inertia back after compilation.

    Args:
        robot: The robot.
        transmission: "exact", "coupled", "armature" or "none".
        timestep: MuJoCo's step [s].
        integrator: "Euler", "implicitfast", "implicit" or "RK4".
        ground: Whether to add the plane z = 0.
        solref: Reference of the transmission's equality constraints (time constant [s], damping ratio); None is
            MuJoCo's default, with which gears slip visibly.
        solimp: Impedance of the equality constraints; None is MuJoCo's default.

    Raises:
        RobotError: If the level does not exist or the independent joints do not determine the others.
    """
    mechanism = build_mechanism(robot, transmission, eliminate=False)
    ties = joint_ties(robot)
    root = ET.Element("mujoco", model=f"{robot.name}_{transmission}")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(root, "option", timestep=_text(timestep), integrator=integrator, gravity=_text(robot.gravity))
    _add_world(root, mechanism, _joint_armature(mechanism, ties), ground)
    _add_ties(root, mechanism, ties, solref, solimp)
    _add_actuators(root, robot)
    _add_standing_pose(root, mechanism, ties)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode")


def joint_ties(robot: Robot) -> dict[str, Tie]:
    """Return every joint coordinate as a function of the independent ones, by joint name.

    Raises:
        RobotError: If the independent joints do not determine the others, or a constraint is not linear.
    """
    linear = [constraint for constraint in robot.constraints if isinstance(constraint, LinearConstraint)]
    for constraint in robot.constraints:
        if constraint not in linear:
            raise RobotError(f"{robot.name}: constraint {constraint.name!r}: expected a linear one for MJCF")
    names = [body.name for body in robot.bodies if body.joint.type != "free"]
    dependent = [name for name in names if name not in robot.independent]
    rows = [dict(constraint.coefficients) for constraint in linear]
    to_dependent = np.array([[row.get(name, 0.0) for name in dependent] for row in rows]).reshape(len(rows), -1)
    to_independent = np.array([[row.get(name, 0.0) for name in robot.independent] for row in rows])
    offset = np.array([constraint.offset for constraint in linear])
    ties = {name: Tie({name: 1.0}) for name in robot.independent}
    if dependent:
        if to_dependent.shape[0] != len(dependent) or np.linalg.matrix_rank(to_dependent) < len(dependent):
            raise RobotError(f"{robot.name}: the independent joints do not determine {', '.join(dependent)}")
        solution = np.linalg.solve(to_dependent, np.column_stack([offset, -to_independent]))
        for name, row in zip(dependent, solution, strict=True):
            ratios = {y: float(x) for y, x in zip(robot.independent, row[1:], strict=True) if x != 0.0}
            ties[name] = Tie(ratios, float(row[0]))
    return {name: ties[name] for name in names}


def _joint_armature(mechanism: Mechanism, ties: dict[str, Tie]) -> dict[str, float]:
    """Diagonal of the reflected inertia [kg m^2], by joint; at "coupled" only of rotors driven by a single joint."""
    armature: dict[str, float] = {}
    for spin in (spin for cluster in mechanism.spins for spin in cluster):
        ratios = ties[spin.rotor].ratios
        if mechanism.level == "armature" or (mechanism.level == "coupled" and len(ratios) == 1):
            for joint, ratio in ratios.items():
                armature[joint] = armature.get(joint, 0.0) + spin.inertia * ratio**2
    return armature


def _add_world(root: ET.Element, mechanism: Mechanism, armature: dict[str, float], ground: bool) -> None:
    robot = mechanism.robot
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 0 4", directional="true")
    if ground:
        friction = _text((robot.material.friction, 0.005, 0.0001))
        plane = {"name": "ground", "type": "plane", "size": "0 0 1", "rgba": "0.85 0.85 0.85 1"}
        ET.SubElement(world, "geom", plane, friction=friction, contype="0", conaffinity="1")
    elements: dict[str | None, ET.Element] = {None: world}
    for moving in mechanism.bodies.values():
        elements[moving.name] = _add_body(elements[moving.parent], moving, robot, armature.get(moving.name, 0.0))


def _add_body(parent: ET.Element, moving: MovingBody, robot: Robot, armature: float) -> ET.Element:
    body = robot.body(moving.name)
    pose = {"pos": _text(moving.position), "quat": _text(quaternion(moving.rotation))}
    element = ET.SubElement(parent, "body", {"name": body.name, **pose})
    if moving.joint_type == "free":
        ET.SubElement(element, "freejoint", name=body.name)
    else:
        kind = {"revolute": "hinge", "prismatic": "slide"}[moving.joint_type]
        joint = ET.SubElement(element, "joint", name=body.name, type=kind, axis=_text(moving.axis))
        if math.isfinite(body.joint.position[0]) or math.isfinite(body.joint.position[1]):
            joint.set("range", _text(np.clip(body.joint.position, -NO_LIMIT, NO_LIMIT)))
        for key, value in (("damping", body.joint.damping), ("armature", armature)):
            if value:
                joint.set(key, _text(value))
    _add_inertial(element, moving.inertia)
    for shape in body.shapes:
        _add_shape(element, shape)
    for contact in robot.contacts:
        if contact.body == body.name:
            sphere = {"type": "sphere", "size": _text(max(contact.radius, SMALLEST_RADIUS))}
            collides = {"friction": _text((robot.material.friction, 0.005, 0.0001)), "contype": "1", "conaffinity": "0"}
            place = {"name": contact.name, "pos": _text(contact.position)}
            ET.SubElement(element, "geom", {**place, **sphere, **collides, "rgba": "0.2 0.2 0.2 0.5"})
    return element


def _add_inertial(element: ET.Element, spatial: Array) -> None:
    mass, com, inertia = mass_properties(spatial)
    ixx, iyy, izz, ixy, ixz, iyz = valid_inertia(inertia)[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
    full = _text((ixx, iyy, izz, ixy, ixz, iyz))
    ET.SubElement(element, "inertial", pos=_text(com), mass=_text(max(mass, SMALLEST_MASS)), fullinertia=full)


def mass_properties(spatial: Array) -> tuple[float, Array, Array]:
    """Return mass [kg], centre of mass [m] and inertia about it [kg m^2] of a spatial inertia, shape (6, 6)."""
    mass = float(spatial[5, 5])
    moment = spatial[:3, 3:]
    com = np.array([moment[2, 1], moment[0, 2], moment[1, 0]]) / mass if mass > 0.0 else np.zeros(3)
    inertia = spatial[:3, :3] - mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, 0.5 * (inertia + inertia.T)


def valid_inertia(inertia: Array) -> Array:
    """Return the inertia [kg m^2] with its smaller principal moments raised until the triangle inequality holds."""
    moments, axes = np.linalg.eigh(inertia)
    lacking = moments[2] - moments[0] - moments[1]
    if lacking <= 0.0:
        return inertia
    margin = 1e-9 * moments[2]  # MuJoCo checks without a tolerance, after a diagonalisation of its own
    return inertia + 0.5 * (lacking + margin) * (np.eye(3) - np.outer(axes[:, 2], axes[:, 2]))


def _add_shape(element: ET.Element, shape: Shape) -> None:
    sizes = {
        "box": tuple(0.5 * x for x in shape.size),
        "sphere": shape.size,
        "cylinder": (shape.size[0], 0.5 * shape.size[-1]),
        "capsule": (shape.size[0], 0.5 * shape.size[-1]),
    }
    look = {"rgba": _text(shape.color), "group": "2", "contype": "0", "conaffinity": "0"}
    quat = _text(quaternion(np.array(shape.placement.rotation)))
    place = {"pos": _text(shape.placement.position), "quat": quat}
    ET.SubElement(element, "geom", {"type": shape.type, "size": _text(sizes[shape.type]), **place, **look})


def _add_ties(
    root: ET.Element,
    mechanism: Mechanism,
    ties: dict[str, Tie],
    solref: Sequence[float] | None,
    solimp: Sequence[float] | None,
) -> None:
    """Tie dependent joints to independent ones, and add the armature of rotors that several joints drive."""
    stiffness = {k: _text(v) for k, v in (("solref", solref), ("solimp", solimp)) if v is not None}
    tendons, equalities = ET.Element("tendon"), ET.Element("equality")
    for name in mechanism.bodies:
        if name not in ties or name in mechanism.robot.independent:
            continue
        tie = ties[name]
        if len(tie.ratios) == 1:
            ((independent, ratio),) = tie.ratios.items()
            pair = {"joint1": name, "joint2": independent, "polycoef": _text((tie.offset, ratio, 0, 0, 0))}
            ET.SubElement(equalities, "joint", {**pair, **stiffness})
        else:
            _add_tendon(tendons, name, {name: 1.0, **{y: -ratio for y, ratio in tie.ratios.items()}})
            constant = {"tendon1": name, "polycoef": _text((tie.offset, 0, 0, 0, 0))}
            ET.SubElement(equalities, "tendon", {**constant, **stiffness})
    if mechanism.level == "coupled":
        for spin in (spin for cluster in mechanism.spins for spin in cluster):
            if len(ties[spin.rotor].ratios) > 1:
                tendon = _add_tendon(tendons, spin.rotor, ties[spin.rotor].ratios)
                tendon.set("armature", _text(spin.inertia))
    root.extend(element for element in (tendons, equalities) if len(element))


def _add_tendon(tendons: ET.Element, name: str, ratios: dict[str, float]) -> ET.Element:
    tendon = ET.SubElement(tendons, "fixed", name=name)
    for joint, ratio in ratios.items():
        ET.SubElement(tendon, "joint", joint=joint, coef=_text(ratio))
    return tendon


def _add_actuators(root: ET.Element, robot: Robot) -> None:
    kp, kd = dict(robot.gains.kp), dict(robot.gains.kd)
    actuators = ET.SubElement(root, "actuator")
    for name in robot.independent:
        gains = {"kp": _text(kp.get(name, 0.0)), "kv": _text(kd.get(name, 0.0))}
        actuator = ET.SubElement(actuators, "position", {"name": name, "joint": name, **gains})
        torque = robot.body(name).joint.torque
        if math.isfinite(torque):
            actuator.set("forcerange", _text((-torque, torque)))


def _add_standing_pose(root: ET.Element, mechanism: Mechanism, ties: dict[str, Tie]) -> None:
    """Write the standing pose as a keyframe; MuJoCo orders coordinates depth first."""
    robot = mechanism.robot
    y = {**dict.fromkeys(robot.independent, 0.0), **dict(robot.pose.joints)}
    qpos: list[float] = []
    for element in root.iter("body"):
        name = element.get("name", "")
        if mechanism.bodies[name].joint_type == "free":
            qpos += [0.0, 0.0, robot.pose.height, 1.0, 0.0, 0.0, 0.0]
        else:
            qpos.append(ties[name].offset + sum(ratio * y[joint] for joint, ratio in ties[name].ratios.items()))
    key = ET.SubElement(ET.SubElement(root, "keyframe"), "key", name="stand", qpos=_text(qpos))
    key.set("ctrl", _text([y[name] for name in robot.independent]))


def quaternion(rotation: Array) -> Array:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix, shape (4,), with w >= 0.

    It is the eigenvector of the largest eigenvalue of Bar-Itzhack's symmetric matrix (2000), sound at every angle.
    """
    r = rotation
    upper = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], 0.0, 0.0, 0.0],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], 0.0, 0.0],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0.0],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    largest = np.linalg.eigh(upper)[1][:, -1]
    return largest if largest[0] >= 0.0 else -largest


def _text(x: float | Iterable[float]) -> str:
    """Numbers as text that reads back to the same bits."""
    return " ".join(repr(float(value)) for value in np.atleast_1d(np.asarray(x, dtype=np.float64)))
