"""The scenes of the accuracy benchmark: which robot, from where, driven how and for how long.

Everything is held for `HOLD` at a time, joint targets, torques and pushes alike, so that every code integrates the same
motion whatever its step, and every step length divides `HOLD`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.speed.benchmark import bare
from ce_gym.dynamics.model import Model
from ce_gym.model import (
    Body,
    ContactMaterial,
    ContactSphere,
    Gains,
    Inertial,
    Joint,
    LoopConstraint,
    Placement,
    Pose,
    Robot,
    load_robot,
)
from ce_gym.model.frames import Mat3

Array = NDArray[np.float64]

Way = tuple[str, str, str]
"""Method, transmission level and friction of one of our curves."""

HOLD = 0.02
"""How long a target, torque or push is held, and the time between two recorded positions [s]."""

SLIP_SPEED = 1e-3
"""Slip speed of the contacts of every scene [m/s]."""


@dataclass(frozen=True)
class Scene:
    """One scene.

    Attributes:
        name: For tables and files.
        title: For pictures.
        robot: Limits of joints left out, only contacts that take part.
        q: Positions at the start, shape (nq,).
        v: Velocities at the start, shape (nv,).
        drive: Joint targets [rad] or torques [N m] of every hold, shape (n_holds, n_joints).
        control: What `drive` is.
        push: Acceleration of the base in place of a horizontal force, world axes [m/s^2], shape (n_holds, 3), or None.
        ours: Methods of ours, with their transmission level and friction.
        levels: Transmission levels of the peers.
        spread: Standard deviation of the starting positions of the other robots of a batch [rad and m].
        reference: Steps to a hold of the reference.
    """

    name: str
    title: str
    robot: Robot
    q: Array
    v: Array
    drive: Array
    control: Literal["torque", "position"] = "torque"
    push: Array | None = None
    ours: tuple[Way, ...] = ()
    levels: tuple[str, ...] = ("armature", "exact")
    spread: float = 0.01
    reference: int = 100

    @property
    def smooth(self) -> bool:
        """Whether nothing touches anything."""
        return not self.robot.contacts

    @property
    def duration(self) -> float:
        """Simulated time [s]."""
        return self.holds * HOLD

    @property
    def holds(self) -> int:
        """How many times the drive changes, the start included."""
        return len(self.drive)


SMOOTH: tuple[Way, ...] = (
    ("euler", "exact", "tangent"),
    ("extrapolated", "exact", "tangent"),
    ("rk4", "exact", "tangent"),
)
ROUGH: tuple[Way, ...] = (
    ("euler", "exact", "tangent"),
    ("extrapolated", "exact", "tangent"),
    ("euler", "exact", "secant"),
)
APPROXIMATE: Way = ("euler", "armature", "tangent")


def humanoid() -> Scene:
    """Return a humanoid that floats without gravity while every joint is driven by a sinusoidal torque."""
    robot = unbounded(replace(load_robot("mit_humanoid"), contacts=(), gravity=(0.0, 0.0, 0.0)))
    return _driven("humanoid", "Floating humanoid, sinusoidal torques", robot, 0.5, 0.7, (*SMOOTH, APPROXIMATE))


def tumble() -> Scene:
    """Return a box that spins about its middle axis and turns over (Dzhanibekov), as in MuJoCo's own test."""
    inertia = _diagonal(0.02, 0.03, 0.04)
    box = Body("box", "link", None, Placement(), Joint("free"), Inertial(2.0, (0.0, 0.0, 0.0), inertia))
    robot = Robot("box", (box,), gravity=(0.0, 0.0, 0.0))
    q, v = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.05, 5.0, 0.05, 0.0, 0.0, 0.0])
    still = np.zeros((round(4.0 / HOLD), 0))
    return Scene("tumble", "Box turning over in flight", robot, q, v, still, ours=SMOOTH, levels=("none",))


def four_bar() -> Scene:
    """Return a crank and rocker (0.15, 0.30, 0.25 m on a base of 0.30 m) thrown at 12 rad/s, for two turns."""

    def bar(name: str, parent: str | None, x: float, length: float) -> Body:
        m, square = 2.0 * length, length**2
        inertia = ((1e-4, 0.0, 0.0), (0.0, m * square / 12, 0.0), (0.0, 0.0, m * square / 12))
        joint = Joint("revolute", (0.0, 0.0, 1.0))
        return Body(name, "link", parent, Placement((x, 0.0, 0.0)), joint, Inertial(m, (length / 2, 0.0, 0.0), inertia))

    bodies = (bar("crank", None, 0.0, 0.15), bar("coupler", "crank", 0.15, 0.30), bar("rocker", None, 0.30, 0.25))
    ends = (Placement((0.30, 0.0, 0.0)), Placement((0.25, 0.0, 0.0)))
    loop = LoopConstraint("pin", "revolute", "coupler", "rocker", *ends)
    pose, assembly = Pose(joints=(("crank", 1.5),)), (("coupler", -1.2), ("rocker", 1.9))
    robot = Robot("crank_rocker", bodies, (loop,), ("crank",), pose=pose, assembly=assembly)
    none = np.zeros((round(1.0 / HOLD), 1))
    start, speed = np.array([1.5]), np.array([12.0])
    return Scene(
        "four_bar",
        "Four-bar, a crank and a rocker",
        robot,
        start,
        speed,
        none,
        ours=SMOOTH,
        levels=("exact",),
        reference=200,
    )


def tello() -> Scene:
    """Return Tello's legs, floating without gravity: differentials, cranks and rods."""
    robot = unbounded(replace(load_robot("tello"), contacts=(), gravity=(0.0, 0.0, 0.0)))
    ours: tuple[Way, ...] = (*SMOOTH, ("euler", "coupled", "tangent"))
    return replace(_driven("tello", "Floating Tello, rods and differentials", robot, 0.5, 0.1, ours), levels=LOOPED)


LOOPED = ("coupled", "exact")
"""Levels at which MJCF can state a robot whose rotors are driven through loops."""


def belt_leg() -> Scene:
    """Return a leg with parallel belts on a fixed base, whose rotors carry much of the momentum."""
    robot = unbounded(load_robot("mit_humanoid_leg"))
    return _driven("belt_leg", "Leg with belts, sinusoidal torques", robot, 0.5, 3.0, (*SMOOTH, APPROXIMATE))


def stiff_leg(stiffness: float) -> Scene:
    """Return the same leg under position control with gains of `stiffness` [N m/rad], well damped."""
    robot = unbounded(load_robot("mit_humanoid_leg"))
    damping = 2.0 * np.sqrt(0.1 * stiffness)
    kp, kd = (tuple((name, value) for name in robot.independent) for value in (stiffness, damping))
    robot = replace(robot, gains=Gains(kp, kd))
    start, t = Model(robot).standing_q, HOLD * np.arange(15)[:, None]
    targets = start + 0.2 * np.sin(2 * np.pi * 3.0 * t + np.arange(len(start)))
    title = f"Position control, {stiffness:.0e} N m/rad"
    name = f"stiff_{stiffness:.0e}".replace("e+0", "e")
    ours, still = (*SMOOTH, APPROXIMATE), np.zeros(len(start))
    reference = 400 if stiffness > 1e4 else 100
    return Scene(name, title, robot, start, still, targets, "position", ours=ours, reference=reference)


def drop(height: float, duration: float) -> Scene:
    """Return Mini Cheetah let go `height` [m] above the ground, slightly tilted, holding its standing pose."""
    robot = _on_feet("mini_cheetah")
    model = Model(robot)
    q = model.standing_q.copy()
    q[2] += height + 0.01
    q[3:7] = np.array([1.0, 0.03, 0.02, 0.0]) / np.linalg.norm([1.0, 0.03, 0.02, 0.0])
    targets = np.tile(model.standing_q[7:], (round(duration / HOLD), 1))
    name, title = f"drop_{round(100 * height)}cm", f"Mini Cheetah dropped {100 * height:.0f} cm"
    return Scene(name, title, robot, q, np.zeros(model.nv), targets, "position", ours=ROUGH, spread=0.003)


def trot() -> Scene:
    """Return Mini Cheetah with its diagonal legs lifted in turn by a fixed sequence of joint targets, 1 s."""
    robot = _on_feet("mini_cheetah")
    model = Model(robot)
    t = HOLD * np.arange(round(1.0 / HOLD))
    targets = np.tile(model.standing_q[7:], (len(t), 1))
    for i, name in enumerate(model.joint_links):
        swing = np.maximum(0.0, np.sin(2 * np.pi * 2.5 * t + (0.0 if name[:2] in ("FR", "HL") else np.pi)))
        if name.endswith(("_hip_link", "_knee_link")):
            targets[:, i] += (-0.35 if "hip" in name else 0.7) * swing
    ours, start = ROUGH, model.standing_q
    return Scene("trot", "Trot on the spot, 1 s", robot, start, np.zeros(model.nv), targets, "position", ours=ours)


BLOCK_HALF = (0.15, 0.1, 0.05)
"""Half the edges of the block [m]."""
BLOCK_MASS = 10.0
BLOCK_FRICTION = 0.5
GRAVITY = 9.81


def block(name: str, title: str, push: Array) -> Scene:
    """Return a block on four corners under a horizontal push, in parts of its weight, shape (n_holds,)."""
    a, b, c = BLOCK_HALF
    third = BLOCK_MASS / 3.0
    inertia = _diagonal(third * (b * b + c * c), third * (a * a + c * c), third * (a * a + b * b))
    box = Body("block", "link", None, Placement(), Joint("free"), Inertial(BLOCK_MASS, (0.0, 0.0, 0.0), inertia))
    corners = tuple(
        ContactSphere(f"corner{i}", "block", (x, y, -c), 0.0)
        for i, (x, y) in enumerate(((a, b), (a, -b), (-a, b), (-a, -b)))
    )
    material = ContactMaterial(5e4, 300.0, BLOCK_FRICTION, SLIP_SPEED)
    height = c - BLOCK_MASS * GRAVITY / (4 * material.stiffness)
    robot = Robot("block", (box,), contacts=corners, material=material, pose=Pose(c))
    q, holds = np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]), len(push)
    pushes = GRAVITY * np.stack([push, 0 * push, 0 * push], axis=1)
    ours = ROUGH
    none = np.zeros((holds, 0))
    return Scene(name, title, robot, q, np.zeros(6), none, push=pushes, ours=ours, levels=("none",), spread=0.0)


def stick() -> Scene:
    """Return the block that holds against its push: as smooth as a scene without contact, so explicit methods serve."""
    push = 0.8 * BLOCK_FRICTION * np.ones(25)
    scene = block("stick", "Block that sticks, 0.8 of the cone", push)
    return replace(scene, ours=(*ROUGH, ("rk4", "exact", "tangent")))


def blocks() -> dict[str, Callable[[], Scene]]:
    """Return the friction scenes: sticking, breaking away, sliding and being pushed to and fro."""
    n = 25
    t = HOLD * np.arange(n)
    one = np.ones(n)
    return {
        "stick": stick,
        "breakaway": lambda: block("breakaway", "Block that breaks away, 1.2 of the cone", 1.2 * BLOCK_FRICTION * one),
        "slide": lambda: block("slide", "Block that slides, 2 of the cone", 2.0 * BLOCK_FRICTION * one),
        "reversal": lambda: block(
            "reversal", "Block pushed to and fro", 1.6 * BLOCK_FRICTION * np.sin(2 * np.pi * 4.0 * t)
        ),
    }


SCENES: dict[str, Callable[[], Scene]] = {
    "humanoid": humanoid,
    "tumble": tumble,
    "four_bar": four_bar,
    "tello": tello,
    "belt_leg": belt_leg,
    "stiff_1e3": lambda: stiff_leg(1e3),
    "stiff_1e4": lambda: stiff_leg(1e4),
    "stiff_1e5": lambda: stiff_leg(1e5),
    "drop_3cm": lambda: drop(0.03, 0.3),
    "drop_30cm": lambda: drop(0.3, 0.5),
    "drop_100cm": lambda: drop(1.0, 0.7),
    "trot": trot,
    **blocks(),
}
"""All scenes, made when called for."""


def unbounded(robot: Robot) -> Robot:
    """Return a robot without limits of joints and torques, and without shapes: limits are events of their own."""
    bodies = tuple(
        replace(body, shapes=(), joint=replace(body.joint, position=(-np.inf, np.inf), torque=np.inf))
        for body in robot.bodies
    )
    return replace(robot, bodies=bodies)


def _on_feet(name: str) -> Robot:
    """Return a robot that only its feet keep above the ground, with limited torques but free joints."""
    robot = bare(load_robot(name), "foot")
    bodies = tuple(replace(body, joint=replace(body.joint, position=(-np.inf, np.inf))) for body in robot.bodies)
    return replace(robot, bodies=bodies, material=replace(robot.material, slip_speed=SLIP_SPEED))


def _driven(name: str, title: str, robot: Robot, duration: float, torque: float, ours: tuple[Way, ...]) -> Scene:
    """Start at rest in the standing pose; every joint has a frequency between 1 and 3 Hz and a phase of its own."""
    model = Model(robot)
    n, t = len(model.joint_links), HOLD * np.arange(round(duration / HOLD))[:, None]
    share = np.arange(n) / max(1, n - 1)
    drive = torque * np.sin(2 * np.pi * (1.0 + 2.0 * share) * t + 2.4 * np.arange(n))
    return Scene(name, title, robot, model.standing_q.copy(), np.zeros(model.nv), drive, ours=ours)


def _diagonal(x: float, y: float, z: float) -> Mat3:
    return (x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)
