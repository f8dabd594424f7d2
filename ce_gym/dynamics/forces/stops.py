"""Stops of joints: one-sided springs and dampers at the ends of their ranges, taken one step ahead."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, reduce

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.standing import standing_pose
from ce_gym.model.description import Body
from ce_gym.model.frames import Vec3, added
from ce_gym.model.mechanism import Mechanism

LIMIT_FREQUENCY = 2 * math.pi * 20.0
"""Stiffness over damping of a soft joint limit [1/s]; the stop relaxes in the inverse of it, 8 ms."""
SAG_TURNING, SAG_SLIDING = 0.01, 0.005
"""How far weight may bend the stops of revolute and ball joints [rad], and of prismatic ones [m]."""
STANDARD_GRAVITY = 9.81
"""Least gravity that stops are made for [m/s^2]: descriptions may have none."""
SMALLEST_RATIO = 0.1
"""Least ratio by which a stop of a dependent joint is made to hold what the joint follows [-]."""
DIGITS = 9
"""Decimals of levers and ratios, so that stops have the same bits on every machine."""


def stop_force(
    y: SX, yd: SX, limits: tuple[float, float], stiffness: SX | float, damping: SX | float, dt: float
) -> tuple[SX, SX]:
    """Return the force of the stops of a joint at zero acceleration, and its slope, see `JointForce`.

    The stop of a joint beyond its range acts while it pushes, `k d - c v > 0`, the force at the end of the last step.
    So the stop still acts on a joint that it has just turned back; otherwise the load would push the joint into the
    stop at every other step. The stop of a joint within its range acts if the joint is beyond it after the step.
    """
    tau, total, slope = SX(0), SX(0), damping + dt * stiffness
    for bound, side in ((limits[0], 1.0), (limits[1], -1.0)):
        if math.isinf(bound):
            continue
        depth, speed = side * (bound - y), side * yd
        active = ca.if_else(depth > 0, stiffness * depth - damping * speed > 0, depth - dt * speed > 0)
        push = stiffness * depth - slope * speed
        tau, total = tau + side * ca.if_else(active, push, 0), total + ca.if_else(active, dt * slope, 0)
    return tau, total


def stop_energy(mechanism: Mechanism, name: str, angle: SX) -> SX:
    """Return the energy of the stops of a joint with one coordinate, at an angle [rad] or a displacement [m], in J."""
    (low, high), beyond = mechanism.robot.body(name).joint.position, SX(0)
    for bound, side in ((low, 1.0), (high, -1.0)):
        if math.isfinite(bound):
            beyond += ca.fmax(side * (bound - angle), 0)
    return stop_springs(mechanism)[name][0] * beyond**2 / 2


@lru_cache(maxsize=4)
def stop_springs(mechanism: Mechanism) -> dict[str, tuple[SX | float, SX | float]]:
    """Return stiffness [N m/rad or N/m] and damping [N m s/rad or N s/m] of the stops of each joint, by body.

    The stiffness is the largest of three figures:

    - the joint's full torque bends the stop by 0.02 rad or m; 1000 N m/rad where the torque is infinite or 0;
    - the weight that the joint may carry bends the stop by `SAG_TURNING` or `SAG_SLIDING`;
    - the damping is at least half of the critical one for the inertia that the joint may move.
    """
    robot, springs = mechanism.robot, {}
    for name, burden in _tied_burdens(mechanism).items():
        joint = robot.body(name).joint
        sag = SAG_SLIDING if joint.type == "prismatic" else SAG_TURNING
        by_torque = 50.0 * joint.torque if 0.0 < joint.torque < math.inf else 1e3
        stiffness = _largest(max(by_torque, burden.inertia * LIMIT_FREQUENCY**2), burden.load / sag)
        springs[name] = stiffness, stiffness / LIMIT_FREQUENCY
    return springs


@dataclass
class _Burden:
    """Load and inertia of a joint in its worst pose.

    Attributes:
        load: Torque or force of weight [N m or N].
        inertia: About or along the axis [kg m^2 or kg].
        contact: Largest lever of a contact sphere [m], or 1 along an axis; 0 without contact sphere.
    """

    load: SX | float = 0.0
    inertia: float = 0.0
    contact: float = 0.0


def _tied_burdens(mechanism: Mechanism) -> dict[str, _Burden]:
    """Return load and inertia of each joint, including those that gears and loops transmit in the standing pose."""
    robot, of_tree = mechanism.robot, _tree_burdens(mechanism)
    burdens = {name: of_tree[name] for name in robot.balls}
    ratios = {
        name: [abs(round(ratio, DIGITS)) for ratio in row[robot.layout.joints_v :].tolist()]
        for name, row in standing_pose(mechanism).G.items()
    }
    for i, name in enumerate(robot.independent):
        moved = [(row[i], of_tree[joint]) for joint, row in ratios.items() if row[i]]
        load, inertia = added(g * x.load for g, x in moved), added(g**2 * x.inertia for g, x in moved)
        burdens[name] = _Burden(load, inertia)
    for name in (name for name in ratios if name not in robot.independent):
        alone = of_tree[name]
        moving = [
            (max(g, SMALLEST_RATIO), burdens[y]) for y, g in zip(robot.independent, ratios[name], strict=True) if g
        ]
        load = reduce(_smallest, [x.load / g for g, x in moving], math.inf) if moving else alone.load
        inertia = min((x.inertia / g**2 for g, x in moving), default=alone.inertia)
        burdens[name] = _Burden(_largest(alone.load, load), inertia)
    return burdens


def _tree_burdens(mechanism: Mechanism) -> dict[str, _Burden]:
    """Return load and inertia of each joint without constraints, with the robot outstretched.

    The weight of the whole robot may rest on the farthest contact sphere beyond a joint. A joint without contact
    spheres beyond it carries the bodies beyond it.
    """
    robot, masses = mechanism.robot, _masses(mechanism)
    gravity = max(math.hypot(*robot.gravity), STANDARD_GRAVITY)
    bodies = {body.name: body for body in robot.bodies}
    burdens = {name: _Burden() for name in bodies}
    for body in robot.bodies:
        for moving, lever in _levers(bodies, body, body.inertial.com):
            burden = burdens[moving.name]
            burden.load = burden.load + gravity * masses[body.name] * lever
            burden.inertia += body.inertial.mass * lever**2 + _largest_moment(body, moving)
    for contact in robot.contacts:
        for moving, lever in _levers(bodies, bodies[contact.body], contact.position):
            size = 0.0 if moving.joint.type == "prismatic" else contact.radius + contact.rim
            burdens[moving.name].contact = max(burdens[moving.name].contact, lever + size)
    weight: SX | float = 0.0
    for mass in masses.values():
        weight = weight + gravity * mass
    for burden in burdens.values():
        burden.load = _largest(burden.load, weight * burden.contact)
    return burdens


def _levers(bodies: dict[str, Body], body: Body, point: Vec3) -> Iterator[tuple[Body, float]]:
    """Yield the body of each joint between a point and the base, with the point's largest distance from its axis [m].

    The lever is 1 for prismatic joints.
    """
    beyond = 0.0
    while body.joint.type != "free":
        joint, along = body.joint, added(a * x for a, x in zip(body.joint.axis, point, strict=True))
        across = [x - along * a for a, x in zip(joint.axis, point, strict=True)]
        lever = math.hypot(*(point if joint.type == "ball" else across)) + beyond
        yield body, 1.0 if joint.type == "prismatic" else round(lever, DIGITS)
        beyond += math.hypot(*point)
        if joint.type == "prismatic":
            beyond += max((abs(limit) for limit in joint.position if math.isfinite(limit)), default=0.0)
        if body.parent is None:
            return
        body, point = bodies[body.parent], body.placement.position


def _largest_moment(body: Body, moving: Body) -> float:
    """Return the moment of inertia of a body about its centre of mass as a joint turns it, or a bound [kg m^2]."""
    if moving.joint.type == "prismatic":
        return 0.0
    if moving is body and body.joint.type == "revolute":
        axis, rows = body.joint.axis, body.inertial.inertia
        return added(axis[i] * rows[i][j] * axis[j] for i in range(3) for j in range(3))
    return added(body.inertial.inertia[i][i] for i in range(3)) / 2


def _masses(mechanism: Mechanism) -> dict[str, SX | float]:
    """Return the mass of each body [kg], with what parameters add."""
    robot = mechanism.robot
    masses: dict[str, SX | float] = {body.name: body.inertial.mass for body in robot.bodies}
    for name, body in mechanism.bodies.items():
        if isinstance(body.inertia, SX):
            merged = [rotor for rotor in robot.rotors() if rotor.parent == name and rotor.name not in mechanism.bodies]
            masses[name] = body.inertia[5, 5] - added(rotor.inertial.mass for rotor in merged)
    return masses


def _largest(a: SX | float, b: SX | float) -> SX | float:
    return ca.fmax(a, b) if isinstance(a, SX) or isinstance(b, SX) else max(a, b)


def _smallest(a: SX | float, b: SX | float) -> SX | float:
    return ca.fmin(a, b) if isinstance(a, SX) or isinstance(b, SX) else min(a, b)
