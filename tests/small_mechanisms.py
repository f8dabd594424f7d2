"""Small mechanisms for the tests of stability: blocks, balls, pendulums, chains and linkages, and how to run them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.model import (
    Body,
    ContactMaterial,
    ContactSphere,
    Inertial,
    Joint,
    LinearConstraint,
    LoopConstraint,
    Placement,
    Pose,
    Robot,
)
from ce_gym.sim import Simulator

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Moments = tuple[float, ...]
"""Three of them."""

GRAVITY = 9.81
GROUND = ContactMaterial(stiffness=5e4, damping=300.0, friction=0.5)
"""Of the scenes that name no other."""


def inertial(mass: float, moments: Moments, com: Vector = (0.0, 0.0, 0.0)) -> Inertial:
    """Return mass [kg], centre [m] and principal moments about it [kg m^2]."""
    a, b, c = moments
    return Inertial(mass, com, ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c)))


def free_body(mass: float = 2.0, moments: Moments = (0.02, 0.03, 0.04), **more: Any) -> Robot:
    """Return one body; without weight unless `gravity` says otherwise."""
    body = Body("body", "link", None, Placement(), Joint("free"), inertial(mass, moments))
    options: dict[str, Any] = {"gravity": (0.0, 0.0, 0.0)} | more
    return Robot("body", (body,), **options)


def block(tilt: float = 0.0, pull: float = 0.0, mass: float = 10.0, **material) -> Robot:
    """Return a block of 0.2 m x 0.2 m x 0.1 m on spheres at its corners.

    Args:
        tilt: Slope of the ground [rad]; gravity is turned, the ground stays level.
        pull: Additional horizontal acceleration, as by a force at the centre of mass [m/s^2].
        mass: [kg].
        material: Figures of the ground that differ from GROUND.
    """
    corners = [(x, y, -0.04) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
    spheres = tuple(ContactSphere(f"corner_{i}", "body", corner, 0.01) for i, corner in enumerate(corners))
    gravity = (GRAVITY * math.sin(tilt) + pull, 0.0, -GRAVITY * math.cos(tilt))
    ground = ContactMaterial(**(vars(GROUND) | material))
    pose = Pose(height=0.05)
    moments = tuple(mass * m for m in (0.05**2 / 3 + 0.1**2 / 3, 0.05**2 / 3 + 0.1**2 / 3, 2 * 0.1**2 / 3))
    return free_body(mass, moments, gravity=gravity, contacts=spheres, material=ground, pose=pose)


def ball(radius: float = 0.1, mass: float = 1.0, tilt: float = 0.0) -> Robot:
    """Return a solid ball on a slope [rad]."""
    moment, spheres = 0.4 * mass * radius**2, (ContactSphere("ball", "body", (0.0, 0.0, 0.0), radius),)
    gravity = (GRAVITY * math.sin(tilt), 0.0, -GRAVITY * math.cos(tilt))
    pose = Pose(height=radius)
    return free_body(mass, (moment,) * 3, gravity=gravity, contacts=spheres, material=GROUND, pose=pose)


def egg(tilt: float) -> Robot:
    """Return an elongated body on a slope [rad], six spheres for its surface: half axes 0.15 m, 0.1 m, 0.075 m."""
    axes = {"x": (0.15, 0.0, 0.0), "y": (0.0, 0.1, 0.0), "z": (0.0, 0.0, 0.075)}
    spheres = tuple(
        ContactSphere(f"{name}{side:+.0f}", "body", tuple(side * (1 - 0.05 / max(at)) * x for x in at), 0.05)  # type: ignore[arg-type]
        for name, at in axes.items()
        for side in (-1.0, 1.0)
    )
    gravity = (GRAVITY * math.sin(tilt), 0.0, -GRAVITY * math.cos(tilt))
    moments = (0.2 * (0.1**2 + 0.075**2), 0.2 * (0.15**2 + 0.075**2), 0.2 * (0.15**2 + 0.1**2))
    return free_body(1.0, moments, gravity=gravity, contacts=spheres, material=GROUND, pose=Pose(height=0.075))


def chain(n: int, mass_ratio: float = 1.0) -> Robot:
    """Return a hanging chain of `n` rods of 0.1 m; each weighs `mass_ratio` times the one before it."""
    bodies, parent, at, mass = [], None, (0.0, 0.0, 0.0), 1.0
    for i in range(n):
        figures = inertial(mass, (mass * 1e-3, mass * 1e-3, mass * 1e-5), (0.0, 0.0, -0.05))
        axis = (0.0, 1.0, 0.0) if i % 2 else (1.0, 0.0, 0.0)
        bodies.append(Body(f"link_{i}", "link", parent, Placement(at), Joint("revolute", axis), figures))
        parent, at, mass = f"link_{i}", (0.0, 0.0, -0.1), mass * mass_ratio
    return Robot("chain", tuple(bodies), independent=tuple(body.name for body in bodies))


def geared_pendulum(ratio: float) -> Robot:
    """Return a pendulum of 1 kg at 0.5 m with a rotor of 1e-5 kg m^2 behind a gear."""
    bar = Body(
        "bar",
        "link",
        None,
        Placement(),
        Joint("revolute", (0.0, 1.0, 0.0)),
        inertial(1.0, (1e-3,) * 3, (0.0, 0.0, -0.5)),
    )
    spin = Joint("revolute", (0.0, 1.0, 0.0))
    rotor = Body("rotor", "rotor", None, Placement(), spin, inertial(0.1, (1e-5, 1e-5, 1e-5)))
    gear = LinearConstraint("gear", (("rotor", 1.0), ("bar", -ratio)))
    return Robot("pendulum", (bar, rotor), (gear,), ("bar",))


def leg_with_light_foot(foot: float) -> Robot:
    """Return a block of 2 kg on one leg whose foot of `foot` [kg] slides on a vertical rail below it."""
    trunk = Body("trunk", "link", None, Placement(), Joint("prismatic", (0.0, 0.0, 1.0)), inertial(2.0, (0.01,) * 3))
    slide = Joint("prismatic", (0.0, 0.0, 1.0))
    shoe = Body("foot", "link", "trunk", Placement((0.0, 0.0, -0.2)), slide, inertial(foot, (1e-6,) * 3))
    sphere = ContactSphere("sole", "foot", (0.0, 0.0, 0.0), 0.01)
    ground = ContactMaterial(stiffness=1e6, damping=1e4, friction=0.5)
    return Robot("hopper", (trunk, shoe), (), ("trunk", "foot"), contacts=(sphere,), material=ground)


def four_bar(crank: float, ground: float, coupler: float, rocker: float, damping: float = 0.0) -> Robot:
    """Return a planar four-bar linkage in the horizontal plane, driven at its crank, lengths in [m]."""

    def link(name: str, parent: str | None, at: float, length: float, drag: float = 0.0) -> Body:
        mass = 2.0 * length
        figures = inertial(mass, (mass * length**2 / 12,) * 3, (length / 2, 0.0, 0.0))
        return Body(
            name, "link", parent, Placement((at, 0.0, 0.0)), Joint("revolute", (0.0, 0.0, 1.0), damping=drag), figures
        )

    bodies = (
        link("crank", None, 0.0, crank, damping),
        link("coupler", "crank", crank, coupler),
        link("rocker", None, ground, rocker),
    )
    pin = LoopConstraint(
        "pin", "revolute", "coupler", "rocker", Placement((coupler, 0.0, 0.0)), Placement((rocker, 0.0, 0.0))
    )
    return Robot(
        "linkage",
        bodies,
        (pin,),
        ("crank",),
        pose=Pose(joints=(("crank", 0.7),)),
        assembly=(("coupler", 0.3), ("rocker", 1.5)),
    )


def simulator(robot: Robot, dt: float, n: int = 1, **options) -> Simulator:
    """Return a simulator of `n` robots that take torques."""
    return Simulator(Model(robot), n, dt, **({"control": "torque", "outputs": ("energy",)} | options))
