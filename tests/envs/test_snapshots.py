"""Environments that are saved, copied and pickled go on bit for bit; what a reset may change."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym

ID = "ce_gym/MiniCheetahVelocity-v0"
N = 5
OPTIONS = {
    "transmission": "none",
    "robot": TRIPOD,
    "history": 2,
    "randomise": {"friction": (0.5, 1.0)},
    "push_period": 0.08,
    "command_curriculum": 0.3,
}


def make(mode: str, n: int = N) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(ID, num_envs=n, autoreset_mode=mode, max_episode_steps=6, num_threads=1, **OPTIONS)


def under_way(env, steps: int = 8):
    env.reset(seed=3)
    for action in actions(steps, env):
        env.step(action)
    return env


def actions(steps: int, env) -> np.ndarray:
    return np.random.default_rng(steps).uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)


def history(env, steps: int = 9) -> list:
    """All that an environment returns from now on, an unseeded reset at the end included."""
    told = [part for action in actions(steps, env) for part in env.step(action)[:4]]
    return [*told, env.reset()[0]]


def assert_same(ours: list, theirs: list) -> None:
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)


COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_copied_batch_goes_on_by_itself(mode: str, copied):
    envs = under_way(make(mode))
    other = copied(envs.unwrapped)
    assert other.spec == envs.unwrapped.spec
    expected = history(envs.unwrapped)
    assert_same(history(other), expected)


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
def test_a_copied_environment_goes_on_by_itself(copied):
    """Wrappers and all, as tree search and subprocesses want it."""
    env = under_way(gymnasium.make(ID, max_episode_steps=50, **OPTIONS), 4)
    other = copied(env)
    assert_same(history(other, 5), history(env, 5))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_snapshot_is_continued_by_another(mode: str, tmp_path: Path):
    envs = under_way(make(mode)).unwrapped
    snapshot = envs.snapshot(tmp_path / "state.npz")
    expected = history(envs)
    envs.restore(snapshot)
    assert_same(history(envs), expected)
    other = make(mode).unwrapped
    other.restore(str(tmp_path / "state.npz"))
    assert_same(history(other), expected)
    np.testing.assert_array_equal(other.elapsed_steps, envs.elapsed_steps)


def test_what_was_returned_stays_as_it_was():
    env = gymnasium.make(ID, **OPTIONS).unwrapped
    observation, _ = env.reset(seed=0)
    snapshot, kept = env.snapshot(), observation.copy()
    env.step(actions(1, env)[0])
    env.restore(snapshot)
    np.testing.assert_array_equal(observation, kept)


def test_a_snapshot_of_another_task_is_refused():
    env, plain = gymnasium.make(ID, **OPTIONS).unwrapped, gymnasium.make(ID, robot=TRIPOD).unwrapped
    for one in (env, plain):
        one.reset(seed=0)
    with pytest.raises(ValueError, match=r"snapshot: 'draw' is not part of this state; expected one of the same"):
        plain.restore(env.snapshot())


def test_a_partial_reset_with_a_seed_leaves_the_others():
    """The masked environments begin as seeded; the others go on, random streams and curricula included."""
    ours, theirs = under_way(make("SameStep")), under_way(make("SameStep"))
    mask = np.array([True, False, False, True, False])
    ours.reset(seed=40, options={"reset_mask": mask})
    fresh = make("SameStep")
    expected, _ = fresh.reset(seed=40)
    one, other, third = (history(envs, 12) for envs in (ours, theirs, fresh))
    for mine, old, new in zip(one[:-1], other[:-1], third[:-1], strict=True):
        np.testing.assert_array_equal(mine[~mask], old[~mask])
        np.testing.assert_array_equal(mine[mask], new[mask])
    assert expected.shape == one[0].shape


def test_a_partial_reset_of_new_environments_seeds_each_once():
    envs = make("SameStep").unwrapped
    mask = np.arange(N) < 2
    envs.reset(options={"reset_mask": mask})
    keys = envs.snapshot()["keys"]
    envs.reset(options={"reset_mask": ~mask})
    later = envs.snapshot()["keys"]
    np.testing.assert_array_equal(later[:2], keys[:2])
    assert len(set(later.tolist())) == N


def test_contacts_start_with_the_springs_force():
    """As in a simulator at the same place: friction has something to go by in the first sub-step."""
    envs = gymnasium.make_vec(ID, num_envs=N, robot=TRIPOD, randomise={"stiffness": (0.5, 2.0)}).unwrapped
    envs.reset(seed=0)
    state, snapshot = envs.state(), envs.snapshot()
    sim = ce_gym.Simulator(envs.model, N, contacts=envs.contact_names, parameters=("stiffness",))
    sim.set_parameter("stiffness", snapshot["parameters"])
    sim.set_state(state["q"], state["v"])
    np.testing.assert_allclose(snapshot["load"], sim.snapshot()["load"], rtol=1e-6, atol=1e-6)
    assert (snapshot["load"] > 0).any()


def test_options_that_mean_nothing_are_refused():
    envs, env = make("SameStep"), gymnasium.make(ID, **OPTIONS)
    with pytest.raises(ValueError, match=r"options\['foo'\] has no effect in reset; expected reset_mask"):
        envs.reset(options={"foo": 1})
    with pytest.raises(ValueError, match=r"options\['foo'\] has no effect in reset; expected no options"):
        env.reset(options={"foo": 1})
    env.reset(options={})


def test_a_single_environment_can_be_commanded():
    env = gymnasium.make(ID, **OPTIONS).unwrapped
    env.reset(seed=0)
    env.set_command([0.5, -0.25, 0.125])
    np.testing.assert_array_equal(env.state()["command"], [0.5, -0.25, 0.125])
    with pytest.raises(ValueError, match=r"command has shape \(2,\); expected \(3,\) or \(1, 3\)"):
        env.set_command([0.0, 0.0])


def test_dictionaries_of_a_single_environment():
    env = gymnasium.make(ID, obs_mode="dict", critic=["base_height"], **OPTIONS)
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    assert env.step(actions(1, env)[0])[0] in env.observation_space


def test_a_snapshot_that_does_not_fit_changes_nothing():
    envs, fewer = (make("SameStep", n).unwrapped for n in (5, 3))
    envs.reset(seed=0)
    fewer.reset(seed=0)
    before = envs.snapshot()
    with pytest.raises(ValueError, match=r"snapshot: .* is float64 \(3, .*\); expected float64 \(5, "):
        envs.restore(fewer.snapshot())
    with pytest.raises(ValueError, match="snapshot: 'q' is missing"):
        envs.restore({name: array for name, array in before.items() if name != "q"})
    for name, array in envs.snapshot().items():
        np.testing.assert_array_equal(array, before[name])
