"""`Robot`: the description of a robot as frozen data.

Every loader returns a `Robot`; every other part of the package starts from one. A robot is a spanning tree of
bodies, each with one joint to its parent, plus the constraints among joint coordinates
(gears, belts, differentials, closed loops). A robot's data refers to a joint by the body that it moves:
"the angle of FL_hip_link" is the coordinate of the joint between FL_hip_link and its parent. Joints also have the names
of the URDF or MJCF file, see `Robot.joint_name`.

Numbers are plain floats in tuples. Two robots are equal if and only if their numbers are, and a robot
can be hashed into a cache key. Units are SI and radians.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.constraints import Constraint, LinearConstraint
from ce_gym.model.coordinates import Layout, placed, sizes, unit_quaternions
from ce_gym.model.drives import Battery, Elasticity, Motor
from ce_gym.model.errors import listed_names
from ce_gym.model.frames import ORIGIN, Mat3, Placement, Vec3, added
from ce_gym.model.ranges import Finite, NotNegative, NotNegativeOrInfinite, Positive, Share

UNKNOWN_RATIO = 1e6
"""Gear ratio in place of an unknown one: the rotor's own inertia is then 1e-12 of the reflected inertia."""


@dataclass(frozen=True)
class Inertial:
    """Mass properties of a body in its own frame.

    Attributes:
        mass: Mass [kg]; zero is allowed for rotors whose mass the carrier's mass includes.
        com: Centre of mass [m].
        inertia: Rotational inertia about the centre of mass, body axes [kg m^2].
    """

    mass: float
    com: Vec3
    inertia: Mat3

    @property
    def trace(self) -> float:
        """Sum of the three moments of inertia [kg m^2]."""
        return sum(self.inertia[i][i] for i in range(3))


@dataclass(frozen=True)
class Joint:
    """The tree joint between a body and its parent: free, a ball, or a screw motion along an axis, of one coordinate.

    Attributes:
        type: "free" (six degrees of freedom, only against the world), "ball" (three, and no actuator), "revolute" or
            "prismatic".
        axis: Unit axis in the body frame; for "revolute" positive is right-handed. Ignored by "free" and "ball".
        position: Lower and upper limit [rad or m]; infinite without a limit. The upper limit of a ball joint is its
            largest angle about any axis; a ball joint has no lower limit.
        torque: Largest actuator effort at the joint [N m or N].
        velocity: Largest speed the actuator reaches [rad/s or m/s].
        damping: Viscous friction at the joint [N m s/rad or N s/m].
        friction: Dry friction at the joint [N m or N].
        stiffness: Stiffness of a spring at the joint [N m/rad or N/m].
        springref: Coordinate of the relaxed spring [rad or m]; the spring of a ball joint is relaxed at no rotation.
        name: Name in the URDF or MJCF file; "" without a name. See `Robot.joint_name`.
    """

    type: Literal["free", "ball", "revolute", "prismatic"]
    axis: Vec3 = (0.0, 0.0, 1.0)
    position: tuple[float, float] = (-float("inf"), float("inf"))
    torque: Annotated[NotNegativeOrInfinite, "N m or N"] = float("inf")
    velocity: Annotated[NotNegativeOrInfinite, "rad/s or m/s"] = float("inf")
    damping: Annotated[NotNegative, "N m s/rad or N s/m"] = 0.0
    friction: Annotated[NotNegative, "N m or N"] = 0.0
    stiffness: Annotated[NotNegative, "N m/rad or N/m"] = 0.0
    springref: Annotated[Finite, "rad or m"] = 0.0
    name: str = ""

    @property
    def nq(self) -> int:
        """Number of positions."""
        return sizes(self.type)[0]

    @property
    def nv(self) -> int:
        """Number of velocities."""
        return sizes(self.type)[1]

    @property
    def turn(self) -> float:
        """Angle about the axis for a unit of the coordinate [-]."""
        return SCREWS[self.type][0]

    @property
    def slide(self) -> float:
        """Travel along the axis for a unit of the coordinate [m/rad or -]."""
        return SCREWS[self.type][1]


SCREWS: dict[str, tuple[float, float]] = {"revolute": (1.0, 0.0), "prismatic": (0.0, 1.0)}
"""Rotation and translation for a unit of the coordinate, by type of joint with one coordinate [-]."""


@dataclass(frozen=True)
class Shape:
    """A primitive to draw.

    Attributes:
        type: "box", "cylinder", "capsule" or "sphere".
        size: box: full edge lengths x, y, z; cylinder and capsule: radius, length along z (without a capsule's
            half spheres); sphere: radius [m].
        placement: Pose of the shape's centre in the body frame.
        color: Red, green, blue, alpha in 0..1.
    """

    type: Literal["box", "cylinder", "capsule", "sphere"]
    size: tuple[Annotated[NotNegative, "m"], ...]
    placement: Placement = ORIGIN
    color: tuple[Share, Share, Share, Share] = (0.7, 0.7, 0.7, 1.0)


@dataclass(frozen=True)
class Body:
    """A rigid body and the joint that moves it.

    Attributes:
        name: Unique among all bodies.
        kind: "link", or "rotor" for a body that spins inside a transmission. The transmission levels differ only in
            their treatment of rotors. "stretch" is the coordinate of an elastic transmission, see `Elasticity`; it
            exists at the elastic level only.
        parent: Name of the parent body; None for the world.
        placement: Pose of the body frame in the parent frame when the joint coordinate is zero.
    """

    name: str
    kind: Literal["link", "rotor", "stretch"]
    parent: str | None
    placement: Placement
    joint: Joint
    inertial: Inertial
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class Frame:
    """A named frame on a body, such as a link on a fixed joint, or a site of MJCF.

    Attributes:
        name: Unique among frames and bodies.
        body: Name of the body with the frame; None for the world.
        placement: Pose of the frame in the body frame.
    """

    name: str
    body: str | None
    placement: Placement = ORIGIN


@dataclass(frozen=True)
class ContactSphere:
    """A sphere on a body that may touch the ground: fixed, or moving around a rim to the lowest point.

    Attributes:
        name: Unique among contacts.
        body: Name of the body with the sphere.
        position: Centre of a fixed sphere, or of the rim, in the body frame [m].
        radius: Radius [m]; zero for a point.
        group: Free label, such as "foot", "knee" or "torso", by which tasks choose contacts.
        rim: Radius of the circle on which the sphere's centre moves [m]; 0 for a fixed sphere.
        axis: Unit axis of that circle in the body frame.
        shape: Name of the convex shape with this corner; "" for a single sphere or point.
    """

    name: str
    body: str
    position: Vec3
    radius: Annotated[NotNegative, "m"]
    group: str = "foot"
    rim: Annotated[NotNegative, "m"] = 0.0
    axis: Vec3 = (0.0, 0.0, 1.0)
    shape: str = ""

    def lowest_point(self, position: NDArray[np.float64], rotation: NDArray[np.float64]) -> float:
        """Return the height of the lowest point [m].

        Args:
            position: Origin of the body in the world [m], shape (3,).
            rotation: Rotation, body to world, shape (3, 3).
        """
        lean = float(np.hypot(*(rotation @ np.array(self.axis))[:2]))  # the rim is vertical at 1, horizontal at 0
        return float((position + rotation @ np.array(self.position))[2]) - self.radius - self.rim * lean


@dataclass(frozen=True)
class Capsule:
    """The shape of a link in collisions with other links of its robot: all points within a radius of a segment.

    Attributes:
        body: Name of the link.
        start: Start of the segment in the body frame [m].
        end: End of the segment in the body frame [m]; equal to the start for a sphere.
        radius: Radius [m].
    """

    body: str
    start: Vec3
    end: Vec3
    radius: Annotated[Positive, "m"]


@dataclass(frozen=True)
class ContactMaterial:
    """Compliance and friction of each contact sphere.

    Attributes:
        stiffness: Normal stiffness [N/m].
        damping: Normal damping of Kelvin and Voigt's law [N s/m].
        friction: Coulomb coefficient [-].
        slip_speed: Speed at which the damping of friction alone carries its full force [m/s].
        bristle: Tangential stiffness of a contact that sticks [N/m]; 0 lets it creep.
        dissipation: Normal dissipation of Hunt and Crossley's law [s/m], which then takes the place of damping.
    """

    stiffness: Annotated[NotNegative, "N/m"] = 5e4
    damping: Annotated[NotNegative, "N s/m"] = 500.0
    friction: Annotated[NotNegative, "-"] = 0.8
    slip_speed: Annotated[Positive, "m/s"] = 1e-3
    bristle: Annotated[NotNegative, "N/m"] = 5e4
    dissipation: Annotated[NotNegative, "s/m"] | None = None


@dataclass(frozen=True)
class Pose:
    """A named configuration.

    Attributes:
        height: Height of the base origin above flat ground [m]; ignored by a fixed base.
        joints: Pairs (body, angle) for independent joints; other joints are at zero [rad or m].
        balls: Pairs (body, quaternion wxyz of norm 1 within 1e-3) for ball joints; others have no rotation.
    """

    height: Annotated[Finite, "m"] = 0.0
    joints: tuple[tuple[str, float], ...] = ()
    balls: tuple[tuple[str, tuple[float, float, float, float]], ...] = ()


@dataclass(frozen=True)
class Gains:
    """Joint-space PD gains, pairs (body, value); independent joints without have a gain of 0.

    Attributes:
        kp: Position gains [N m/rad or N/m].
        kd: Velocity gains [N m s/rad or N s/m].
    """

    kp: tuple[tuple[str, float], ...] = ()
    kd: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Robot:
    """A complete description of one robot.

    Attributes:
        name: Short name, such as "mini_cheetah".
        bodies: Parents before children. A floating base is a body with a "free" joint on the world, listed first.
        constraints: Constraints among joint coordinates or bodies.
        independent: Bodies whose joint coordinates are the independent coordinates `y`, in the order of `y`.
        contacts: Spheres that may touch the ground.
        material: Compliance and friction of the contacts.
        capsules: Shapes of links in collisions with other links, where the drawn shapes do not fit.
        self_collisions: Pairs of links that may collide, for scenes with self-collisions.
        motors: Motors, one for each driven rotor.
        elastic: Elastic transmissions of the elastic level; other transmissions are rigid.
        battery: Battery of the motors; None for a constant voltage.
        pose: The standing pose.
        gains: PD gains for position control of the independent joints.
        assembly: Pairs (body, angle) for dependent joints: rough coordinates in the standing pose [rad or m], which
            choose the branch on which closed loops are assembled. Other joints are near zero.
        gravity: Acceleration of free fall in the world frame [m/s^2].
        tasks: For each task with other settings on this robot, pairs (name of a setting, value).
        frames: Named frames on bodies; every body is a frame, too, and not listed here.
        kept_inertia: Patterns of names of bodies whose published inertia violates the triangle inequality and is kept.
        source: The robot's file, for messages.
        notes: Facts a user should know, such as repaired values.
    """

    name: str
    bodies: tuple[Body, ...]
    constraints: tuple[Constraint, ...] = ()
    independent: tuple[str, ...] = ()
    contacts: tuple[ContactSphere, ...] = ()
    material: ContactMaterial = ContactMaterial()
    capsules: tuple[Capsule, ...] = ()
    self_collisions: tuple[tuple[str, str], ...] = ()
    motors: tuple[Motor, ...] = ()
    elastic: tuple[Elasticity, ...] = ()
    battery: Battery | None = None
    pose: Pose = Pose()
    gains: Gains = Gains()
    assembly: tuple[tuple[str, float], ...] = ()
    gravity: Vec3 = (0.0, 0.0, -9.81)
    tasks: tuple[tuple[str, tuple[tuple[str, Any], ...]], ...] = ()
    frames: tuple[Frame, ...] = ()
    kept_inertia: tuple[str, ...] = field(default=(), compare=False)
    source: str = field(default="", compare=False)
    notes: tuple[str, ...] = field(default=(), compare=False)

    def body(self, name: str) -> Body:
        """Return the body called `name`; KeyError without such a body."""
        for body in self.bodies:
            if body.name == name:
                return body
        raise KeyError(f"{self.name} has no body {name!r}; it has {listed_names(name, [b.name for b in self.bodies])}")

    def joint_name(self, body: str) -> str:
        """Return the name of the joint that moves a body.

        That is the name in the robot's file; the name of the body if the file gives none, or one of another body.
        """
        name = self.body(body).joint.name
        return name if name and all(other.name != name for other in self.bodies) else body

    @property
    def links_by_joint(self) -> dict[str, str]:
        """The body that each joint moves, by the name of the joint."""
        return {self.joint_name(body.name): body.name for body in self.bodies}

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the joints in `commanded`, see `joint_name`."""
        return tuple(map(self.joint_name, self.commanded))

    def rotors(self) -> Iterator[Body]:
        """Iterate over the bodies that spin inside transmissions."""
        return (body for body in self.bodies if body.kind == "rotor")

    @property
    def unknown_ratios(self) -> tuple[str, ...]:
        """The rotors without gear ratio in the robot's file, such as armature in MJCF; see `UNKNOWN_RATIO`."""
        ties = [tie for tie in self.constraints if isinstance(tie, LinearConstraint)]
        steep = [tie for tie in ties if max(abs(x) for _, x in tie.coefficients) >= UNKNOWN_RATIO / 100]
        tied = {name for tie in steep for name in tie.bodies}
        return tuple(body.name for body in self.rotors() if body.name in tied and body.inertial.trace < 1e-9)

    @property
    def commanded(self) -> tuple[str, ...]:
        """The independent joints, which come first in `independent`, without stretches of transmissions."""
        stretches = {body.name for body in self.bodies if body.kind == "stretch"}
        return tuple(name for name in self.independent if name not in stretches)

    @property
    def passive(self) -> tuple[str, ...]:
        """The independent joints without an actuator, whose torque limit is 0 while the limit of another joint is not.

        CAD exports of URDF files have `effort="0"` everywhere. If the torque limit of all independent joints is 0,
        joints with a spring are passive. Passive joints have positions and speeds, and entries in targets without
        effect, but no gains and no actions.
        """
        joints = {body.name: body.joint for body in self.bodies}  # names are checked later
        idle = [name for name in self.commanded if name in joints and joints[name].torque == 0.0]
        if len(idle) < len(self.commanded):
            return tuple(idle)
        return tuple(name for name in idle if joints[name].stiffness)

    @property
    def driven(self) -> tuple[str, ...]:
        """The commanded joints that are not passive."""
        return tuple(name for name in self.commanded if name not in self.passive)

    @property
    def floating(self) -> bool:
        """Whether the first body is free to move in the world."""
        return bool(self.bodies) and self.bodies[0].joint.type == "free"

    @property
    def balls(self) -> tuple[str, ...]:
        """The body that each ball joint moves."""
        return tuple(body.name for body in self.bodies if body.joint.type == "ball")

    @property
    def layout(self) -> Layout:
        """The rows of each kind of joint in `q` and `v`."""
        return Layout(self.floating, len(self.balls), len(self.independent))

    @property
    def rows(self) -> dict[str, tuple[range, range]]:
        """Rows in `q` and in `v` of the base, ball joints and independent joints, by body, in their order."""
        base = [self.bodies[0].name] if self.floating else []
        types = {body.name: body.joint.type for body in self.bodies}
        return placed([(name, types[name]) for name in (*base, *self.balls, *self.independent) if name in types])

    @property
    def spanning_rows(self) -> dict[str, tuple[range, range]]:
        """Rows of each joint among the positions and the velocities of all joints, in the order of bodies."""
        return placed([(body.name, body.joint.type) for body in self.bodies])

    @property
    def standing_q(self) -> tuple[float, ...]:
        """Positions of the standing pose, upright at the origin, shape (nq,)."""
        base = [0.0, 0.0, self.pose.height, 1.0, 0.0, 0.0, 0.0] if self.floating else []
        angles = dict(self.pose.joints)
        balls = [x for quaternion in self.standing_balls.values() for x in quaternion]
        return (*base, *balls, *(angles.get(name, 0.0) for name in self.independent))

    @property
    def standing_balls(self) -> dict[str, tuple[float, ...]]:
        """Unit quaternions (w, x, y, z) of the ball joints in the standing pose, by name of the body."""
        turned = dict(self.pose.balls)
        rows = {name: np.array(turned.get(name, (1.0, 0.0, 0.0, 0.0)), float) for name in self.balls}
        return {name: tuple(unit_quaternions(row, (0,), f"pose.balls.{name}").tolist()) for name, row in rows.items()}

    @property
    def joints(self) -> tuple[str, ...]:
        """The body that each joint moves, a floating base left out."""
        return tuple(body.name for body in self.bodies if body.joint.type != "free")

    @property
    def total_mass(self) -> float:
        """Mass of all bodies [kg]."""
        return added(body.inertial.mass for body in self.bodies)
