"""The contents of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.hulls import Hull, poles_of
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant
from ce_gym.model.description import ContactMaterial, ContactSphere
from ce_gym.model.mechanism import Mechanism

Control = Literal["position", "torque", "motor_position", "motor_torque"]
Ground = Literal["flat", "field"]


@dataclass(frozen=True)
class StepOptions:
    """The contents of a scene and its time stepping.

    Attributes:
        dt: Length of the step [s], a constant of the traced step; None makes it an input, which kernels have.
        control: "position" for joint targets [rad or m] through the robot's gains, "torque" for joint torques;
            "motor_position" and "motor_torque" for angles and torques of the motors' rotors instead.
        contacts: Names of the contact spheres that can touch the ground.
        material: Compliance and friction of the contacts.
        normal_law: Name among `NORMAL_LAWS` of the contacts' normal force; None for the law of the material.
        friction: Name among `FRICTION` of the contacts' friction law.
        method: Name among `METHODS` of a time-stepping method.
        motors: Name among `MOTORS` of the model of the motors.
        ground: "flat" for the plane z = 0, "field" for a height and slope under each contact that the caller supplies.
        parameters: Names of figures that are inputs rather than constants, see `PARAMETERS`.
        self_collisions: Pairs of links that push each other apart.
        seldom: Contacts that are looked at only where they are near, see `stepping/broad_phase.py`.
        control_period: Of position control: it looks at joints or motors every so often and holds its torques in
            between [s]; 0 for controllers that never stop, see `forces/motor_control.py`.
        hulls: Convex shapes with further contacts between their corners, on a field.
        retry: How often a kernel may halve a step for a robot that fails in it, see `stepping/halving.py`.
    """

    dt: float | None = None
    control: Control = "position"
    contacts: tuple[str, ...] = ()
    material: ContactMaterial = field(default_factory=ContactMaterial)
    normal_law: str | None = None
    friction: str = "tangent"
    method: str = "euler"
    motors: str = "ideal"
    ground: Ground = "flat"
    parameters: tuple[str, ...] = ()
    self_collisions: tuple[tuple[str, str], ...] = ()
    seldom: tuple[str, ...] = ()
    control_period: float = 0.0
    retry: int = 6
    hulls: tuple[Hull, ...] = ()

    @property
    def touches(self) -> tuple[str, ...]:
        """Names of the contacts, and of the corner that stands for each region of a hull: all that may touch."""
        return (*self.contacts, *(self.contacts[i] for i in poles_of(self.hulls)))

    @property
    def sampled(self) -> bool:
        """Whether commanded torques are held between the samples of a controller."""
        return self.control_period > 0 and self.control.endswith("position")


@dataclass
class Scene:
    """A robot in a scene, with numbers or symbols for its parameters.

    Attributes:
        mechanism: The robot at a transmission level.
        options: The contents of the scene.
        values: Parameters of the force laws by name.
        ground: Height [m] and slopes dz/dx, dz/dy of the ground under each of the options' `touches`, shape
            (3, n_touches); not used on flat ground.
        region_points: Where on their bodies the regions of hulls touch the ground [m], shape (3, n_regions).
        looked_up: Where the contact centres were when the ground was looked up, x and y [m], shape (2, n_touches);
            empty if that is where they are.
        choosing: Whether contacts that are seldom near are skipped where none is near; else all contacts always act.
    """

    mechanism: Mechanism
    options: StepOptions
    values: Mapping[str, SX]
    ground: SX
    region_points: SX = field(default_factory=lambda: SX(3, 0))
    looked_up: SX = field(default_factory=SX)
    choosing: bool = False


def target_names(mechanism: Mechanism, control: Control) -> tuple[str, ...]:
    """Return the name of the body that each entry of a target moves.

    The independent joints, without stretches of transmissions; or, for control at the motors, the motors' rotors and
    then the joints that no motor drives, which are controlled as joints.
    """
    robot = mechanism.robot
    if control in ("position", "torque"):
        return robot.commanded
    rotors = tuple(motor.rotor for motor in robot.motors)
    driven = {
        name for cluster in mechanism.tree.clusters if set(rotors) & set(cluster.bodies) for name in cluster.bodies
    }
    return rotors + tuple(name for name in robot.commanded if name not in driven)


def contact_spheres(mechanism: Mechanism, options: StepOptions) -> list[ContactSphere]:
    """Return the contact spheres of a scene."""
    spheres = {contact.name: contact for contact in mechanism.robot.contacts}
    return [spheres[name] for name in options.contacts]


def contact_centres(scene: Scene) -> list[tuple[ContactSphere, SX]]:
    """Return all that may touch the ground, and where its centre is in its body [m], shape (3,)."""
    spheres = contact_spheres(scene.mechanism, scene.options)
    centres = [constant(np.array(sphere.position)) for sphere in spheres] + ca.horzsplit(scene.region_points)
    poles = [replace(spheres[i], radius=0.0) for i in poles_of(scene.options.hulls)]
    return list(zip([*spheres, *poles], centres, strict=True))


def contact_places(scene: Scene, kinematics: Kinematics) -> SX:
    """Return x and y of the centre of all that may touch the ground [m], shape (2, n_touches)."""
    places = [kinematics.bodies[s.body].point_position(centre)[:2] for s, centre in contact_centres(scene)]
    return ca.horzcat(SX(2, 0), *places)
