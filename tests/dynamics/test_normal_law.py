"""Hunt and Crossley's law of contact: how fast a ball leaves, in closed form, whatever the material's damping."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from tripod import TRIPOD

import ce_gym
from ce_gym.dynamics import Model
from ce_gym.export.mujoco_twin import set_contact_material
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot
from ce_gym.model.description import Shape

INERTIA = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))


def leaving(approach: float, h: float) -> float:
    """Speed of a mass that meets `k d (1 + h ddot)`: its equation of motion, integrated over the depth by hand."""
    balance = lambda u: h * (approach + u) - np.log((1 + h * approach) / (1 - h * u))  # noqa: E731
    return float(brentq(balance, 1e-9, min(approach, (1 - 1e-12) / h)))  # type: ignore[arg-type]


def ball(damping: float, stiffness: float, dissipation: float) -> Robot:
    body = Body("ball", "link", None, Placement(), Joint("free"), Inertial(0.7, (0.0, 0.0, 0.02), INERTIA))
    contacts = (ContactSphere("ball", "ball", (0.0, 0.0, 0.0), 0.08),)
    material = ContactMaterial(stiffness, damping, dissipation=dissipation)
    return Robot("ball", (body,), contacts=contacts, material=material, gravity=(0.0, 0.0, 0.0))


@pytest.mark.parametrize("damping", [0.0, 40.0, 500.0])
@pytest.mark.parametrize(("approach", "stiffness", "h"), [(1.5, 2e4, 0.4), (0.3, 3e5, 2.0)])
def test_a_ball_leaves_the_ground(damping: float, approach: float, stiffness: float, h: float):
    model, results = Model(ball(damping, stiffness, h)), []
    for method in ("extrapolated", "adaptive"):
        options: dict[str, Any] = {"tolerance": 1e-9} if method == "adaptive" else {}
        sim = ce_gym.Simulator(model, dt=1e-5, control="torque", method=method, outputs=("energy",), **options)
        sim.set_state([0, 0, 0.0801, 1, 0, 0, 0], [0, 0, 0, 0, 0, -approach])
        before = 0.35 * approach**2
        for _ in range(30):
            sim.step(np.zeros(0), 200)
            assert sim.energy.sum() < before + 1e-9
            before = sim.energy.sum()
        results.append(sim.v[0, 5])
    np.testing.assert_allclose(results, leaving(approach, h), rtol=2e-3)


def test_links_leave_each_other():
    joint, shape = Joint("prismatic", (1.0, 0.0, 0.0)), (Shape("sphere", (0.1,)),)
    bodies = [
        Body(name, "link", None, Placement(), joint, Inertial(mass, (0.0, 0.0, 0.0), INERTIA), shape)
        for name, mass in (("left", 1.0), ("right", 3.0))
    ]
    material = ContactMaterial(4e4, dissipation=0.5)
    model = Model(Robot("pair", tuple(bodies), independent=("left", "right"), material=material))
    pairs = (("left", "right"),)
    sim = ce_gym.Simulator(
        model, dt=2e-5, method="extrapolated", control="torque", contacts=(), self_collisions=pairs, outputs=()
    )
    sim.set_state([-0.1001, 0.1001], [0.9, -0.3])
    sim.step(np.zeros(2), 2000)
    assert sim.v[0, 1] - sim.v[0, 0] == pytest.approx(leaving(1.2, 0.5), rel=2e-3)
    assert 1.0 * sim.v[0, 0] + 3.0 * sim.v[0, 1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("dt", [0.005, 0.02])
@pytest.mark.parametrize("stiffness", [1e4, 1e6])
def test_coarse_steps_lose_energy_and_come_to_rest(dt: float, stiffness: float):
    robot = replace(ball(500.0, stiffness, 0.5), gravity=(0.0, 0.0, -9.81))
    sim = ce_gym.Simulator(Model(robot), dt=dt, control="torque", outputs=("energy", "contact_forces"))
    sim.set_state([0, 0, 0.2, 1, 0, 0, 0], [0, 0, 0, 0, 0, -3.0])
    start = 0.7 * (9.0 / 2 + 9.81 * 0.22)
    for _ in range(round(2.0 / dt)):
        sim.step(np.zeros(0))
        assert sim.energy.sum() < start
    assert sim.contact_forces[0, 0, 2] == pytest.approx(0.7 * 9.81, rel=1e-9)
    assert sim.q[0, 2] == pytest.approx(0.08 - 0.7 * 9.81 / stiffness, abs=1e-9)


def test_damping_is_no_parameter_of_a_law_without_damping():
    model = Model(ball(500.0, 1e4, 0.5))
    with pytest.raises(ValueError, match="parameters='damping'; expected a material without dissipation"):
        ce_gym.Simulator(model, control="torque", parameters=("damping",))
    ce_gym.Simulator(model, control="torque", parameters=("damping",), normal_law="kelvin_voigt")


def test_the_twin_in_mujoco_is_damped_by_the_dissipation():
    """MuJoCo's spring and damper then has `c = h N` where each contact carries the force `N` of standing."""
    mujoco_model = pytest.importorskip("ce_gym.export.mujoco_model")
    robot = ce_gym.load_robot(TRIPOD)
    load = robot.total_mass * 9.81 / len(robot.contacts)
    grounds = []
    for material in (ContactMaterial(dissipation=0.5, damping=7.0), ContactMaterial(damping=0.5 * load)):
        changed = replace(robot, material=material)
        model = mujoco_model.compile_model(changed, "exact", mujoco_model.Settings(0.001))
        set_contact_material(model, changed)
        grounds.append(np.hstack([model.geom_solref, model.geom_solimp]))
    np.testing.assert_allclose(*grounds, rtol=1e-12)
