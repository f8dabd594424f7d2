"""Springs of joints: an oscillator in closed form, in and out of loops, of ball joints, in MuJoCo's words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_joints import rotation

import ce_gym
from ce_gym.model import Body, Inertial, Joint, LinearConstraint, Placement, Robot

STIFFNESS, INERTIA, MASS = 3.0, 0.02, 0.5
STILL = (0.0, 0.0, 0.0)


def wheel(name: str, **joint) -> Body:
    """A wheel about a vertical axis, or on a ball joint if that is its type."""
    figures = {"type": "revolute", **joint}
    inertia = tuple(map(tuple, np.diag([INERTIA] * 3).tolist()))
    return Body(name, "link", None, Placement(), Joint(**figures), Inertial(MASS, STILL, inertia))


def swung(robot: Robot, method: str, dt: float, q, time: float) -> ce_gym.Simulator:
    model = ce_gym.Model(robot)
    sim = ce_gym.Simulator(model, dt=dt, method=method, control="torque", contacts=(), outputs=("energy",))
    sim.set_state(q, np.zeros(model.nv))
    sim.step(np.zeros(len(robot.independent)), round(time / dt))
    return sim


def test_a_wheel_on_a_spring_is_an_oscillator():
    robot = Robot("wheel", (wheel("wheel", stiffness=STIFFNESS, springref=0.3),), independent=("wheel",))
    time, frequency = 0.7, np.sqrt(STIFFNESS / INERTIA)
    expected = 0.3 + 0.2 * np.cos(frequency * time)
    sim = swung(robot, "rk8", 0.01, [0.5], time)
    assert sim.q[0, 0] == pytest.approx(expected, abs=1e-9)
    assert sim.energy[0].sum() == pytest.approx(STIFFNESS * 0.2**2 / 2, rel=1e-8)
    errors = [abs(swung(robot, "extrapolated", dt, [0.5], time).q[0, 0] - expected) for dt in (0.002, 0.001)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.3)
    stiff = replace(robot, bodies=(wheel("wheel", stiffness=1e6, springref=0.3),))
    assert swung(stiff, "euler", 0.01, [0.5], 1.0).q[0, 0] == pytest.approx(0.3, abs=1e-6), "stable at any stiffness"


def test_a_dependent_joint_has_its_spring():
    """Geared three to one, the spring of the fast wheel is felt nine times over."""
    fast = wheel("fast", stiffness=STIFFNESS, springref=0.6)
    gear = LinearConstraint("gear", (("fast", 1.0), ("slow", -3.0)))
    robot = Robot("geared", (wheel("slow"), fast), (gear,), independent=("slow",))
    time, frequency = 0.7, np.sqrt(9 * STIFFNESS / (INERTIA + 9 * INERTIA))
    sim = swung(robot, "rk8", 0.01, [0.3], time)
    assert sim.q[0, 0] == pytest.approx(0.2 + 0.1 * np.cos(frequency * time), abs=1e-9)


def test_a_dependent_joint_is_damped():
    """Geared three to one, the friction of the fast wheel is felt nine times over."""
    damping, time = 0.02, 0.5
    gear = LinearConstraint("gear", (("fast", 1.0), ("slow", -3.0)))
    robot = Robot("damped", (wheel("slow"), wheel("fast", damping=damping)), (gear,), independent=("slow",))
    model = ce_gym.Model(robot)
    sim = ce_gym.Simulator(model, dt=0.01, method="rk8", control="torque", contacts=(), outputs=())
    sim.set_state([0.0], [2.0])
    sim.step(np.zeros(1), round(time / 0.01))
    assert sim.v[0, 0] == pytest.approx(2.0 * np.exp(-9 * damping / (10 * INERTIA) * time), rel=1e-9)


def thrown_against_stops(speed: float, slow: dict, fast: dict) -> np.ndarray:
    """Position, speed and energy of the slow wheel of two, geared three to one, in each of twenty steps."""
    gear = LinearConstraint("gear", (("fast", 1.0), ("slow", -3.0)))
    robot = Robot("geared", (wheel("slow", **slow), wheel("fast", **fast)), (gear,), independent=("slow",))
    sim, found = ce_gym.Simulator(ce_gym.Model(robot), control="torque", contacts=(), outputs=("energy",)), []
    sim.set_state([0.05], [speed])
    for _ in range(20):
        sim.step([0.0])
        found.append((sim.q[0, 0], sim.v[0, 0], sim.energy.sum()))
    return np.array(found)


def test_a_passive_joint_has_its_stops():
    """Whether its file says no torque or 0, which is what passive joints of URDF files have."""
    stop = {"position": (-0.3, 0.6)}
    found = [thrown_against_stops(2.0, {}, {**stop, "torque": torque}) for torque in (np.inf, 0.0, 20.0)]
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


@pytest.mark.parametrize(("speed", "furthest"), [(8.0, 0.2), (-8.0, -0.1)])
def test_a_dependent_joint_has_its_stops(speed: float, furthest: float):
    """A stop of the fast wheel acts on the slow one at a third of the angle, nine times as stiff."""
    at_slow = thrown_against_stops(speed, {"position": (-0.1, 0.2), "torque": 18.0}, {})
    at_fast = thrown_against_stops(speed, {}, {"position": (-0.3, 0.6), "torque": 2.0})
    np.testing.assert_allclose(at_fast, at_slow, rtol=1e-12, atol=1e-12)
    way = np.abs(at_fast[:, 0]).max()
    assert abs(furthest) < way < abs(furthest) + 0.1, "beyond, where the stop acts, and held"


def test_a_ball_joint_has_a_spring():
    robot = Robot("ball", (wheel("ball", type="ball", stiffness=STIFFNESS),))
    time, frequency, axis = 0.7, np.sqrt(STIFFNESS / INERTIA), np.array([0.6, 0.0, 0.8])
    sim = swung(robot, "rk8", 0.01, [np.cos(0.3), *(np.sin(0.3) * axis)], time)
    angle = 0.6 * np.cos(frequency * time)
    np.testing.assert_allclose(sim.q[0], [np.cos(angle / 2), *(np.sin(angle / 2) * axis)], atol=1e-8)
    np.testing.assert_allclose(rotation(sim.q[0]) @ axis, axis, atol=1e-12)


def test_springs_of_a_file_are_mujocos(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    from ce_gym.export.mjcf import to_mjcf

    fast = wheel("fast", stiffness=STIFFNESS, springref=0.6, damping=0.01)
    robot = Robot("springs", (fast, wheel("ball", type="ball", stiffness=2.0)), independent=("fast",))
    path = tmp_path / "springs.xml"
    path.write_text(to_mjcf(robot, "exact"))
    again = ce_gym.load_robot(path)
    assert [replace(body.joint, name="") for body in again.bodies] == [body.joint for body in robot.bodies]
    mj = mujoco.MjModel.from_xml_path(str(path))
    data, turn = mujoco.MjData(mj), np.array([np.cos(0.4), np.sin(0.4), 0.0, 0.0])
    data.qpos[:] = [0.1, *turn]
    mujoco.mj_forward(mj, data)
    model, dt = ce_gym.Model(again), 1e-6
    sim = ce_gym.Simulator(model, dt=dt, control="torque", contacts=(), outputs=())
    sim.set_state([*turn, 0.1], np.zeros(4))
    sim.step(np.zeros(1))
    np.testing.assert_allclose(sim.v[0] / dt, [*data.qacc[1:], data.qacc[0]], rtol=1e-6, atol=1e-6)
