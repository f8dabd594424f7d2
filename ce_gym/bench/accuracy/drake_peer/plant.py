# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
"""A scene as a diagram of Drake: the robot at a transmission level, its drives and the ground.

All parts of the diagram are C++ code of Drake, so that one call simulates a scene: a source of targets or torques, the
plant, and a log of the state at the end of every hold. Drake's Python interface can couple two joints but not several,
as a parallel belt does. The parsers can, with `drake:tendon_constraint`
(https://drake.mit.edu/doxygen_cxx/group__multibody__parsing.html). So the robot and its couplings are written as URDF.
The URDF has placeholder masses, because the parser refuses published inertias that violate the triangle inequality.
"""

from __future__ import annotations

import logging
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import PdControllerGains, SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from ce_gym.bench.accuracy.scenarios import HOLD, Scene
from ce_gym.export.joint_ties import Tie, joint_ties
from ce_gym.export.mjcf import SMALLEST_MASS, mass_properties
from ce_gym.export.mjcf_equalities import joint_armature
from ce_gym.export.mjcf_text import text
from ce_gym.model.mechanism import Mechanism, MovingBody, build_mechanism

logging.getLogger("drake").setLevel(logging.ERROR)  # no warnings about half spaces and TAMSI

BEFORE = 1e-9
"""Time by which a target is set before its hold [s], because the start times of steps are rounded."""
RIGID = 1e30
"""Stiffness of belts [N m/rad], a replacement for infinity in URDF; the solver takes the largest possible value."""
JOINTS = {"revolute": "continuous", "prismatic": "prismatic"}
"""Types of joints in URDF."""


@dataclass(frozen=True)
class Stated:
    """A scene in Drake.

    Attributes:
        diagram: Source, plant and log.
        plant: Plant of the robot.
        log: Log of the plant's state.
        mechanism: Mechanism of the robot in ce_gym.
    """

    diagram: Any
    plant: Any
    log: Any
    mechanism: Mechanism


def stated(scene: Scene, level: str, dt: float, approximation: str) -> Stated:
    """Return a scene in Drake at a transmission level.

    Args:
        scene: A scene with torques or targets of joints, and no push or a constant push.
        level: "none", "armature" or "exact".
        dt: Length of discrete steps [s]; 0 for a plant in continuous time.
        approximation: Approximation of a discrete plant: "sap", "similar", "lagged" or "tamsi".
    """
    mechanism = build_mechanism(scene.robot, level, eliminate=False)
    builder = DiagramBuilder()
    contact = bool(scene.robot.contacts)
    how = {} if dt == 0.0 else {"discrete_contact_approximation": approximation}
    config = MultibodyPlantConfig(
        time_step=dt,
        use_sampled_output_ports=False,
        contact_model="point",
        stiction_tolerance=scene.robot.material.slip_speed,
        **how,
    )
    plant, _ = AddMultibodyPlant(config, builder)
    ties = joint_ties(mechanism)
    (instance,) = Parser(plant).AddModelsFromString(to_urdf(mechanism, ties), "urdf")
    _add_couplers(plant, mechanism, ties)
    _add_actuators(plant, scene, joint_armature(mechanism, ties))
    push = np.zeros(3) if scene.push is None else scene.push[0]
    plant.mutable_gravity_field().set_gravity_vector(np.array(scene.robot.gravity) + push)
    if contact:
        _add_contacts(plant, scene, hunt_crossley=approximation != "sap" or dt == 0.0)
    plant.Finalize()
    _drive(builder, plant, instance, scene, dt)
    log = LogVectorOutput(plant.get_state_output_port(), builder, HOLD)
    return Stated(builder.Build(), plant, log, mechanism)


def to_urdf(mechanism: Mechanism, ties: Mapping[str, Tie]) -> str:
    """Return the URDF of a mechanism with its rotors as bodies; joints have the names of their bodies."""
    root = ET.Element("robot", name=mechanism.robot.name)
    for moving in mechanism.bodies.values():
        _add_body(root, moving)
    for name in mechanism.bodies:
        if name in ties and len(ties[name].ratios) > 1:
            _add_belt(root, name, ties[name])
    return ET.tostring(root, encoding="unicode")


def _add_body(root: ET.Element, moving: MovingBody) -> None:
    link = ET.SubElement(ET.SubElement(root, "link", name=moving.name), "inertial")
    ET.SubElement(link, "mass", value="1")
    ET.SubElement(link, "inertia", ixx="1", iyy="1", izz="1", ixy="0", ixz="0", iyz="0")
    if moving.joint.type == "free":
        return
    joint = ET.SubElement(root, "joint", name=moving.name, type=JOINTS[moving.joint.type])
    ET.SubElement(joint, "parent", link=moving.parent or "world")
    ET.SubElement(joint, "child", link=moving.name)
    angles = RollPitchYaw(RotationMatrix(np.asarray(moving.rotation, dtype=float))).vector()
    ET.SubElement(joint, "origin", xyz=text(moving.position), rpy=text(angles))
    ET.SubElement(joint, "axis", xyz=text(moving.axis))
    ET.SubElement(joint, "dynamics", damping=text(moving.joint.damping))


def _add_belt(root: ET.Element, name: str, tie: Tie) -> None:
    """Couple a joint to several others by a tendon of constant length, with the largest stiffness of the solver."""
    tendon = ET.SubElement(root, "drake:tendon_constraint")
    for joint, ratio in {name: 1.0, **{joint: -ratio for joint, ratio in tie.ratios.items()}}.items():
        ET.SubElement(tendon, "drake:tendon_constraint_joint", name=joint, a=text(ratio))
    figures = {"offset": -tie.offset, "lower_limit": 0.0, "upper_limit": 0.0, "stiffness": RIGID, "damping": 0.0}
    for key, value in figures.items():
        ET.SubElement(tendon, f"drake:tendon_constraint_{key}", value=str(value))


def _add_couplers(plant: MultibodyPlant, mechanism: Mechanism, ties: Mapping[str, Tie]) -> None:
    """Couple every joint that depends on one other joint; other couplings are tendons in the URDF."""
    for name in mechanism.bodies:
        if name in ties and name not in ties[name].ratios and len(ties[name].ratios) == 1:
            ((other, ratio),) = ties[name].ratios.items()
            joints = (plant.GetJointByName(joint) for joint in (name, other))
            plant.AddCouplerConstraint(*joints, ratio, ties[name].offset)


def _add_actuators(plant: MultibodyPlant, scene: Scene, armature: dict[str, float]) -> None:
    """Add a motor to every driven joint, with reflected inertia, gains and torque limit."""
    robot = scene.robot
    kp, kd = dict(robot.gains.kp), dict(robot.gains.kd)
    for name in robot.independent:
        motor = plant.AddJointActuator(name, plant.GetJointByName(name), robot.body(name).joint.torque)
        motor.set_default_rotor_inertia(armature.get(name, 0.0))
        motor.set_default_gear_ratio(1.0)
        if scene.control == "position":
            motor.set_controller_gains(PdControllerGains(p=kp.get(name, 0.0), d=kd.get(name, 0.0)))


def _add_contacts(plant: MultibodyPlant, scene: Scene, hunt_crossley: bool) -> None:
    """Add contact spheres on a rigid half space, with the damping of ce_gym, for Hunt-Crossley at standing load."""
    robot, law = scene.robot, scene.robot.material
    properties, ground = ProximityProperties(), ProximityProperties()
    friction = CoulombFriction(law.friction, law.friction)
    weight = robot.total_mass * float(np.linalg.norm(robot.gravity))
    damping = law.damping * len(robot.contacts) / weight if hunt_crossley else None
    AddContactMaterial(dissipation=damping, point_stiffness=law.stiffness, friction=friction, properties=properties)
    AddContactMaterial(
        dissipation=0.0 if hunt_crossley else None, point_stiffness=1e12, friction=friction, properties=ground
    )
    properties.AddProperty("material", "relaxation_time", law.damping / law.stiffness)
    ground.AddProperty("material", "relaxation_time", 0.0)
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground)
    for contact in robot.contacts:
        place = RigidTransform(np.array(contact.position))
        body = plant.GetBodyByName(contact.body)
        plant.RegisterCollisionGeometry(body, place, Sphere(contact.radius), contact.name, properties)


def _drive(builder: DiagramBuilder, plant: MultibodyPlant, instance: Any, scene: Scene, dt: float) -> None:
    """Add the source of targets or torques; a plant in continuous time needs an event at every change."""
    if not plant.num_actuators():
        return
    drive = scene.drive if scene.control == "torque" else np.hstack([scene.drive, np.zeros_like(scene.drive)])
    breaks = HOLD * np.arange(scene.holds + 1) - BEFORE
    samples = np.vstack([drive, drive[-1:]]).T
    source = builder.AddSystem(TrajectorySource(PiecewisePolynomial.ZeroOrderHold(breaks, samples)))
    output = source.get_output_port()
    if dt == 0.0:
        hold = builder.AddSystem(ZeroOrderHold(HOLD, len(samples)))
        builder.Connect(output, hold.get_input_port())
        output = hold.get_output_port()
    torque = scene.control == "torque"
    builder.Connect(
        output, plant.get_actuation_input_port() if torque else plant.get_desired_state_input_port(instance)
    )


def put_inertias(stated: Stated, context: Any) -> None:
    """Replace placeholder inertias by the published ones."""
    for moving in stated.mechanism.bodies.values():
        mass, com, inertia = mass_properties(moving.inertia)
        mass = max(mass, SMALLEST_MASS)  # inertia for unit mass
        about_origin = inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))
        unit = about_origin / mass
        spatial = SpatialInertia(mass, com, UnitInertia(*unit.diagonal(), unit[0, 1], unit[0, 2], unit[1, 2]), True)
        stated.plant.GetBodyByName(moving.name).SetSpatialInertiaInBodyFrame(context, spatial)
