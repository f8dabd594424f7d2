"""The mechanisms of the studies: one leg on a stand, robots with one contact for each foot, and limits taken away."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from ce_gym.bench.exactness.protocol import FEET, RADII, Leg
from ce_gym.model import Robot, load_robot
from ce_gym.model.description import ContactSphere
from ce_gym.model.frames import Placement


def leg_on_stand(leg: Leg) -> Robot:
    """Return a leg whose base is held where it is in the standing pose, with one contact in the middle of its sole."""
    robot = load_robot(leg.robot)
    if leg.root is not None:
        robot = limb(robot, leg.root)
    return replace(robot, contacts=(ContactSphere("sole", leg.foot, leg.point, 0.0),), tasks=())


def limb(robot: Robot, root: str) -> Robot:
    """Return the part of a robot with a floating base that begins at a body, the base held still in its standing pose.

    Rotors that are mounted on the base and drive the limb belong to it.
    """
    base = robot.bodies[0].name
    kept = {root}
    for body in robot.bodies:
        kept |= {body.name} if body.parent in kept else set()
    tied = [set(constraint.bodies) for constraint in robot.constraints]
    kept |= {name for names in tied if names & kept for name in names} - {base}
    lifted = (0.0, 0.0, robot.pose.height)
    bodies = [body for body in robot.bodies if body.name in kept]
    for i, body in enumerate(bodies):
        if body.parent == base:
            place = tuple((np.array(body.placement.position) + lifted).tolist())
            bodies[i] = replace(body, parent=None, placement=Placement(place, body.placement.rotation))
    joints = tuple(name for name in robot.independent if name in kept)
    return replace(
        robot,
        name=f"{robot.name}_{root}",
        bodies=tuple(bodies),
        constraints=tuple(c for c in robot.constraints if set(c.bodies) <= kept),
        independent=joints,
        contacts=tuple(c for c in robot.contacts if c.body in kept),
        motors=tuple(motor for motor in robot.motors if motor.rotor in kept),
        pose=replace(robot.pose, joints=_of(robot.pose.joints, kept)),
        gains=replace(robot.gains, kp=_of(robot.gains.kp, kept), kd=_of(robot.gains.kd, kept)),
        assembly=_of(robot.assembly, kept),
        tasks=(),
    )


def without_limits(robot: Robot) -> Robot:
    """Return a robot without limits and friction of joints and motors."""
    free = {"position": (-inf, inf), "torque": inf, "velocity": inf, "damping": 0.0, "friction": 0.0}
    bodies = tuple(b if b.joint.type == "free" else replace(b, joint=replace(b.joint, **free)) for b in robot.bodies)
    return replace(robot, bodies=bodies, motors=())


def on_soles(name: str) -> Robot:
    """Return a robot that touches the ground with one point in the middle of each foot, and stands on it."""
    robot, radius = load_robot(name), RADII.get(name, 0.0)
    soles = tuple(ContactSphere(f"{body}_sole", body, place, radius) for body, place in FEET[name].items())
    return replace(robot, contacts=soles, tasks=())


def _of(pairs: tuple[tuple[str, float], ...], kept: set[str]) -> tuple[tuple[str, float], ...]:
    return tuple((name, value) for name, value in pairs if name in kept)
