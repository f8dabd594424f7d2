"""A robot as MJCF text, so that MuJoCo simulates the same machine at the same transmission level.

What MJCF cannot say is said in `to_mjcf`. Source: https://mujoco.readthedocs.io/en/stable/XMLreference.html.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.standing import standing_pose, turned
from ce_gym.export.joint_ties import joint_ties
from ce_gym.export.mjcf_equalities import MJCF_JOINTS, add_ties, check_expressible, held_rotors, joint_armature
from ce_gym.export.mjcf_mechanism import SMALLEST_INERTIA, largest_ratio, mjcf_mechanism
from ce_gym.export.mjcf_text import quaternion, text
from ce_gym.model.description import ContactSphere, Robot, Shape
from ce_gym.model.errors import invalid_value
from ce_gym.model.mechanism import ELASTIC, MovingBody

Array = NDArray[np.float64]

SMALLEST_MASS = 1e-12
"""Mass given to a massless body [kg]; MuJoCo refuses moving bodies without mass."""

SMALLEST_RADIUS = 1e-6
"""Radius given to a contact point [m]; MuJoCo refuses spheres without extent."""

NO_LIMIT = 1e6
"""Stands for the missing end of a one-sided joint range [rad or m]."""


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

    - `exact`: every rotor is a body with a hinge; gears are joint equalities, belts and differentials are fixed tendons
      with a tendon equality (soft constraints: MuJoCo has no exact ones). Rotors too light for a body of MuJoCo's,
      such as those that stand for an armature of unknown ratio, are written as at `coupled`, see mjcf_mechanism.py.
    - `coupled`: no rotors; joint armature for gears, tendon armature for what spans several joints of a chain; for
      other chains a massless body with armature, tied by a tendon.
    - `armature`: no rotor bodies; the diagonal of the reflected inertia as joint armature.
    - `none`: no rotor bodies, no armature.

    Loops are closed by connects and rods by spatial tendons at every level, see mjcf_equalities.py. So armature of
    a joint inside a loop is reflected to the independent ones as the pose demands, velocity terms included: `coupled`
    is exact there too. At `armature` a diagonal that varies with the pose would be needed, which MJCF does not have.

    A joint is called after the body it moves, and so are its actuator (position control with the robot's gains and
    torque limits) and its tendon. The keyframe "stand" is the standing pose; joints of clusters with loops have it as
    their `ref` too, so that the file is drawn, and starts, assembled. Coordinates are the robot's own either way. Only
    contact spheres collide, only with the ground. Limits of a motor's speed have no counterpart and are left out.

    MuJoCo makes an equality as stiff as the lightest thing it holds: a massless link between rotors that are bodies and
    a loop gives way. Simulate such robots at `coupled`.

    MuJoCo's contacts are stated by time constant and impedance relative to an effective mass, not by stiffness and
    damping: of the robot's material only friction is exported, the rest is MuJoCo's default.

    MuJoCo refuses inertias that violate the triangle inequality, and its own `balanceinertia` would replace all three
    moments by their mean. Such an inertia is written with its two smaller principal moments raised equally until the
    inequality holds; `ce_gym.export.mujoco_model.load` puts the published inertia back after compilation.

    Args:
        robot: The robot.
        transmission: "exact", "coupled", "armature" or "none".
        timestep: MuJoCo's step [s].
        integrator: "Euler", "implicitfast", "implicit" or "RK4".
        ground: Whether to add the plane z = 0.
        solref: Reference of the equality constraints, gears and loops alike (time constant [s], damping ratio); None
            is MuJoCo's default, with which they give way visibly.
        solimp: Impedance of the equality constraints; None is MuJoCo's default.

    Raises:
        RobotError: If the level does not exist, the independent joints do not determine the others, loops do not close
            at the standing pose, or MJCF has no way to say something: a constraint that is a function, a rotor that is
            left out but independent or part of a loop, or the varying diagonal of `armature`.
    """
    if transmission == ELASTIC:
        expected = "another level: MJCF has no such drives"
        raise invalid_value(robot.source or robot.name, "transmission", transmission, expected)
    mechanism = mjcf_mechanism(robot, transmission)
    ties = joint_ties(mechanism)
    check_expressible(mechanism, ties)
    held = held_rotors(mechanism, ties)
    standing = dict(standing_pose(mechanism).q)
    standing |= {name: standing[name] / largest_ratio(ties[name]) for name in held}
    in_loops = [name for cluster in mechanism.tree.clusters if not cluster.linear for name in cluster.bodies]
    reference = {name: standing[name] for name in in_loops}
    solver = {key: text(value) for key, value in (("solref", solref), ("solimp", solimp)) if value is not None}
    root = ET.Element("mujoco", model=f"{robot.name}_{transmission}")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(root, "option", timestep=text(timestep), integrator=integrator, gravity=text(robot.gravity))
    elements: dict[str | None, ET.Element] = {None: _add_world(root, robot, ground)}
    armature = joint_armature(mechanism, ties)
    for moving in (*mechanism.bodies.values(), *(moving for moving, _ in held.values())):
        elements[moving.name] = _add_body(elements[moving.parent], moving, robot, reference, armature)
    add_ties(root, elements, mechanism, ties, reference, solver)
    _add_actuators(root, robot)
    _add_standing_pose(root, robot, standing)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode")


def _add_world(root: ET.Element, robot: Robot, ground: bool) -> ET.Element:
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 0 4", directional="true")
    if ground:
        friction = text((robot.material.friction, 0.005, 0.0001))
        plane = {"name": "ground", "type": "plane", "size": "0 0 1", "rgba": "0.85 0.85 0.85 1"}
        ET.SubElement(world, "geom", plane, friction=friction, contype="0", conaffinity="1")
    return world


def _add_body(
    parent: ET.Element,
    moving: MovingBody,
    robot: Robot,
    reference: Mapping[str, float],
    armature: Mapping[str, float],
) -> ET.Element:
    """Add a body where it is when its joint is at `ref`."""
    body, ref = robot.body(moving.name), reference.get(moving.name, 0.0)
    position, rotation = moving.position, moving.rotation
    if ref:
        position = position + rotation @ moving.axis * (moving.joint.slide * ref)
        rotation = rotation @ turned(moving.axis, moving.joint.turn * ref)
    pose = {"pos": text(position), "quat": text(quaternion(rotation))}
    element = ET.SubElement(parent, "body", {"name": body.name, **pose})
    if moving.joint.type == "free":
        ET.SubElement(element, "freejoint", name=body.name)
    else:
        joint = ET.SubElement(element, "joint", name=body.name, type=MJCF_JOINTS[body.joint.type])
        lower, upper = body.joint.position
        if body.joint.type == "ball":
            lower = 0.0 if math.isfinite(upper) else lower
        else:
            joint.set("axis", text(moving.axis))
        if math.isfinite(lower) or math.isfinite(upper):
            joint.set("range", text(np.clip((lower, upper), -NO_LIMIT, NO_LIMIT)))
        for key, value in (
            ("ref", ref),
            ("damping", body.joint.damping),
            ("frictionloss", body.joint.friction),
            ("stiffness", body.joint.stiffness),
            ("springref", body.joint.springref),
            ("armature", armature.get(moving.name, 0.0)),
        ):
            if value:
                joint.set(key, text(value))
    _add_inertial(element, moving.inertia)
    for shape in body.shapes:
        _add_shape(element, shape)
    for contact in robot.contacts:
        if contact.body == body.name:
            collides = {"friction": text((robot.material.friction, 0.005, 0.0001)), "contype": "1", "conaffinity": "0"}
            place = {"name": contact.name, "pos": text(contact.position)}
            ET.SubElement(element, "geom", {**place, **_solid(contact), **collides, "rgba": "0.2 0.2 0.2 0.5"})
    return element


def _solid(contact: ContactSphere) -> dict[str, str]:
    """Return what a contact is: a sphere, or a disc as thick as the sphere that moves around its rim."""
    radius = max(contact.radius, SMALLEST_RADIUS)
    if not contact.rim:
        return {"type": "sphere", "size": text(radius)}
    return {"type": "cylinder", "size": text((contact.rim + contact.radius, radius)), "zaxis": text(contact.axis)}


def _add_inertial(element: ET.Element, spatial: Array) -> None:
    mass, com, inertia = mass_properties(spatial)
    ixx, iyy, izz, ixy, ixz, iyz = valid_inertia(inertia)[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
    full = text((ixx, iyy, izz, ixy, ixz, iyz))
    ET.SubElement(element, "inertial", pos=text(com), mass=text(max(mass, SMALLEST_MASS)), fullinertia=full)


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
    if moments[0] < SMALLEST_INERTIA:
        moments = np.maximum(moments, SMALLEST_INERTIA)
        inertia = (axes * moments) @ axes.T
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
    look = {"rgba": text(shape.color), "group": "2", "contype": "0", "conaffinity": "0"}
    quat = text(quaternion(np.array(shape.placement.rotation)))
    place = {"pos": text(shape.placement.position), "quat": quat}
    ET.SubElement(element, "geom", {"type": shape.type, "size": text(sizes[shape.type]), **place, **look})


def _add_actuators(root: ET.Element, robot: Robot) -> None:
    kp, kd = dict(robot.gains.kp), dict(robot.gains.kd)
    actuators = ET.SubElement(root, "actuator")
    for name in robot.driven:
        gains = {"kp": text(kp.get(name, 0.0)), "kv": text(kd.get(name, 0.0))}
        actuator = ET.SubElement(actuators, "position", {"name": name, "joint": name, **gains})
        torque = robot.body(name).joint.torque
        if math.isfinite(torque):
            actuator.set("forcerange", text((-torque, torque)))


def _add_standing_pose(root: ET.Element, robot: Robot, standing: Mapping[str, float]) -> None:
    """Write the standing pose as a keyframe; MuJoCo orders coordinates depth first."""
    qpos: list[float] = []
    turned = {name: robot.standing_q[rows.start : rows.stop] for name, (rows, _) in robot.rows.items()}
    for element in root.iter("body"):
        name = element.get("name", "")
        if robot.body(name).joint.nv > 1:
            qpos += turned[name]
        else:
            qpos.append(standing[name])
    key = ET.SubElement(ET.SubElement(root, "keyframe"), "key", name="stand", qpos=text(qpos))
    key.set("ctrl", text([standing[name] for name in robot.driven]))
