"""A robot as MJCF text for MuJoCo, at a transmission level.

Source: https://mujoco.readthedocs.io/en/stable/XMLreference.html.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.standing import standing_pose, turned
from ce_gym.export.joint_ties import joint_ties
from ce_gym.export.mjcf_equalities import MJCF_JOINTS, add_ties, check_expressible, joint_armature, massless_rotors
from ce_gym.export.mjcf_mechanism import SMALLEST_INERTIA, largest_ratio, mjcf_mechanism
from ce_gym.export.mjcf_text import quaternion, text
from ce_gym.model.description import ContactSphere, Robot, Shape
from ce_gym.model.errors import invalid_value
from ce_gym.model.mechanism import ELASTIC, MovingBody

Array = NDArray[np.float64]

SMALLEST_MASS = 1e-12
"""Mass of a massless body [kg]; MuJoCo refuses moving bodies without mass."""

SMALLEST_RADIUS = 1e-6
"""Radius of a contact point [m]; MuJoCo refuses spheres without extent."""

NO_LIMIT = 1e6
"""Replaces the missing end of a one-sided joint range [rad or m]."""


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
    """Return a robot as MJCF.

    - `exact`: rotors are bodies with hinges. Gears are joint equalities, belts and differentials are fixed tendons
      with tendon equalities. Very light rotors are written as at `coupled`.
    - `coupled`: rotors are armature of joints and tendons, see mjcf_equalities.py.
    - `armature`: rotors are joint armature, the diagonal of the reflected inertia.
    - `none`: no rotors, no armature.

    Loops are closed by connects and rods by spatial tendons at every level. All of MuJoCo's equalities are soft, and as
    stiff as the lightest body that they hold. Use `coupled` for robots with a massless link between rotors and a loop.

    Joints and their position actuators have the names of the joints, see `Robot.joint_name`. Tendons have the names of
    the moved bodies. Frames of the robot are sites, but for frames of omitted rotors. The keyframe "stand" is the
    standing pose, and joints of clusters with loops have it as `ref`. Contact spheres collide with the ground only.

    MJCF has no counterpart of these data:

    - Motor speed limits are omitted.
    - Contact stiffness and damping are MuJoCo's default, as MuJoCo uses a time constant and an impedance instead. Only
      the friction coefficient is exported.
    - MuJoCo refuses inertias that violate the triangle inequality. The two smaller principal moments of such an
      inertia are raised equally; `ce_gym.export.mujoco_model.load` restores the published inertia after compilation.

    Args:
        robot: The robot.
        transmission: "exact", "coupled", "armature" or "none".
        timestep: MuJoCo's step [s].
        integrator: "Euler", "implicitfast", "implicit" or "RK4".
        ground: Whether to add the plane z = 0.
        solref: Time constant [s] and damping ratio of all equalities; MuJoCo's default is visibly soft.
        solimp: Impedance of all equalities; MuJoCo's default if omitted.

    Raises:
        RobotError: If the level does not exist, the independent joints do not determine the others, or loops do not
            close at the standing pose. MJCF has no function constraints, no omitted rotors that are independent joints
            or ends of loops, and no armature that varies with the pose.
    """
    if transmission == ELASTIC:
        expected = "another level: MJCF has no such drives"
        raise invalid_value(robot.source or robot.name, "transmission", transmission, expected)
    mechanism = mjcf_mechanism(robot, transmission)
    ties = joint_ties(mechanism)
    check_expressible(mechanism, ties)
    massless = massless_rotors(mechanism, ties)
    standing = dict(standing_pose(mechanism).q)
    standing |= {name: standing[name] / largest_ratio(ties[name]) for name in massless}
    in_loops = [name for cluster in mechanism.tree.clusters if not cluster.linear for name in cluster.bodies]
    reference = {name: standing[name] for name in in_loops}
    solver = {key: text(value) for key, value in (("solref", solref), ("solimp", solimp)) if value is not None}
    root = ET.Element("mujoco", model=f"{robot.name}_{transmission}")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(root, "option", timestep=text(timestep), integrator=integrator, gravity=text(robot.gravity))
    elements: dict[str | None, ET.Element] = {None: _add_world(root, robot, ground)}
    armature = joint_armature(mechanism, ties)
    for moving in (*mechanism.bodies.values(), *(moving for moving, _ in massless.values())):
        elements[moving.name] = _add_body(elements[moving.parent], moving, robot, reference, armature)
    add_ties(root, elements, mechanism, ties, reference, solver)
    _add_frames(root, elements, robot)
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
    parent: ET.Element, moving: MovingBody, robot: Robot, reference: Mapping[str, float], armature: Mapping[str, float]
) -> ET.Element:
    """Add a body in its pose at joint position `ref`."""
    body, ref = robot.body(moving.name), reference.get(moving.name, 0.0)
    position, rotation = moving.position, moving.rotation
    if ref:
        position = position + rotation @ moving.axis * (moving.joint.slide * ref)
        rotation = rotation @ turned(moving.axis, moving.joint.turn * ref)
    pose = {"pos": text(position), "quat": text(quaternion(rotation))}
    element = ET.SubElement(parent, "body", {"name": body.name, **pose})
    if moving.joint.type == "free":
        ET.SubElement(element, "freejoint", name=robot.joint_name(body.name))
    else:
        joint = ET.SubElement(element, "joint", name=robot.joint_name(body.name), type=MJCF_JOINTS[body.joint.type])
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
    """Return the attributes of a contact: a sphere, or a disc as thick as the sphere on its rim."""
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
    margin = 1e-9 * moments[2]  # MuJoCo diagonalises again and checks without a tolerance
    return inertia + 0.5 * (lacking + margin) * (np.eye(3) - np.outer(axes[:, 2], axes[:, 2]))


def _add_shape(element: ET.Element, shape: Shape) -> None:
    sizes = {
        "box": tuple(0.5 * x for x in shape.size),
        "sphere": shape.size,
        "cylinder": (shape.size[0], 0.5 * shape.size[-1]),
        "capsule": (shape.size[0], 0.5 * shape.size[-1]),
    }
    visual = {"rgba": text(shape.color), "group": "2", "contype": "0", "conaffinity": "0"}
    quat = text(quaternion(np.array(shape.placement.rotation)))
    place = {"pos": text(shape.placement.position), "quat": quat}
    ET.SubElement(element, "geom", {"type": shape.type, "size": text(sizes[shape.type]), **place, **visual})


def _add_frames(root: ET.Element, elements: Mapping[str | None, ET.Element], robot: Robot) -> None:
    """Add the frames of the robot as sites, unless a loop or rod has a site of that name."""
    sites = {site.get("name") for site in root.iter("site")}
    for frame in robot.frames:
        if frame.name not in sites and frame.body in elements:
            place = {
                "pos": text(frame.placement.position),
                "quat": text(quaternion(np.array(frame.placement.rotation))),
            }
            ET.SubElement(elements[frame.body], "site", {"name": frame.name, **place, "size": "0.005", "group": "3"})


def _add_actuators(root: ET.Element, robot: Robot) -> None:
    kp, kd = dict(robot.gains.kp), dict(robot.gains.kd)
    actuators = ET.SubElement(root, "actuator")
    for name in robot.driven:
        gains = {"kp": text(kp.get(name, 0.0)), "kv": text(kd.get(name, 0.0))}
        joint = robot.joint_name(name)
        actuator = ET.SubElement(actuators, "position", {"name": joint, "joint": joint, **gains})
        torque = robot.body(name).joint.torque
        if math.isfinite(torque):
            actuator.set("forcerange", text((-torque, torque)))


def _add_standing_pose(root: ET.Element, robot: Robot, standing: Mapping[str, float]) -> None:
    """Add the standing pose as a keyframe; MuJoCo orders coordinates depth first."""
    qpos: list[float] = []
    standing_q = {name: robot.standing_q[rows.start : rows.stop] for name, (rows, _) in robot.rows.items()}
    for element in root.iter("body"):
        name = element.get("name", "")
        if robot.body(name).joint.nv > 1:
            qpos += standing_q[name]
        else:
            qpos.append(standing[name])
    key = ET.SubElement(ET.SubElement(root, "keyframe"), "key", name="stand", qpos=text(qpos))
    key.set("ctrl", text([standing[name] for name in robot.driven]))
