"""What actions mean: joints or motors, positions or torques, alike at every transmission level."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import ce_gym  # noqa: F401 - registers the environments

MINI, TELLO = "ce_gym/MiniCheetahVelocity-v0", "ce_gym/TelloVelocity-v0"
KINDS = ("joint_pd", "joint_torque", "motor_pd", "motor_torque")
LEVELS = ("exact", "coupled", "armature", "none")


def make(env_id: str, n: int = 2, **arguments):
    envs = gymnasium.make_vec(env_id, num_envs=n, autoreset_mode="SameStep", **arguments).unwrapped
    envs.reset(seed=0)
    return envs


@pytest.mark.parametrize("kind", ["pd", "torque"])
def test_behind_single_gears_motors_and_joints_are_the_same(kind: str):
    """Signs of ratios apart, where a torque is concerned: a motor that turns the other way takes the other action."""
    joint, motor = make(MINI, 4, actions=f"joint_{kind}"), make(MINI, 4, actions=f"motor_{kind}")
    program, model = motor.batch.program, motor.model
    ratio = model.actuator_matrix(model.standing_q)[:, 6:]
    order = np.argmax(np.abs(ratio), axis=1)
    sign = np.ones(12) if kind == "pd" else np.sign(ratio[np.arange(12), order])
    assert program.actions.targets == tuple(m.rotor for m in model.robot.motors)
    for k in range(15):
        action = np.random.default_rng(k).uniform(-0.6, 0.6, (4, 12)).astype(np.float32)
        joint.step(action)
        motor.step((action[:, order] * sign).astype(np.float32))
    np.testing.assert_allclose(motor.state()["q"], joint.state()["q"], atol=1e-7)
    assert np.abs(joint.state()["v"]).max() > 0.5


def test_motor_torques_go_through_the_rods():
    """On Tello, half of every motor's torque is `W^T` of it at the joints, in the air and at the pose it has there."""
    still = dict.fromkeys(("joint_position", "joint_velocity", "base_velocity"), 0.0)
    envs = make(TELLO, 1, actions="motor_torque", contacts=[], reset_noise=still, n_substeps=1, dt=1e-9)
    model = envs.model
    limits = np.array([motor.torque for motor in model.robot.motors])
    envs.step(np.full((1, 10), 0.5, np.float32))
    W = model.actuator_matrix(model.standing_q)[:, 6:]
    np.testing.assert_allclose(envs.batch.rows("torque")[0], W.T @ (0.5 * limits), rtol=1e-6, atol=1e-6)


def test_a_unit_moves_the_joint_that_a_motor_drives_most():
    """Behind a plain gear by the scale itself; both motors of a differential together move one joint by it."""
    envs = make(TELLO, actions="motor_pd", action_scale=0.2)
    actions = envs.batch.program.actions
    W = envs.model.actuator_matrix(envs.model.standing_q)[:, 6:]
    names = [motor.rotor for motor in envs.model.robot.motors]
    for name, scale in zip(actions.targets, actions.scale, strict=True):
        row = W[names.index(name)]
        assert scale == pytest.approx(0.2 * row[np.argmax(np.abs(row))])
    both = np.zeros(10)
    both[[names.index("left-knee-ankle-rotor-1"), names.index("left-knee-ankle-rotor-2")]] = 1.0
    moved = np.linalg.solve(W, both * actions.scale)
    knee = envs.model.joint_links.index("left-shin")
    assert moved[knee] == pytest.approx(0.2)
    assert np.abs(np.delete(moved, knee)).max() < 1e-9
    assert "rest" in envs.contract()["action"]


@pytest.mark.parametrize("kind", KINDS)
def test_spaces_limits_and_mass_are_the_same_at_every_level(kind: str):
    envs = [make("ce_gym/MitHumanoidVelocity-v0", 1, actions=kind, transmission=level) for level in LEVELS]
    first = envs[0]
    assert first.single_action_space.shape == (10,)  # motors of the legs, or their joints
    for env in envs[1:]:
        assert env.single_action_space == first.single_action_space
        assert env.single_observation_space == first.single_observation_space
        np.testing.assert_allclose(env.batch.program.actions.scale, first.batch.program.actions.scale)
        np.testing.assert_allclose(env.batch.program.actions.rest, first.batch.program.actions.rest)
        assert env.model.total_mass == pytest.approx(first.model.total_mass, rel=1e-12)
        assert env.model.robot.motors == first.model.robot.motors
        for name in first.model.joint_links:
            assert env.model.robot.body(name).joint == first.model.robot.body(name).joint


def test_late_motor_actions():
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 2, 10)).astype(np.float32)
    plain, late = make(TELLO, actions="motor_pd"), make(TELLO, actions="motor_pd", latency=(4, 4))
    held = np.zeros((2, 10), np.float32)
    for action in actions:
        late.step(action)
        plain.step(held)
        held = action
        np.testing.assert_allclose(late.state()["q"], plain.state()["q"], atol=1e-10)


def test_joints_that_no_motor_drives_cannot_act_at_motors():
    with pytest.raises(ValueError, match=r"action_joints=.*expected patterns of joints .* that motors drive"):
        make("ce_gym/Jvrc1Velocity-v0", actions="motor_pd", action_joints=["neck-*"])
