"""Ball joints of an environment's robot: observed, reset, restored bit for bit, differentiated and drawn."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from ball_joints import product

from ce_gym.viewer import write_html
from ce_gym.viewer.rollouts.recording import record

pytest.importorskip("mujoco")
pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")

DOG = """<mujoco model="dog"><worldbody><geom type="plane" size="1 1 1"/><body name="plate" pos="0 0 0.12"><freejoint/>
<geom type="sphere" size="0.1" mass="2"/><body name="arm" pos="0.1 0 0.05"><joint name="arm" axis="0 1 0"/>
<geom type="capsule" size="0.015" fromto="0 0 0 0 0 0.15" mass="0.2"/></body>
<body name="tail" pos="-.15 0 .02"><joint type="ball" damping="0.002" range="0 1.2"/>
<geom type="capsule" size="0.01" fromto="0 0 0 -.1 0 0" mass="0.1"/></body></body></worldbody>
<actuator><position joint="arm" kp="20" kv="0.5"/></actuator>
<keyframe><key qpos="0 0 .12 1 0 0 0 0 1 0 0.3 0"/></keyframe></mujoco>"""
SEEN = ["ball_rotations", "ball_velocities", "joint_positions"]


@pytest.fixture(scope="module")
def dog(tmp_path_factory):
    path = tmp_path_factory.mktemp("dog") / "dog.xml"
    path.write_text(DOG)
    options = {"robot": str(path), "contacts": (), "observations": SEEN, "rewards": {"base_height": -1.0}, "noise": {}}
    return lambda n: gymnasium.make_vec("ce_gym/MiniCheetahStand-v0", num_envs=n, num_threads=1, **options)


def test_balls_in_an_environment(dog, tmp_path):
    env = dog(3)
    native = env.unwrapped
    observation, _ = env.reset(seed=1)
    robot, home = native.model.robot, native.model.standing_q[7:11]
    rows, speeds = robot.rows["tail"]
    q, v = native.state()["q"], native.state()["v"]
    assert np.abs(np.linalg.norm(q[:, 7:11], axis=1) - 1).max() < 1e-12
    assert np.unique(q[:, 8]).size == 3, "every robot begins with another turn"
    for seen, turn, speed in zip(
        observation, q[:, rows.start : rows.stop], v[:, speeds.start : speeds.stop], strict=True
    ):
        half = product(home * [1, -1, -1, -1], turn)
        angle = 2 * np.arctan2(np.linalg.norm(half[1:]), half[0])
        np.testing.assert_allclose(seen[:3], angle * half[1:] / np.linalg.norm(half[1:]), atol=1e-6)
        np.testing.assert_allclose(seen[3:6], 0.05 * speed, atol=1e-6)
    assert native.symmetry is None
    snapshot, action = native.snapshot(), np.full(env.action_space.shape, 0.5, np.float32)
    one = [env.step(action)[0] for _ in range(5)][-1]
    native.restore(snapshot)
    np.testing.assert_array_equal([env.step(action)[0] for _ in range(5)][-1], one)
    rollout = record(env, lambda _: action, 0.2)
    assert rollout.q.shape[1] == native.model.nq
    assert "tail" in write_html(rollout, tmp_path / "dog.html").read_text()


def test_blended_poses_are_between():
    from ce_gym.model.coordinates import Layout
    from ce_gym.viewer.live.history import Moment, between

    layout, turn = Layout(floating=True, balls=1, joints=0), np.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])
    first = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], float)
    second = np.concatenate([first[:7], -turn])  # the same orientation as the turn
    moments = Moment(0.0, (first,), ()), Moment(1.0, (second,), ())
    (blended,) = between(*moments, 0.5, [layout])
    expected = np.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0])
    np.testing.assert_allclose(blended[7:], expected, atol=1e-12)
