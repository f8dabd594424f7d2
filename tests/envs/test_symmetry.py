"""The left-right symmetry of robots, against their kernels and against robots and tasks that have none."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

import ce_gym
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.runtime.symmetry import left_right, paired_joints

ROBOTS = ("mini_cheetah", "mit_humanoid", "tello", "jvrc1")
VELOCITY = "ce_gym/MiniCheetahVelocity-v0"


@pytest.mark.parametrize("robot", ROBOTS)
def test_robots_are_symmetric(robot):
    program = make_program(robot, "velocity")
    symmetry = left_right(program)
    assert symmetry.error < 0.03
    obs = np.random.default_rng(0).standard_normal((3, program.observation_size))
    for reflect, rows in ((symmetry.observation, obs), (symmetry.action, obs[:, : program.n_actions])):
        np.testing.assert_array_equal(reflect(reflect(rows)), rows)
        assert not np.array_equal(reflect(rows), rows)


@pytest.mark.parametrize("robot", ROBOTS)
def test_partners_are_those_the_names_speak_of(robot):
    """What the description's author calls left and right; the geometry is not told."""
    robot = make_program(robot, "velocity").model
    joints, names = paired_joints(robot), robot.robot.independent
    swaps = {"left": "right", "right": "left", "HR": "HL", "HL": "HR", "FR": "FL", "FL": "FR", "R_": "L_", "L_": "R_"}
    for name, partner in zip(names, joints.index, strict=True):
        side = next((side for side in swaps if side in name), None)
        assert names[partner] == (name.replace(side, swaps[side]) if side else name)


def test_the_kernel_commutes_with_the_reflection():
    """Ten control steps of a robot and of its mirror image, feet on the ground: mirror images to the end."""
    envs, images = (gymnasium.make_vec(VELOCITY, num_envs=4) for _ in range(2))
    symmetry = envs.unwrapped.symmetry
    rng = np.random.default_rng(0)
    envs.reset(seed=0)
    images.reset(seed=1)
    state = envs.unwrapped.snapshot()
    reflected = dict(state) | {"command": state["command"] * [1, -1, -1]}
    quaternion, twist = [1, -1, 1, -1], [-1, 1, -1, 1, -1, 1]
    base = np.concatenate([state["q"][:, :3] * [1, -1, 1], state["q"][:, 3:7] * quaternion], axis=1)
    reflected["q"] = np.concatenate([base, symmetry.action(state["q"][:, 7:])], axis=1)
    reflected["v"] = np.concatenate([state["v"][:, :6] * twist, symmetry.action(state["v"][:, 6:])], axis=1)
    native = envs.unwrapped
    points, _ = native.model.contact_points(native.model.standing_q, np.zeros(native.model.nv))
    spheres = points[[native.model.contact_names.index(name) for name in native.contact_names]]
    partners = np.linalg.norm(spheres[:, None] * [1, -1, 1] - spheres[None], axis=2).argmin(axis=1)
    reflected["load"] = state["load"][:, partners]
    images.unwrapped.restore(reflected)
    for _ in range(10):
        actions = rng.uniform(-0.5, 0.5, (4, 12)).astype(np.float32)
        obs, reward, *_ = envs.step(actions)
        image, same, *_ = images.step(symmetry.action(actions))
        np.testing.assert_allclose(image, symmetry.observation(obs), atol=1e-4)
        np.testing.assert_allclose(same, reward, atol=1e-6)
    assert np.abs(obs[:, 12:24] - symmetry.observation(obs)[:, 12:24]).max() > 0.1  # the robots themselves lean


def with_robot(program: TaskProgram, **changes) -> TaskProgram:
    model = type(program.model)(replace(program.model.robot, **changes), program.model.transmission)
    return TaskProgram(model, program.task)


def test_one_heavy_leg_is_no_symmetry():
    program = make_program("mini_cheetah", "velocity")
    robot = program.model.robot
    name = robot.independent[0]
    bodies = tuple(
        replace(body, inertial=replace(body.inertial, mass=3 * body.inertial.mass)) if body.name == name else body
        for body in robot.bodies
    )
    assert left_right(with_robot(program, bodies=bodies)) is None


def test_a_pose_that_leans_is_no_symmetry():
    program = make_program("mini_cheetah", "velocity")
    first, *others = program.model.robot.pose.joints
    pose = replace(program.model.robot.pose, joints=((first[0], 0.1), *others))
    assert left_right(with_robot(program, pose=pose)) is None


def test_a_task_that_prefers_one_side_is_no_symmetry():
    def to_the_left(s):
        return s.base_linear_velocity[1]

    ce_gym.reward(to_the_left)
    assert left_right(make_program("mini_cheetah", "velocity", rewards={"to_the_left": 5.0})) is None


def test_motors_without_joints_of_their_own_are_not_reflected():
    assert left_right(make_program("mini_cheetah", "velocity", actions="motor_pd")) is None
    assert left_right(make_program("mini_cheetah", "velocity", actions="joint_torque")) is not None


def test_history_and_critic_are_reflected_too():
    program = make_program("mini_cheetah", "velocity", history=2, critic=("base_height", "contact_forces", "torques"))
    symmetry = left_right(program)
    n = program.observation_size // 2
    np.testing.assert_array_equal(symmetry.observation.index[n:], symmetry.observation.index[:n] + n)
    assert len(symmetry.critic.index) == program.critic_size
    assert symmetry.critic.index[n] == n  # the height
    unknown = left_right(
        make_program("mini_cheetah", "velocity", critic=("parameters",), randomise={"friction": (0.5, 1)})
    )
    assert unknown.critic is None
