"""Control at the motors: behind single gears the same as at the joints, mapped through belts and rods elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Simulator
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.motor_control import standing_motors
from ce_gym.dynamics.forces.scene import StepOptions, target_names
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model.mechanism import LEVELS

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

MOMENT = 1e-12
"""A step so short that what happens in it does not matter [s]."""


def joint_torque(model: Model, control: str, q, v, target, dt: float = MOMENT, motors: str = "ideal") -> np.ndarray:
    """Joint torques that a control asks of a robot in the air."""
    options = StepOptions(dt, control=control, motors=motors)  # type: ignore[arg-type]
    function = step_function(model.mechanism, options, ("torque",))
    guess = {"dependent": model.dependent_guess(q)} if "dependent" in function.name_in() else {}
    return function(q=q, v=v, diverged=0.0, target=target, **guess)["torque"].full().ravel()


def state(model: Model, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = model.standing_q.copy()
    q[7:] += rng.uniform(-0.1, 0.1, len(q) - 7)
    return q, rng.normal(0, 1.0, model.nv)


def rotor_angles(model: Model, q) -> np.ndarray:
    spanning = dict(zip(model.spanning_names, model.spanning(q, np.zeros(model.nv))[0][7:], strict=True))
    return np.array([spanning[motor.rotor] for motor in model.robot.motors])


@pytest.mark.parametrize("motors", ["ideal", "limited"])
@pytest.mark.parametrize("level", ["exact", "armature"])
def test_behind_single_gears_both_controls_are_the_same(level: str, motors: str):
    """Half a second of waving on the ground, with some targets beyond the limits of the motors."""
    model = Model(TRIPOD, level)
    ratio = model.actuator_matrix(model.standing_q)[:, 6:]
    assert (np.count_nonzero(ratio, axis=1) == 1).all()
    for joint, motor in (("position", "motor_position"), ("torque", "motor_torque")):
        sims = [Simulator(model, 3, contacts="foot", control=c, motors=motors) for c in (joint, motor)]
        for k in range(25):
            target = np.random.default_rng(k).normal(0, 0.6, (3, 2))
            if joint == "position":
                target += model.standing_q[7:]
                sims[0].step(target, 4)
                sims[1].step(target @ ratio.T, 4)
            else:
                sims[0].step(10 * target, 4)
                sims[1].step(10 * target @ np.linalg.inv(ratio), 4)
        assert np.abs(sims[0].v).max() > 0.5
        np.testing.assert_allclose(sims[1].q, sims[0].q, atol=1e-8)
        np.testing.assert_allclose(sims[1].v, sims[0].v, atol=1e-6)


@pytest.mark.parametrize("name", ["tello", "jvrc1"])
def test_motor_torques_reach_the_joints_by_virtual_work(name: str):
    """`tau = W^T tau_m`, each motor limited by itself, at every level alike."""
    for level in LEVELS:
        model = Model(name, level)
        q, v = state(model)
        W, limits = model.actuator_matrix(q)[:, 6:], np.array([m.torque for m in model.robot.motors])
        names = target_names(model.mechanism, "motor_torque")
        assert names[: len(limits)] == tuple(motor.rotor for motor in model.robot.motors)
        asked = np.random.default_rng(1).uniform(-1.5, 1.5, len(limits)) * limits
        target = np.zeros(len(names))
        target[: len(limits)] = asked
        got = joint_torque(model, "motor_torque", q, v, target)
        np.testing.assert_allclose(got, W.T @ np.clip(asked, -limits, limits), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["mit_humanoid", "tello"])
def test_motor_position_is_a_loop_of_each_motor(name: str):
    """`tau = W^T (kp_m (target - theta) - kd_m thetad)`, gains reflected in the standing pose."""
    model = Model(name)
    robot, n = model.robot, len(model.joint_links)
    kp, kd = (np.array([dict(g)[joint] for joint in robot.independent]) for g in (robot.gains.kp, robot.gains.kd))
    back = np.linalg.inv(model.actuator_matrix(model.standing_q)[:, 6:])
    kp_m, kd_m = (np.diag(back.T @ np.diag(gain) @ back) for gain in (kp, kd))
    q, v = state(model)
    W = model.actuator_matrix(q)[:, 6:]
    # Small errors, within all limits; a step of no length has no implicit terms.
    goal = q.copy()
    goal[7:] += np.random.default_rng(2).uniform(-0.02, 0.02, n)
    v[:] *= 0.01
    target = rotor_angles(model, goal)
    expected = W.T @ (kp_m * (target - rotor_angles(model, q)) - kd_m * (W @ v[6:]))
    got = joint_torque(model, "motor_position", q, v, target)
    np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-8)
    at_joints = joint_torque(model, "position", q, v, goal[7:])
    assert np.abs(got - at_joints).max() > 0.05 * np.abs(at_joints).max()


def test_joints_without_motors_are_controlled_as_joints():
    model = Model("jvrc1")
    names = target_names(model.mechanism, "motor_position")
    free = names[len(model.robot.motors) :]
    assert set(free) == {j for j in model.joint_links if "wrist" in j or "neck" in j}
    q, v = state(model)
    wrong = model.standing_q[7:] + 0.01
    target = np.concatenate([rotor_angles(model, q), [wrong[model.joint_links.index(name)] for name in free]])
    rows = [model.joint_links.index(name) for name in free]
    np.testing.assert_allclose(
        joint_torque(model, "motor_position", q, v, target)[rows], joint_torque(model, "position", q, v, wrong)[rows]
    )


def test_loops_stay_stable_at_coarse_steps():
    """Stiff terms are implicit here too: Tello in the air holds its pose at 10 ms."""
    model = Model("tello")
    robot = replace(model.robot, gravity=(0.0, 0.0, 0.0))
    model = Model(robot)
    sim = Simulator(model, control="motor_position", contacts=(), dt=0.01, outputs=("energy",))
    q = model.standing_q.copy()
    q[7:] += np.random.default_rng(0).uniform(-0.1, 0.1, 10)
    sim.set_state(q, np.zeros(model.nv))
    sim.step([standing_motors(model.mechanism)[name][0] for name in sim.target_names], 300)
    assert not sim.diverged.any()
    np.testing.assert_allclose(sim.q[0, 7:], model.standing_q[7:], atol=1e-3)
    assert np.abs(sim.v[0, 6:]).max() < 1e-3


def test_energy_knows_the_springs_at_the_motors():
    """Damped by its own loops alone a robot in the air loses energy, spring energy included."""
    model = Model(replace(Model("tello").robot, gravity=(0.0, 0.0, 0.0)))
    sim = Simulator(model, control="motor_position", contacts=(), dt=0.001, outputs=("energy",))
    q = model.standing_q.copy()
    q[7:] += np.random.default_rng(0).uniform(-0.05, 0.05, 10)
    sim.set_state(q, np.zeros(model.nv))
    target, energies = [standing_motors(model.mechanism)[name][0] for name in sim.target_names], []
    for _ in range(100):
        sim.step(target)
        energies.append(sim.energy[0])
    assert energies[0] > 0.05
    assert energies[-1] < 0.2 * energies[0]
    assert np.diff(energies).max() < 1e-3 * energies[0]
