"""`actuator_matrix` where motors are not one to a joint: on dependent joints of loops, and more motors than freedoms.

Velocities of actuators are checked against differences of their positions, forces against the work that they do.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from linkages import four_bar, rod_leg

from ce_gym.dynamics import Model
from ce_gym.model import Pose, Robot, assets_folder, load_robot
from ce_gym.model.mechanism import LEVELS

DRIVEN_AT_THE_ROCKER = """\
urdf: four_bar.urdf
base: fixed
rotors:
  rocker_rotor:
    parent: world
    xyz: [1, 0, 0]
    axis: [0, 0, -1]
    mass: 0.1
    inertia: [1e-4, 0, 0, 1e-4, 0, 2e-4]
    ratios: {link3: -8}
  crank_rotor:
    parent: world
    xyz: [0, 0, 0]
    axis: [0, 0, 1]
    mass: 0.1
    inertia: [1e-4, 0, 0, 1e-4, 0, 2e-4]
    ratios: {link1: 6}
constraints:
  - {name: pin, type: loop, joint: revolute, axis: [0, 0, 1],
     first: {body: link2, xyz: [0.9, 0, 0]}, second: {body: link3, xyz: [0.4, 0, 0]}}
independent: [link1]
motors: {rocker_rotor: {torque: 3}, crank_rotor: {torque: 2}}
pose: {joints: {link1: 1.2}}
assembly: {link2: -0.9, link3: 1.8}
gains: {kp: 20, kd: 2}
gravity: [1.5, -9, 0]
"""


@pytest.fixture
def two_motors(tmp_path: Path) -> Robot:
    """A four-bar, no parallelogram, with a motor at the rocker and another at the crank: two for one freedom."""
    shutil.copy(assets_folder() / "four_bar" / "four_bar.urdf", tmp_path)
    (tmp_path / "linkage.yaml").write_text(DRIVEN_AT_THE_ROCKER, encoding="utf-8")
    return load_robot(tmp_path / "linkage.yaml")


def states(model: Model, count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    q = model.standing_q + rng.uniform(-0.2, 0.2, (count, model.nq))
    if model.robot.floating:
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    return q, rng.normal(0, 2, (count, model.nv))


def positions(model: Model, q: np.ndarray, names: list[str]) -> np.ndarray:
    """Positions of joints, shape (..., n)."""
    q_span, _ = model.spanning(q, np.zeros((*q.shape[:-1], model.nv)))
    return q_span[..., [7 * model.robot.floating + model.spanning_names.index(name) for name in names]]


def assert_rates(model: Model, names: list[str]) -> None:
    """`W v` is how fast the actuators turn, whichever way the base moves."""
    q, v = states(model)
    W, h = model.actuator_matrix(q, names), 1e-5
    base = (7, 6) if model.robot.floating else (0, 0)
    step = np.zeros_like(q)
    step[:, base[0] :] = h * v[:, base[1] :]
    turning = (positions(model, q + step, names) - positions(model, q - step, names)) / (2 * h)
    rates = np.einsum("kij,kj->ki", W, v)
    np.testing.assert_allclose(rates, turning, rtol=1e-7, atol=1e-7 * np.abs(rates).max())


def assert_power(model: Model, names: list[str]) -> None:
    """Without gravity, efforts through `W^T` raise the kinetic energy by effort times actuator velocity."""
    model = Model(replace(model.robot, gravity=(0.0, 0.0, 0.0)), model.transmission)
    for q, v in zip(*states(model), strict=True):
        effort, W, h = np.random.default_rng(2).normal(0, 5, len(names)), model.actuator_matrix(q, names), 1e-6
        vdot = model.forward_dynamics(q, v, W.T @ effort)
        energies = [model.energy(q + h * s * v, v + h * s * vdot)[0] for s in (1, -1)]
        power = effort @ (W @ v)
        assert (energies[0] - energies[1]) / (2 * h) == pytest.approx(power, rel=1e-5, abs=1e-5 * energies[0])


@pytest.mark.parametrize("level", LEVELS)
def test_two_motors_on_one_freedom(two_motors: Robot, level: str):
    model = Model(two_motors, level)
    names = ["rocker_rotor", "crank_rotor"]
    q, _ = states(model)
    W = model.actuator_matrix(q)
    assert W.shape == (5, 2, 1)
    np.testing.assert_array_equal(W, model.actuator_matrix(q, names), "the motors of the file, in its order")
    np.testing.assert_allclose(W, Model(two_motors).actuator_matrix(q), rtol=1e-12)
    np.testing.assert_allclose(W[:, 1, 0], 6.0)
    assert np.ptp(W[:, 0, 0]) > 0.5, "how fast the rocker turns depends on the pose"
    assert_rates(model, names)
    assert_power(model, names)
    opposed = np.stack([W[:, 1, 0], -W[:, 0, 0]], axis=-1)  # the motors work against each other
    tau = np.einsum("kij,ki->kj", W, opposed)
    np.testing.assert_allclose(tau, 0.0, atol=1e-12)


def test_driven_at_a_dependent_joint(two_motors: Robot):
    """A torque on the rocker's motor, given through `W^T`, is that torque where the motor is the coordinate."""
    crank = Model(two_motors)
    q, v = states(crank)
    effort = np.random.default_rng(3).normal(0, 1, (len(q), 1))
    tau = np.einsum("kij,ki->kj", crank.actuator_matrix(q, ["rocker_rotor"]), effort)
    expected = crank.spanning_acceleration(q, v, crank.forward_dynamics(q, v, tau))
    at = dict(zip(crank.spanning_names, crank.spanning(crank.standing_q, np.zeros(1))[0], strict=True))
    for name, ratio in (("rocker_rotor", 1.0), ("link3", -8.0)):
        rest = tuple((joint, angle) for joint, angle in at.items() if joint != name)
        pose = Pose(joints=((name, at[name]),))
        gains = replace(two_motors.gains, kp=((name, 1.0),), kd=((name, 0.0),))
        model = Model(replace(two_motors, independent=(name,), pose=pose, assembly=rest, gains=gains))
        same_q, same_v = model.from_spanning(*crank.spanning(q, v))
        vdot = model.forward_dynamics(same_q, same_v, ratio * effort)
        np.testing.assert_allclose(model.spanning_acceleration(same_q, same_v, vdot), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["tello", "planar_leg_linkage", "six_bar", "made_four_bar", "made_rod_leg"])
@pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")
def test_any_joint_may_be_driven(name: str):
    """Every joint with a motor, dependent, independent and rotor: more actuators than freedoms."""
    made = {"made_four_bar": four_bar, "made_rod_leg": rod_leg}
    model = Model(made[name]() if name in made else load_robot(name))
    names = list(model.spanning_names)
    assert_rates(model, names)
    W = model.actuator_matrix(model.standing_q, names)
    base = 6 * model.robot.floating
    np.testing.assert_array_equal(W[:, :base], 0.0, "no effort between bodies pushes the base by itself")
    own = [names.index(joint) for joint in model.joint_links]
    np.testing.assert_allclose(W[own][:, base:], np.eye(len(own)), atol=1e-12)
    if not base:
        assert_power(model, names)


def test_motors_of_the_legs_determine_their_joints():
    """A robot with as many motors as joints, no motor at a joint: torques can be mapped both ways."""
    model = Model("tello")
    q, v = states(model)
    W = model.actuator_matrix(q)[..., 6:]
    assert W.shape == (5, 10, 10)
    tau = np.random.default_rng(4).normal(0, 10, (5, 10))
    effort = np.linalg.solve(np.swapaxes(W, -1, -2), tau[..., None])[..., 0]
    rates = np.einsum("kij,kj->ki", W, v[:, 6:])
    np.testing.assert_allclose((effort * rates).sum(1), (tau * v[:, 6:]).sum(1), rtol=1e-10)
    assert np.linalg.cond(W).max() < 20


def test_unknown_actuators_are_named(two_motors: Robot):
    model = Model(two_motors)
    with pytest.raises(ValueError, match="actuated='link9'; expected the name of a body with a joint of"):
        model.actuator_matrix(model.standing_q, ["link9"])
    assert model.actuator_matrix(model.standing_q, []).shape == (0, 1)
