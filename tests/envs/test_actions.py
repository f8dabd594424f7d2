"""What actions mean: joints or motors, positions or torques, alike at every transmission level."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym  # noqa: F401 - registers the environments
from ce_gym.envs.base import spaces
from ce_gym.envs.policy_spec import policy_spec
from ce_gym.envs.runtime.setup import make_program
from ce_gym.model.mechanism import LEVELS

TELLO = "ce_gym/TelloVelocity-v0"
KINDS = ("joint_pd", "joint_torque", "motor_pd", "motor_torque")


def make(n: int = 2, env_id: str = "ce_gym/MiniCheetahVelocity-v0", robot: str = TRIPOD, **arguments):
    envs = gymnasium.make_vec(env_id, num_envs=n, autoreset_mode="SameStep", robot=robot, **arguments).unwrapped
    envs.reset(seed=0)
    return envs


@pytest.mark.parametrize("kind", ["pd", "torque"])
def test_behind_single_gears_motors_and_joints_are_the_same(kind: str):
    """Signs of ratios apart, where a torque is concerned: a motor that turns the other way takes the other action."""
    joint, motor = make(4, actions=f"joint_{kind}"), make(4, actions=f"motor_{kind}")
    program, model = motor.batch.program, motor.model
    ratio = model.actuator_matrix(model.standing_q)[:, 6:]
    order = np.argmax(np.abs(ratio), axis=1)
    sign = np.ones(2) if kind == "pd" else np.sign(ratio[np.arange(2), order])
    assert program.actions.targets == tuple(m.rotor for m in model.robot.motors)
    assert np.sign(ratio).min() == -1.0
    for k in range(15):
        action = np.random.default_rng(k).uniform(-0.6, 0.6, (4, 2)).astype(np.float32)
        joint.step(action)
        motor.step((action[:, order] * sign).astype(np.float32))
    np.testing.assert_allclose(motor.state()["q"], joint.state()["q"], atol=1e-7)
    assert np.abs(joint.state()["v"]).max() > 0.5


def test_motor_torques_go_through_the_rods():
    """On Tello, half of every motor's torque is `W^T` of it at the joints, in the air and at the pose it has there."""
    still = dict.fromkeys(("joint_position", "joint_velocity", "base_velocity"), 0.0)
    envs = make(1, TELLO, "tello", actions="motor_torque", contacts=[], reset_noise=still, n_substeps=1, dt=1e-9)
    model = envs.model
    limits = np.array([motor.torque for motor in model.robot.motors])
    envs.step(np.full((1, 10), 0.5, np.float32))
    W = model.actuator_matrix(model.standing_q)[:, 6:]
    np.testing.assert_allclose(envs.batch.rows("torque")[0], W.T @ (0.5 * limits), rtol=1e-6, atol=1e-6)


def test_a_unit_moves_the_joint_that_a_motor_drives_most():
    """Behind a plain gear by the scale itself; both motors of a differential together move one joint by it."""
    program = make_program("tello", "velocity", actions="motor_pd", action_scale=0.2)
    actions, model = program.actions, program.model
    W = model.actuator_matrix(model.standing_q)[:, 6:]
    names = [motor.rotor for motor in model.robot.motors]
    for name, scale in zip(actions.targets, actions.scale, strict=True):
        row = W[names.index(name)]
        assert scale == pytest.approx(0.2 * row[np.argmax(np.abs(row))])
    both = np.zeros(10)
    both[[names.index("left-knee-ankle-rotor-1"), names.index("left-knee-ankle-rotor-2")]] = 1.0
    moved = np.linalg.solve(W, both * actions.scale)
    knee = model.joint_links.index("left-shin")
    assert moved[knee] == pytest.approx(0.2)
    assert np.abs(np.delete(moved, knee)).max() < 1e-9
    assert "rest" in policy_spec(program, "velocity")["action"]


@pytest.mark.parametrize("kind", KINDS)
def test_spaces_limits_and_mass_are_the_same_at_every_level(kind: str):
    programs = [make_program("mit_humanoid", "velocity", actions=kind, transmission=level) for level in LEVELS]
    first = programs[0]
    seen, acted = spaces(first, "vector")
    assert acted.shape == (10,)  # motors of the legs, or their joints
    for program in programs[1:]:
        assert spaces(program, "vector") == (seen, acted)
        np.testing.assert_allclose(program.actions.scale, first.actions.scale)
        np.testing.assert_allclose(program.actions.rest, first.actions.rest)
        assert program.model.total_mass == pytest.approx(first.model.total_mass, rel=1e-12)
        assert program.model.robot.motors == first.model.robot.motors
        for name in first.model.joint_links:
            assert program.model.robot.body(name).joint == first.model.robot.body(name).joint


def test_late_motor_actions():
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 2, 2)).astype(np.float32)
    plain, late = make(actions="motor_pd"), make(actions="motor_pd", latency=(4, 4))
    held = np.zeros((2, 2), np.float32)
    for action in actions:
        late.step(action)
        plain.step(held)
        held = action
        np.testing.assert_allclose(late.state()["q"], plain.state()["q"], atol=1e-10)


def test_joints_that_no_motor_drives_cannot_act_at_motors():
    with pytest.raises(ValueError, match=r"action_joints=.*expected patterns of joints that motors drive"):
        make_program("jvrc1", "velocity", actions="motor_pd", action_joints=["neck-*"])
