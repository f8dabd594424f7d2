"""Recording and the demonstration, on the toy task and on a robot's environment."""

import gymnasium
import numpy as np
import pytest
from demo import main as demo_main
from evaluate import load_learner
from record import main as record_main
from record import record
from stable_baselines3 import PPO

import ce_gym
from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.viewer import Rollout

ROBOT_ENV = next(iter(ce_gym.environment_ids()))
QUICK = ["--steps", "30e3", "--episodes", "4", "--threads", "1"]


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Folder in which the demonstration has trained for a moment."""
    out = tmp_path_factory.mktemp("demo")
    assert demo_main([*QUICK, "--out", str(out)]) == 0
    return out


@pytest.mark.slow
def test_the_last_line_is_the_page(demo, capsys):
    assert demo_main([*QUICK, "--out", str(demo)]) == 0
    output = capsys.readouterr().out
    assert "--fresh trains a new one" in output  # the policy of the fixture is used again
    for level in ("exact *", "coupled", "armature", "none"):
        assert level in output
    page = output.strip().splitlines()[-1]
    assert page == str((demo / "mini_cheetah.html").resolve())
    assert (demo / "mini_cheetah.html").stat().st_size > 10_000


@pytest.mark.slow
def test_the_rollout_has_states_forces_and_commands(demo):
    rollout = Rollout.load(demo / "mini_cheetah.npz")
    assert rollout.robot == "mini_cheetah"
    assert rollout.transmission == "exact"
    assert rollout.contact_forces.shape[1] > 0
    np.testing.assert_array_equal(rollout.commands[0], 0.0)


@pytest.mark.slow
def test_fresh_trains_again(demo, capsys):
    assert demo_main([*QUICK, "--fresh", "--seed", "4", "--out", str(demo)]) == 0
    assert "Training from nothing" in capsys.readouterr().out
    assert load_learner(demo / "policy.zip")[1]["seed"] == 4


def test_a_robot_follows_the_script():
    """An untrained policy stands long enough to see the commands of the script arrive."""
    envs = make_sb3_vec_env(ROBOT_ENV, 1)
    model = PPO("MlpPolicy", envs, device="cpu", seed=0)
    model.policy.action_net.weight.data.zero_()
    rollout = record(model, ROBOT_ENV, [(0.2, (0.0, 0.0, 0.0)), (0.2, (0.7, -0.1, 0.3))], transmission="armature")
    assert len(rollout) == 20
    assert rollout.transmission == "armature"
    np.testing.assert_allclose(rollout.commands[[0, 9]], 0.0)
    np.testing.assert_allclose(rollout.commands[[10, 19]], [[0.7, -0.1, 0.3]] * 2, rtol=1e-6)
    assert np.ptp(rollout.q[:, 2]) < 0.2


def test_record_writes_both_files(demo, tmp_path):
    out = tmp_path / "walk.npz"
    assert record_main([str(demo / "policy.zip"), "--command", "0.5", "0.4", "0", "0", "--out", str(out)]) == 0
    assert len(Rollout.load(out)) <= 25
    assert out.with_suffix(".html").exists()


def test_the_adapter_hands_on_what_the_robot_environment_says():
    """The real environments keep the contract that the toy environment stands for."""
    envs = make_sb3_vec_env(ROBOT_ENV, 8, seed=1, max_episode_steps=5)
    obs = envs.reset()
    action = np.zeros((8, *envs.action_space.shape), np.float32)
    for _ in range(5):
        kept, before = obs, obs.copy()
        obs, rewards, dones, infos = envs.step(action)
        np.testing.assert_array_equal(kept, before)
        assert not np.shares_memory(kept, obs)
    assert dones.all()
    assert rewards.dtype == obs.dtype == np.float32
    for i, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert not np.array_equal(info["terminal_observation"], obs[i])
        assert info["episode"]["l"] == 5
        assert 0 <= info["episode"]["metrics/forward_speed_error"] < 2
    assert gymnasium.spec(ROBOT_ENV).vector_entry_point
