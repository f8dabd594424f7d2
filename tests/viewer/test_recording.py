"""Recording and driving: a single environment and a lane of many give the same rollout."""

from __future__ import annotations

import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stander import write_small

import ce_gym
from ce_gym.policies import find_policy
from ce_gym.viewer import ViewerError, drive, record, record_lanes, walk
from ce_gym.viewer.rollouts.recording import robot_reference

ENV = "ce_gym/MiniCheetahVelocity-v0"


def still(observation: np.ndarray) -> np.ndarray:
    return np.zeros((*observation.shape[:-1], 12), np.float32)


def falling(observation: np.ndarray) -> np.ndarray:
    """Folds half of the legs."""
    return np.tile(np.float32([1, 1, -1, 0, 0, 0]), 2) * np.ones((*observation.shape[:-1], 1), np.float32)


@pytest.fixture(scope="module")
def envs():
    envs = gymnasium.make_vec(ENV, 3, contact_forces=True)
    yield envs
    envs.close()


def test_one_lane_is_a_single_environment(envs) -> None:
    single = gymnasium.make(ENV, contact_forces=True)
    lane = record(envs, still, 0.4, lane=2, seed=5)
    alone = record(single, still, 0.4, seed=7)
    for name in ("times", "q", "v", "contact_forces", "commands", "torques", "signals"):
        np.testing.assert_array_equal(getattr(lane, name), getattr(alone, name), err_msg=name)
    assert lane.signal_names == alone.signal_names
    assert len(lane) == 20


def test_signals_are_the_environment_s_rewards_and_torques(envs) -> None:
    rollout = record(envs, still, 0.2, lane=1, seed=0, commands=[[0.5, 0.1, -0.2]], label="still")
    envs.reset(seed=0)
    np.testing.assert_array_equal(rollout.signals[0], 0.0)
    np.testing.assert_array_equal(rollout.torques[0], 0.0)
    for frame in range(1, 10):
        envs.unwrapped.set_command(np.array([0.5, 0.1, -0.2]))
        _, reward, _, _, infos = envs.step(still(np.zeros((3, 1))))
        assert rollout.signals[frame, 0] == reward[1]
        column = rollout.signal_names.index("reward: torques")
        assert rollout.signals[frame, column] == infos["reward_terms"]["torques"][1]
        np.testing.assert_array_equal(rollout.torques[frame], envs.unwrapped.state()["torque"][1])
    np.testing.assert_allclose(rollout.commands, [[0.5, 0.1, -0.2]] * 10)
    assert (rollout.label, rollout.transmission, rollout.info["task"]) == ("still", "exact", "velocity")


def test_each_lane_ends_with_its_own_episode(envs) -> None:
    rollouts = record_lanes(envs, falling, 20.0, lanes=range(3), seed=0)
    assert all(1 < len(rollout) < 1000 for rollout in rollouts)
    for rollout in rollouts:  # without frames of the next episode
        assert np.abs(np.diff(rollout.q[:, :3], axis=0)).max() < 0.1


def test_other_lanes_and_environments_are_refused(envs) -> None:
    with pytest.raises(ViewerError, match="lane 3: expected 0 to 2"):
        record(envs, still, 1.0, lane=3)
    with pytest.raises(ViewerError, match="cannot record CartPoleEnv: expected an environment of ce_gym"):
        record(gymnasium.make("CartPole-v1"), still, 1.0)


def test_a_robot_of_another_file_is_found_again(tmp_path: Path) -> None:
    assert robot_reference(ce_gym.load_robot("mini_cheetah")) == "mini_cheetah"
    source = Path(ce_gym.load_robot("four_bar").source)
    text = source.read_text(encoding="utf-8").replace("name: four_bar", "name: mine")
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    shutil.copy(source.with_suffix(".urdf"), tmp_path)
    robot = ce_gym.load_robot(tmp_path / "mine.yaml")
    assert ce_gym.load_robot(robot_reference(robot)) == robot


def test_a_policy_walks_in_the_environment_of_its_training(tmp_path: Path) -> None:
    (rollout,) = walk(write_small(tmp_path / "stander" / "policy.npz", env_kwargs={"transmission": "none"}))
    assert (rollout.robot, rollout.transmission, rollout.label) == ("mini_cheetah", "none", "stander")
    np.testing.assert_allclose(np.unique(rollout.commands[:, 0]), [0.0, 0.5, 0.8, 1.0], rtol=1e-6)
    assert len(rollout) == 850
    assert np.ptp(rollout.q[:, 2]) < 0.2
    assert find_policy(rollout.save(tmp_path / "walk.npz")) is None


def test_a_script_sets_commands_until_its_end_or_a_fall() -> None:
    script = [(0.2, (0.0, 0.0, 0.0)), (0.2, (0.7, -0.1, 0.3))]
    rollout = drive(still, ENV, script, transmission="armature")
    assert (len(rollout), rollout.transmission) == (20, "armature")
    np.testing.assert_allclose(rollout.commands[[0, 9]], 0.0)
    np.testing.assert_allclose(rollout.commands[[10, 19]], [[0.7, -0.1, 0.3]] * 2, rtol=1e-6)
    assert 1 < len(drive(falling, ENV, [(20.0, (1.0, 0.0, 0.0))])) < 1000
