"""Stops of joints: how far weight and throws bend them, whatever the effort, mass, gears and length of the step."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

import ce_gym
from ce_gym.dynamics.forces.stops import LIMIT_FREQUENCY, stop_springs
from ce_gym.model import Body, ContactSphere, Inertial, Joint, LinearConstraint, Placement, Robot

STILL = (0.0, 0.0, 0.0)
ENDLESS = (-math.inf, math.inf)


def inertial(mass: float, com=STILL, moment: float = 0.01) -> Inertial:
    rows = np.diag([moment, 1.3 * moment, 1.6 * moment]).tolist()
    return Inertial(mass, com, (tuple(rows[0]), tuple(rows[1]), tuple(rows[2])))


def arm(kind: Literal["revolute", "prismatic"], mass: float, length: float, torque: float) -> Robot:
    joint = Joint(kind, (0.0, 1.0, 0.0) if kind == "revolute" else (0.0, 0.0, 1.0), (-0.1, 0.1), torque)
    body = Body(
        "arm", "link", None, Placement(), joint, inertial(mass, (length, 0.3 * length, 0.0), 0.1 * mass * length**2)
    )
    return Robot("arm", (body,), independent=("arm",))


def simulator(robot: Robot, dt: float, **options) -> ce_gym.Simulator:
    outputs = ("energy",)
    return ce_gym.Simulator(ce_gym.Model(robot), dt=dt, control="torque", contacts=(), outputs=outputs, **options)


@pytest.mark.parametrize("dt", [0.002, 0.02])
@pytest.mark.parametrize(("mass", "length"), [(0.1, 0.05), (2.0, 0.02), (100.0, 0.8)])
@pytest.mark.parametrize(
    ("kind", "torque", "sag"),
    [("revolute", 0.5, 0.01), ("revolute", 0.0, 0.01), ("prismatic", math.inf, 0.005), ("prismatic", 1.0, 0.005)],
)
def test_weight_rests_on_a_stop(
    kind: Literal["revolute", "prismatic"], torque: float, sag: float, mass: float, length: float, dt: float
):
    """Released or thrown, it comes to rest where the stop's stiffness carries the weight."""
    sim, n = simulator(arm(kind, mass, length, torque), dt), round(3.0 / dt)
    stiffness, _ = stop_springs(sim.model.mechanism)["arm"]
    for speed in (0.0, 5.0):
        sim.set_state([0.0], [speed])
        sim.step([0.0], n)
        beyond = abs(sim.q[0, 0]) - 0.1
        lever = 1.0 if kind == "prismatic" else length * math.cos(beyond + 0.1)
        assert 0 < beyond < sag
        assert beyond == pytest.approx(mass * 9.81 * lever / float(stiffness), rel=1e-3)
        assert abs(sim.v[0, 0]) < 1e-6


@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_a_ball_joint_holds_weight(dt: float):
    joint = Joint("ball", position=(-math.inf, 0.3), damping=2.0)
    body = Body("arm", "link", None, Placement(), joint, inertial(3.0, (0.4, 0.2, 0.0), 0.02))
    sim = simulator(Robot("ball", (body,)), dt)
    sim.step(np.zeros(0), round(5.0 / dt))
    assert 0 < 2 * math.acos(abs(sim.q[0, 0])) - 0.3 < 0.01


@pytest.mark.parametrize("dt", [0.0005, 0.005, 0.02])
def test_a_throw_is_caught(dt: float):
    """No deeper than a spring at half of critical damping lets it, `w / w0 e^(-pi / sqrt 27)`; energy never grows."""
    sim = simulator(replace(arm("revolute", 2.0, 0.5, 1.0), gravity=STILL), dt)
    sim.set_state([0.0], [10.0])
    deepest, energy = 0.0, sim.model.energy([0.0], [10.0])[0].sum()
    for _ in range(round(0.3 / dt)):
        sim.step([0.0])
        deepest = max(deepest, sim.q[0, 0] - 0.1)
        assert sim.energy.sum() <= energy + 1e-9
        energy = sim.energy.sum()
    assert deepest < 10.0 / LIMIT_FREQUENCY * math.exp(-math.pi / math.sqrt(27)) * 1.01
    assert abs(sim.v[0, 0]) < 3.0


def test_a_stop_that_is_stiff_enough_stays_as_it_is():
    """Of full torque at 0.02 rad, as a motor of 400 N m has for an arm of 1 kg."""
    model = ce_gym.Model(arm("revolute", 1.0, 0.2, 400.0))
    assert stop_springs(model.mechanism)["arm"] == (20000.0, 20000.0 / LIMIT_FREQUENCY)


def test_all_that_hangs_on_a_joint_counts():
    """Two links outstretched, the further one heavier, on an axis that does not go through their centres of mass."""
    near = replace(arm("revolute", 0.5, 0.3, 1.0).bodies[0], name="near")
    far = Body(
        "far",
        "link",
        "near",
        Placement((0.6, 0.0, 0.1)),
        replace(near.joint, torque=0.2),
        inertial(8.0, (0.5, 0.1, -0.2)),
    )
    sim = simulator(Robot("two", (near, far), independent=("near", "far")), 0.005)
    sim.step(np.zeros(2), 1000)
    beyond = np.abs(sim.q[0]) - 0.1
    assert 0 < beyond.min() <= beyond.max() < 0.01
    assert np.abs(sim.v).max() < 1e-9


@pytest.mark.parametrize("ratio", [5.0, -1.0, 0.25])
@pytest.mark.parametrize("stopped", ["crank", "arm"])
def test_weight_comes_through_gears(ratio: float, stopped: str):
    """Whichever joint has the stop, of a light crank and a heavy arm that follows it."""
    heavy = arm("revolute", 4.0, 0.5, 1.0).bodies[0]
    crank = Body(
        "crank", "link", None, Placement((0.0, 0.4, 0.0)), replace(heavy.joint, torque=0.1), inertial(0.05, moment=1e-5)
    )
    bodies = [
        body if body.name == stopped else replace(body, joint=replace(body.joint, position=ENDLESS))
        for body in (crank, heavy)
    ]
    gear = LinearConstraint("gear", (("arm", 1.0), ("crank", -ratio)))
    sim = simulator(Robot("geared", tuple(bodies), (gear,), independent=("crank",)), 0.002)
    sim.step(np.zeros(1), 2000)
    turned = abs(sim.q[0, 0]) * (1.0 if stopped == "crank" else abs(ratio))
    assert 0 < turned - 0.1 < 0.01


@pytest.mark.parametrize(("ballast", "gravity"), [(0.0, 9.81), (30.0, 9.81), (-1.5, 9.81)])
def test_ballast_and_a_description_without_gravity(ballast: float, gravity: float):
    robot = replace(arm("revolute", 2.0, 0.5, 1.0), gravity=STILL)
    sim = simulator(robot, 0.002, parameters=("added_mass:arm", "gravity"))
    sim.set_parameter("added_mass:arm", [[ballast]])
    sim.set_parameter("gravity", [[0.0, 0.0, -gravity]])
    sim.step([0.0], 3000)
    assert 0 < abs(sim.q[0, 0]) - 0.1 < 0.01


def test_a_floating_robot_may_rest_on_one_limb():
    """All of its weight at the farthest contact sphere; a limb without contact spheres carries itself."""
    trunk = Body("trunk", "link", None, Placement(), Joint("free"), inertial(20.0, moment=0.5))
    joint = Joint("revolute", (0.0, 1.0, 0.0), (-1.0, 1.0), 1.0)
    limbs = [
        Body(name, "link", "trunk", Placement((x, 0.0, 0.0)), joint, inertial(0.5, (0.0, 0.0, -0.2), 0.002))
        for name, x in (("leg", -0.3), ("tail", 0.3))
    ]
    contacts = (ContactSphere("foot", "leg", (0.0, 0.05, -0.4), 0.02),)
    robot = Robot("hopper", (trunk, *limbs), independent=("leg", "tail"), contacts=contacts)
    springs = stop_springs(ce_gym.Model(robot).mechanism)
    assert springs["leg"][0] == pytest.approx(21.0 * 9.81 * 0.42 / 0.01)
    own = max(0.5 * 9.81 * 0.2 / 0.01, (0.5 * 0.2**2 + 1.3 * 0.002) * LIMIT_FREQUENCY**2)
    assert springs["tail"][0] == pytest.approx(own)


@pytest.mark.parametrize("name", ["cassie", "tello", "dr_legs", "g1"])
def test_stops_are_the_same_at_every_level(name: str):
    springs = [stop_springs(ce_gym.Model(name, level).mechanism) for level in ("exact", "none")]
    assert springs[0] == springs[1]
