"""Single and vector environments: the same numbers whatever the batch, arrays that stay as they are, wrappers."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from tripod import TRIPOD

import ce_gym  # noqa: F401 - registers the environments

VELOCITY = "ce_gym/MiniCheetahVelocity-v0"


def random_actions(steps: int, n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, n, 12)).astype(np.float32)


def rollout(envs, actions: np.ndarray, seed: int) -> list[np.ndarray]:
    observation, _ = envs.reset(seed=seed)
    history = [observation]
    for action in actions:
        observation, reward, *_ = envs.step(action)
        history += [observation, reward]
    return history


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_same_seed_same_rollout_whatever_the_batch(mode: str):
    """Batch 1, 7, 1024 and threads 1, 2: bitwise equal, through terminations and resets."""
    actions = random_actions(80, 1024)
    whole = rollout(gymnasium.make_vec(VELOCITY, num_envs=1024, num_threads=2, autoreset_mode=mode), actions, seed=10)
    for n, threads in ((1, 1), (7, 1), (7, 2), (1024, 1)):
        envs = gymnasium.make_vec(VELOCITY, num_envs=n, num_threads=threads, autoreset_mode=mode)
        for ours, theirs in zip(rollout(envs, actions[:, :n], seed=10), whole, strict=True):
            np.testing.assert_array_equal(ours, theirs[:n])


def test_an_observation_may_be_one_number():
    arguments = {"robot": TRIPOD, "observations": ["base_height"]}
    envs, single = gymnasium.make_vec(VELOCITY, num_envs=3, **arguments), gymnasium.make(VELOCITY, **arguments)
    for observation, *_ in (envs.reset(seed=4), envs.step(envs.action_space.sample())):
        assert observation.shape == (3, 1)
    assert single.reset(seed=4)[0].shape == (1,)


def test_single_environment_is_lane_zero():
    actions = random_actions(300, 5, seed=1)
    envs = gymnasium.make_vec(VELOCITY, num_envs=5, autoreset_mode="SameStep")
    vector_observation, _ = envs.reset(seed=20)
    singles = [gymnasium.make(VELOCITY) for _ in range(5)]
    for i, env in enumerate(singles):
        np.testing.assert_array_equal(env.reset(seed=20 + i)[0], vector_observation[i])
    ended = 0
    for action in actions:
        observation, reward, terminated, _, infos = envs.step(action)
        for i, env in enumerate(singles):
            ours, r, done, _, _ = env.step(action[i])
            assert r == reward[i]
            assert done == terminated[i]
            if done:
                ended += 1
                np.testing.assert_array_equal(ours, infos["final_obs"][i])
                ours, _ = env.reset()
            np.testing.assert_array_equal(ours, observation[i])
    assert ended >= 3


def test_fresh_arrays_out_of_every_call():
    envs = gymnasium.make_vec(VELOCITY, num_envs=4, autoreset_mode="SameStep", max_episode_steps=3)
    envs.reset(seed=0)
    kept, copies = [], []
    for action in random_actions(8, 4):
        observation, reward, terminated, truncated, infos = envs.step(action)
        arrays = [
            observation,
            reward,
            terminated,
            truncated,
            infos["diverged"],
            *([infos["final_obs"]] if "final_obs" in infos else []),
        ]
        kept += arrays
        copies += [a.copy() for a in arrays]
        assert observation.dtype == np.float32
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)
    assert not any(np.shares_memory(a, b) for i, a in enumerate(kept) for b in kept[:i])


def masks_removed(infos: dict) -> dict:
    """Infos without masks, after a check that each key has one."""
    assert {f"_{key}" for key in infos if key[0] != "_"} == {key for key in infos if key[0] == "_"}
    values = {key: value for key, value in infos.items() if key[0] != "_"}
    return {key: masks_removed(value) if isinstance(value, dict) else value for key, value in values.items()}


def test_final_info_is_that_of_gymnasium_s_own_vector_environment():
    """Every key, with its mask; values are zero where no episode has ended."""
    n, options = 3, {"terrain": "rough", "num_threads": 1}
    envs = gymnasium.make_vec(VELOCITY, num_envs=n, autoreset_mode="SameStep", **options)
    mode = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
    stock = gymnasium.make_vec(VELOCITY, num_envs=n, vectorization_mode="sync", vector_kwargs=mode, **options)
    for one in (envs, stock):
        one.reset(seed=20)
    ended = 0
    for action in random_actions(400, n, seed=1):
        *_, infos = envs.step(action)
        *_, theirs = stock.step(action)
        assert ("final_info" in infos) == ("final_info" in theirs)
        if "final_info" not in infos:
            continue
        ended += 1
        final, expected = infos["final_info"], theirs["final_info"]
        assert {key for key in infos if key[0] != "_"} - {"final_info", "final_obs"} == set(masks_removed(final))
        np.testing.assert_array_equal(infos["_final_info"], theirs["_final_info"])
        for key in ("diverged", "terrain_level"):
            np.testing.assert_array_equal(final[key], expected[key], err_msg=key)
            np.testing.assert_array_equal(final[f"_{key}"], expected[f"_{key}"])
        for name in infos["reward_terms"]:
            np.testing.assert_array_equal(final["reward_terms"][name], expected[f"reward_{name}"])
            np.testing.assert_array_equal(final["reward_terms"][f"_{name}"], expected[f"_reward_{name}"])
    assert ended >= 2


def test_stock_vector_wrappers():
    envs = NormalizeObservation(RecordEpisodeStatistics(gymnasium.make_vec(VELOCITY, num_envs=6, max_episode_steps=4)))
    envs.reset(seed=0)
    for action in random_actions(4, 6):
        observation, *_, infos = envs.step(action)
    assert infos["episode"]["l"].tolist() == [4] * 6
    assert np.isfinite(observation).all()
