"""Scenes without contact: floating robots, a tumbling box, closed loops, a leg on a fixed base, stiff control."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ce_gym.bench.accuracy.scenarios.scene import APPROXIMATE, HOLD, SMOOTH, Scene, Way, diagonal, driven, unbounded
from ce_gym.dynamics.model import Model
from ce_gym.model import Body, Elasticity, Gains, Inertial, Joint, LoopConstraint, Placement, Pose, Robot, load_robot


def humanoid() -> Scene:
    """Return a humanoid that floats without gravity while every joint is driven by a sinusoidal torque."""
    robot = unbounded(replace(load_robot("mit_humanoid"), contacts=(), gravity=(0.0, 0.0, 0.0)))
    return driven("humanoid", "Floating humanoid, sinusoidal torques", robot, 0.5, 0.7, (*SMOOTH, APPROXIMATE))


def tumble() -> Scene:
    """Return a box that spins about its middle axis and turns over (Dzhanibekov), as in MuJoCo's own test."""
    inertia = diagonal(0.02, 0.03, 0.04)
    box = Body("box", "link", None, Placement(), Joint("free"), Inertial(2.0, (0.0, 0.0, 0.0), inertia))
    robot = Robot("box", (box,), gravity=(0.0, 0.0, 0.0))
    q, v = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.05, 5.0, 0.05, 0.0, 0.0, 0.0])
    still = np.zeros((round(4.0 / HOLD), 0))
    return Scene("tumble", "Box turning over in flight", robot, q, v, still, ours=SMOOTH, levels=("none",))


def four_bar() -> Scene:
    """Return a crank and rocker (0.15, 0.30, 0.25 m on a base of 0.30 m) with 12 rad/s at the start, for two turns."""

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
    title, levels = "Four-bar, a crank and a rocker", ("exact",)
    return Scene("four_bar", title, robot, start, speed, none, ours=SMOOTH, levels=levels, reference=200)


def tello() -> Scene:
    """Return Tello's legs, floating without gravity: differentials, cranks and rods."""
    robot = unbounded(replace(load_robot("tello"), contacts=(), gravity=(0.0, 0.0, 0.0)))
    ours = (*SMOOTH, Way("euler", "coupled"))
    return replace(driven("tello", "Floating Tello, rods and differentials", robot, 0.5, 0.1, ours), levels=LOOPED)


LOOPED = ("coupled", "exact")
"""Levels of MJCF for a robot whose rotors are driven through loops."""


def belt_leg() -> Scene:
    """Return a leg with parallel belts on a fixed base, whose rotors have a large part of the momentum."""
    robot = unbounded(load_robot("mit_humanoid_leg"))
    return driven("belt_leg", "Leg with belts, sinusoidal torques", robot, 0.5, 3.0, (*SMOOTH, APPROXIMATE))


def stiff_leg(stiffness: float) -> Scene:
    """Return the leg with belts under position control with gain `stiffness` [N m/rad] and large damping."""
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


STRETCHING: dict[str, tuple[float, float]] = {
    "hip_rz_rotor": (28.0, 8e-3),
    "hip_rx_rotor": (28.0, 8e-3),
    "hip_ry_rotor": (28.0, 8e-3),
    "knee_rotor": (9.0, 5e-3),
    "ankle_rotor": (9.0, 5e-3),
}
"""Estimated stiffness [N m/rad] and damping [N m s/rad] at each rotor; no published values are known."""


def elastic_leg() -> Scene:
    """Return the leg with belts, with elastic gears and belts, driven by motor torques."""
    robot = unbounded(load_robot("mit_humanoid_leg"))
    robot = replace(robot, elastic=tuple(Elasticity(name, *figures) for name, figures in STRETCHING.items()))
    ours = tuple(replace(way, level="elastic") for way in SMOOTH)
    scene = driven("elastic", "Leg whose gears and belts stretch", robot, 0.5, 3.0, (*ours, Way("euler")))
    return replace(scene, exact="elastic", levels=("armature", "exact", "elastic"))
