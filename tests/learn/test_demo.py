"""Recording and the demonstration, on the toy task and on a robot's environment."""

import re

import gymnasium
import numpy as np
import pytest
from demo import main as demo_main
from demo import parting

import ce_gym
from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import load_policy
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
    assert "--force trains a new one" in output  # the policy of the fixture is used again
    for level in ("exact *", "coupled", "armature", "none"):
        assert level in output
    page = output.strip().splitlines()[-1]
    assert page == str((demo / "mini_cheetah.html").resolve())
    assert 10_000 < (demo / "mini_cheetah.html").stat().st_size <= 6e6
    assert output.count("The ghost is the same policy from the same seed on none transmissions; after") == 1


@pytest.mark.slow
def test_the_page_shows_the_policy_without_rotors_as_a_ghost(demo):
    """Robots of the page are what its plots are of: the trained policy first, then its ghost."""
    page = (demo / "mini_cheetah.html").read_text(encoding="utf-8")
    robots = re.findall(r'"name": "([^"]*)", "color": "[^"]*", "ghost": (true|false)', page)
    assert robots == [("exact transmissions, as trained", "false"), ("none transmissions, the ghost", "true")]


def test_the_distance_is_that_when_one_of_them_ends():
    def walk(level, frames, speed):
        times = 0.02 * np.arange(frames)
        q = np.zeros((frames, 19))
        q[:, 0], q[:, 2] = speed * times, 9.0
        return Rollout("mini_cheetah", level, 0.02, times, q, np.zeros((frames, 18)))

    said = parting(walk("exact", 101, 1.0), walk("none", 51, 0.5))
    assert said.endswith("from the same seed on none transmissions; after 1.0 s it is 0.50 m away.")


@pytest.mark.slow
def test_the_rollout_has_states_forces_and_commands(demo):
    rollout = Rollout.load(demo / "mini_cheetah.npz")
    assert rollout.robot == "mini_cheetah"
    assert rollout.transmission == "exact"
    assert rollout.contact_forces.shape[1] > 0
    np.testing.assert_array_equal(rollout.commands[0], 0.0)


@pytest.mark.slow
def test_force_trains_again(demo, capsys):
    assert demo_main([*QUICK, "--force", "--seed", "4", "--out", str(demo)]) == 0
    assert "Training a new policy" in capsys.readouterr().out
    assert load_policy(demo / "policy.npz").record["seed"] == 4


def test_the_adapter_hands_on_what_the_robot_environment_says():
    """The real environments have the interface that the toy environment stands for."""
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
