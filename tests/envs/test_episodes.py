"""How episodes end and begin: time limits, autoreset modes, masks, divergence, and what is told at the end."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from tripod import TRIPOD

import ce_gym  # noqa: F401 - registers the environments

VELOCITY = "ce_gym/MiniCheetahVelocity-v0"


def random_actions(steps: int, n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, n, 12)).astype(np.float32)


def test_time_is_up_as_truncation():
    envs = gymnasium.make_vec(VELOCITY, num_envs=3, max_episode_steps=5, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.reset(seed=0)
    zero = np.zeros((3, 12), np.float32)
    for k in range(1, 11):
        _, _, terminated, truncated, infos = envs.step(zero)
        assert truncated.all() == (k % 5 == 0)
        assert not terminated.any()
        assert ("final_obs" in infos) == (k % 5 == 0)
    assert infos["episode_terms"]["length"].tolist() == [5, 5, 5]
    env = gymnasium.make(VELOCITY, max_episode_steps=5)
    env.reset(seed=0)
    assert [env.step(zero[0])[3] for _ in range(5)] == [False] * 4 + [True]


def test_next_step_mode_shows_the_reset_one_step_later():
    envs = gymnasium.make_vec(VELOCITY, num_envs=2, max_episode_steps=3)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    envs.reset(seed=0)
    zero = np.zeros((2, 12), np.float32)
    for _ in range(3):
        *_, truncated, _ = envs.step(zero)
    assert truncated.all()
    _, reward, terminated, truncated, _ = envs.step(np.ones((2, 12), np.float32))
    assert not truncated.any()
    assert not terminated.any()
    np.testing.assert_array_equal(reward, 0.0)


def test_next_step_mode_draws_what_a_single_environment_draws():
    """The ignored step uses up no random numbers: after it, the lane goes on as an environment of its own does."""
    envs = gymnasium.make_vec(VELOCITY, num_envs=3, max_episode_steps=4)
    envs.reset(seed=30)
    single = gymnasium.make(VELOCITY, max_episode_steps=4)
    single.reset(seed=32)
    for action in random_actions(12, 3, seed=4):
        observation, _, terminated, truncated, _ = envs.step(action)
        if (terminated | truncated)[2]:
            ours = single.step(action[2])[0]
            np.testing.assert_array_equal(ours, observation[2])
            after, *_ = envs.step(action)
            np.testing.assert_array_equal(single.reset()[0], after[2])
        else:
            np.testing.assert_array_equal(single.step(action[2])[0], observation[2])


def test_disabled_mode_wants_a_mask():
    envs = gymnasium.make_vec(VELOCITY, num_envs=3, max_episode_steps=2, autoreset_mode="Disabled")
    envs.reset(seed=0)
    zero = np.zeros((3, 12), np.float32)
    envs.step(zero)
    observation, *_ = envs.step(zero)
    with pytest.raises(gymnasium.error.ResetNeeded, match="3 environments are finished"):
        envs.step(zero)
    mask = np.array([True, False, True])
    after, _ = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[1], observation[1])
    assert (after[mask] != observation[mask]).any(axis=1).all()
    with pytest.raises(gymnasium.error.ResetNeeded, match="1 environments are finished"):
        envs.step(zero)


def test_mask_is_read_not_taken():
    envs = gymnasium.make_vec(VELOCITY, num_envs=2)
    envs.reset(seed=0)
    options = {"reset_mask": np.array([True, False])}
    envs.reset(options=options)
    assert "reset_mask" in options
    for bad in (np.array([False, False]), np.array([1, 0]), np.array([True])):
        with pytest.raises(ValueError, match=r"reset_mask=.*expected a bool array of shape \(2,\)"):
            envs.reset(options={"reset_mask": bad})


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_a_diverged_environment_is_flagged_counted_and_reset_alone(mode: str):
    actions = random_actions(6, 20)
    clean = gymnasium.make_vec(VELOCITY, num_envs=20, autoreset_mode=mode)
    envs = gymnasium.make_vec(VELOCITY, num_envs=20, autoreset_mode=mode)
    for e in (clean, envs):
        e.reset(seed=0)
    bad = envs.unwrapped.batch.rows("v")
    bad[13, 8] = np.nan
    envs.unwrapped.batch.write("v", bad)
    others = np.arange(20) != 13
    for k, action in enumerate(actions):
        expected, ours = clean.step(action), envs.step(action)
        np.testing.assert_array_equal(ours[0][others], expected[0][others])
        np.testing.assert_array_equal(ours[1][others], expected[1][others])
        assert np.isfinite(ours[0]).all()
        assert ours[4]["diverged"].tolist() == [k == 0 and i == 13 for i in range(20)]
        assert ours[3][13] == (k == 0)
    assert envs.unwrapped.n_diverged == 1
    assert clean.unwrapped.n_diverged == 0


def test_divergence_is_a_truncation_even_if_the_robot_has_fallen():
    envs = gymnasium.make_vec(VELOCITY, num_envs=2, autoreset_mode="SameStep")
    envs.reset(seed=0)
    batch = envs.unwrapped.batch
    q, v = batch.rows("q"), batch.rows("v")
    q[:, 3:7], v[0, 8] = [0.0, 1.0, 0.0, 0.0], np.nan  # both on their backs
    batch.write("q", q)
    batch.write("v", v)
    _, _, terminated, truncated, _ = envs.step(np.zeros((2, 12), np.float32))
    assert terminated.tolist() == [False, True]
    assert truncated.tolist() == [True, False]


def test_reward_terms_add_up_and_weights_are_arguments():
    weights = {"torques": 0.0, "alive": 20.0}  # never negative, so that nothing is clipped
    envs = gymnasium.make_vec(
        VELOCITY, 8, robot=TRIPOD, max_episode_steps=20, autoreset_mode="SameStep", rewards=weights
    )
    envs.reset(seed=0)
    total = np.zeros(8)
    for action in 0.1 * random_actions(20, 8)[..., :2]:
        _, reward, terminated, _, infos = envs.step(action)
        total += reward
        assert not terminated.any()
    terms = infos["episode_terms"]
    assert "reward/torques" not in terms
    assert (terms["metrics/forward_speed_error"] < 3.0).all()  # a mean, not a sum
    np.testing.assert_allclose(terms["reward/alive"], 20 * 20.0 * 0.02)
    np.testing.assert_allclose(terms["return"], total)
    parts = sum(value for name, value in terms.items() if name.startswith("reward/"))
    np.testing.assert_allclose(parts, terms["return"], rtol=1e-9)
