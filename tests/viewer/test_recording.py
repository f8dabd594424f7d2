"""Recording environments: one alone and one lane of many give the same rollout, with torques and reward terms."""

from __future__ import annotations

import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import ce_gym
from ce_gym.viewer import ViewerError, record, record_lanes

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


def test_signals_are_what_the_environment_says(envs) -> None:
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
    for rollout in rollouts:  # nothing of the next episode is in it
        assert np.abs(np.diff(rollout.q[:, :3], axis=0)).max() < 0.1


def test_what_cannot_be_recorded_is_one_line(envs) -> None:
    with pytest.raises(ViewerError, match="lane 3: expected 0 to 2"):
        record(envs, still, 1.0, lane=3)
    with pytest.raises(ViewerError, match="cannot record CartPoleEnv: expected an environment of ce_gym"):
        record(gymnasium.make("CartPole-v1"), still, 1.0)


def test_a_robot_of_ones_own_is_found_again(tmp_path: Path) -> None:
    from ce_gym.viewer.rollouts.recording import reference

    assert reference(ce_gym.load_robot("mini_cheetah")) == "mini_cheetah"
    source = Path(ce_gym.load_robot("four_bar").source)
    text = source.read_text(encoding="utf-8").replace("name: four_bar", "name: mine")
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    shutil.copy(source.with_suffix(".urdf"), tmp_path)
    robot = ce_gym.load_robot(tmp_path / "mine.yaml")
    assert ce_gym.load_robot(reference(robot)) == robot
