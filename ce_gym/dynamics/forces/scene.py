"""The contents of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.motors import MOTORS
from ce_gym.dynamics.forces.normal import NORMAL_LAWS
from ce_gym.dynamics.hulls import Hull, poles_of
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant
from ce_gym.model.arguments import check
from ce_gym.model.description import ContactMaterial, ContactSphere
from ce_gym.model.mechanism import Mechanism
from ce_gym.model.options import Options, names, number, one_of, option, optional, pairs_of_names, positive, whole
from ce_gym.model.ranges import check_fields

Control = Literal["position", "torque", "motor_position", "motor_torque"]
JointControl = Literal["velocity", "torque"]
Ground = Literal["flat", "field"]


@dataclass(frozen=True, kw_only=True)
class SceneOptions(Options):
    """How contacts, motors and time steps are simulated; `Simulator` takes these options, a `Task` has them as fields.

    Attributes:
        contacts: Contact spheres that can touch the ground: "all", or names of spheres or of groups such as "foot".
        self_collisions: Links that push each other apart: "listed" for the pairs of the robot's file, "all" for links
            that are not adjacent and do not overlap in the standing pose, or pairs of names.
        normal_law: Normal force of contacts: "kelvin_voigt" or "hunt_crossley"; None for the law of the material.
        friction: Friction of contacts: "tangent" iterates where a contact changes between stick and slip; "secant" is
            faster and breaks away late.
        motors: "ideal" for the torque limits of joints; "limited" for the torque limits, torque-speed lines and
            friction of motors.
        control_period: Sampling period of position controllers, which hold their torque between samples [s], a multiple
            of `dt`; 0 for continuous controllers.
        dt: Length of a sub-step [s]; the default method is stable to 10 ms and more.
        method: "euler" (linearly implicit, order 1), "extrapolated" (order 2), "rk4" or "rk8" (explicit, for smooth
            scenes), or "adaptive": extrapolated steps within each sub-step, as long as `tolerance` allows.
        tolerance: Error of positions that a step of method "adaptive" may have [rad or m]; 1e-3 if None.
        retry: How often a sub-step may be halved for a robot that diverges in it, or whose joints move too far, see
            `ce_gym.dynamics.stepping.halving.LARGEST_MOVE`; the other robots of the batch keep the whole sub-step.
    """

    contacts: str | tuple[str, ...] = option(names, "all")
    self_collisions: str | tuple[tuple[str, ...], ...] = option(pairs_of_names, ())
    normal_law: str | None = option(optional(one_of(NORMAL_LAWS)), None)
    friction: str = option(one_of(FRICTION), "tangent")
    motors: str = option(one_of(MOTORS), "ideal")
    control_period: float = option(number(0), 0.0)
    dt: float = option(positive(0.1, "s"), 0.005)
    method: str = option(one_of(METHODS), "euler")
    tolerance: float | None = option(optional(number(1e-9, 1, "rad or m")), None)
    retry: int = option(whole(0, 10), 6)

    def __post_init__(self) -> None:
        super().__post_init__()
        known = METHODS[self.method].controlled or self.tolerance is None
        check("tolerance", self.tolerance, known, f"None, because method is {self.method!r}")
        if self.dt is None:  # in `StepOptions`
            return
        steps = self.control_period / self.dt
        expected = f"0, or a multiple of dt={self.dt:g} s: faster controllers are as those of 0"
        check("control_period", self.control_period, abs(steps - round(steps)) < 1e-6 * max(steps, 1.0), expected)

    @property
    def shared(self) -> dict[str, Any]:
        """The fields of this class by name, without fields that a subclass adds."""
        return {each.name: getattr(self, each.name) for each in fields(SceneOptions)}


def contact_material(name: str, value: Any) -> ContactMaterial:
    """Check the material of contacts."""
    check(name, value, isinstance(value, ContactMaterial), "a ContactMaterial or None")
    check_fields(value, "Simulator", f"{name}.")
    return value


@dataclass(frozen=True)
class StepOptions(SceneOptions):
    """Scene options with names resolved for one robot, and further options of its steps.

    Attributes:
        dt: Length of the step [s], a constant of the traced step; None makes it an input, as in kernels.
        contacts: Names of contact spheres.
        self_collisions: Pairs of names of links.
        control: Meaning of targets, see `ce_gym.Simulator`.
        joint_control: Joints whose targets are velocities or torques although `control` is "position", by name.
        material: Compliance and friction of the contacts.
        parameters: Names of parameters that are inputs rather than constants, see `PARAMETERS`.
        ground: "flat" for the plane z = 0, "field" for a height and slope under each contact that the caller supplies.
        hulls: Convex shapes with further contacts between their corners, on a field.
    """

    dt: float | None = None  # type: ignore[assignment]
    _: KW_ONLY
    contacts: tuple[str, ...] = ()
    self_collisions: tuple[tuple[str, str], ...] = ()
    control: Control = "position"
    joint_control: tuple[tuple[str, JointControl], ...] = ()
    material: ContactMaterial = option(contact_material, ContactMaterial())
    parameters: tuple[str, ...] = ()
    ground: Ground = "flat"
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
        culls: Whether contacts of a culled group act only while one of them is near; else all contacts always act.
        joint_space: Whether robots with short branches are solved in joint space; else all by CE-ABA, which takes more
            operations but keeps fewer values at a time.
    """

    mechanism: Mechanism
    options: StepOptions
    values: Mapping[str, SX]
    ground: SX
    region_points: SX = field(default_factory=lambda: SX(3, 0))
    looked_up: SX = field(default_factory=SX)
    culls: bool = False
    joint_space: bool = True


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
