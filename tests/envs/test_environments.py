"""Every registered id against Gymnasium's contract, and the equality of single and vector environments."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

import ce_gym

IDS = sorted(ce_gym.environment_ids())
ONE_TASK = ("Go1", "Go2", "BerkeleyHumanoid")  # robots that differ from others in their figures alone
VELOCITY = "ce_gym/MiniCheetahVelocity-v0"
LEVELS = ("Exact", "Coupled", "Armature", "None")
CHECKED = [  # every robot, task and level, but not all of their products: each has to be compiled
    env_id
    for env_id in IDS
    if env_id.startswith("ce_gym/MiniCheetahVelocity")
    or (
        not env_id.endswith(tuple(f"-{level}-v0" for level in LEVELS))
        and (env_id.endswith("Velocity-v0") or not env_id.startswith(tuple(f"ce_gym/{robot}" for robot in ONE_TASK)))
    )
]


def random_actions(steps: int, n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, n, 12)).astype(np.float32)


@pytest.mark.parametrize("env_id", CHECKED)
def test_gymnasium_check_env_is_silent(env_id: str):
    env = gymnasium.make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_spec_survives_json(env_id: str):
    spec = gymnasium.spec(env_id)
    again = EnvSpec.from_json(spec.to_json())
    assert again == spec


def test_an_environment_from_its_spec():
    spec = EnvSpec.from_json(gymnasium.spec("ce_gym/MiniCheetahVelocity-Armature-v0").to_json())
    assert gymnasium.make(spec).unwrapped.model.transmission == "armature"


def test_every_level_has_an_id():
    levels = {gymnasium.spec(env_id).kwargs["transmission"] for env_id in IDS}
    assert levels == {"exact", "coupled", "armature", "none"}


def test_ids_work_in_a_process_that_has_not_imported_the_package():
    code = f"import gymnasium; gymnasium.make('ce_gym:{VELOCITY}').reset(seed=0); print('made')"
    result = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "made"


def test_levels_are_treated_alike():
    envs = [
        gymnasium.make(VELOCITY, transmission=level).unwrapped for level in ("exact", "coupled", "armature", "none")
    ]
    first = envs[0]
    observation, _ = first.reset(seed=3)
    for env in envs[1:]:
        assert env.observation_space == first.observation_space
        assert env.action_space == first.action_space
        assert env.model.total_mass == pytest.approx(first.model.total_mass)
        np.testing.assert_array_equal(env.reset(seed=3)[0], observation)
        assert env.model.joint_links == first.model.joint_links


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


def test_stock_vector_wrappers():
    envs = NormalizeObservation(RecordEpisodeStatistics(gymnasium.make_vec(VELOCITY, num_envs=6, max_episode_steps=4)))
    envs.reset(seed=0)
    for action in random_actions(4, 6):
        observation, *_, infos = envs.step(action)
    assert infos["episode"]["l"].tolist() == [4] * 6
    assert np.isfinite(observation).all()


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
        VELOCITY, num_envs=8, max_episode_steps=20, autoreset_mode="SameStep", reward_weights=weights
    )
    envs.reset(seed=0)
    total = np.zeros(8)
    for action in 0.1 * random_actions(20, 8):
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"transmission": "rigid"}, "transmission='rigid'; expected one of exact, coupled, armature, none"),
        ({"task": "fly"}, "task='fly'; expected one of velocity"),
        ({"robot": "mini_cheeta"}, "mini_cheetah"),
        ({"robot": "mit_humanoid_leg"}, "fixed base"),
        ({"reward_weights": {"style": 1.0}}, "no reward term 'style'; expected one of"),
        ({"dtype": "half"}, "dtype='half'"),
        ({"num_threads": 0}, "num_threads=0; expected a whole number"),
        ({"command_range": [[1, 0], [0, 0], [0, 0]]}, "low <= high"),
        ({"command_period": -1.0}, "command_period=-1.0"),
        ({"autoreset_mode": "never"}, "autoreset_mode='never'; expected one of"),
    ],
)
def test_bad_arguments(arguments: dict, message: str):
    with pytest.raises(ValueError, match=message):
        gymnasium.make_vec(VELOCITY, num_envs=2, **arguments)


BAD_ACTIONS = {
    "NaN": (np.full((2, 12), np.nan), "action holds a number that is not finite"),
    "infinite": (np.full((2, 12), -np.inf), "action holds a number that is not finite"),
    "too few": (np.zeros((2, 11)), r"action has shape \(2, 11\); expected"),
    "too many axes": (np.zeros((1, 2, 12)), r"action has shape \(1, 2, 12\); expected"),
    "one number": (0.0, r"action has shape \(\); expected"),
    "nothing": (None, "action is None; expected an array of real numbers"),
    "text": ("walk", "action is a str; expected an array of real numbers"),
    "ragged": ([[1.0, 2.0], [3.0]], "action is a list; expected an array of real numbers"),
    "complex": (np.zeros((2, 12), complex), "action is an array of complex128; expected"),
    "objects": (np.zeros((2, 12), object), "action is an array of object; expected"),
    "truth values": (np.zeros((2, 12), bool), "action is an array of bool; expected"),
}


@pytest.mark.parametrize(("action", "message"), BAD_ACTIONS.values(), ids=BAD_ACTIONS)
@pytest.mark.parametrize("single", [True, False], ids=["single", "vector"])
def test_bad_actions_leave_the_environment_as_it_was(single: bool, action, message: str):
    """One clear line, and the next step is the one that an environment without the mistake takes."""
    envs = [gymnasium.make(VELOCITY) if single else gymnasium.make_vec(VELOCITY, num_envs=2) for _ in range(2)]
    for env in envs:
        env.reset(seed=0)
    if single and isinstance(action, np.ndarray) and action.shape == (2, 12):
        action = action[0]
    with pytest.raises(ValueError, match=message) as caught:
        envs[0].unwrapped.step(action)
    assert "\n" not in str(caught.value)
    good = np.full(envs[0].action_space.shape, 0.1, np.float32)
    ours, theirs = envs[0].step(good), envs[1].step(good)
    np.testing.assert_array_equal(ours[0], theirs[0])
    np.testing.assert_array_equal(ours[1], theirs[1])


@pytest.mark.parametrize("seed", [-1, 1.5, "one", 2**70, [1], [1, -2], [0.5, 1]])
def test_bad_seeds(seed):
    envs = gymnasium.make_vec(VELOCITY, num_envs=2)
    before = envs.reset(seed=3)[0]
    with pytest.raises((ValueError, gymnasium.error.Error), match=r"[Ss]eed"):
        envs.reset(seed=seed)
    np.testing.assert_array_equal(envs.reset(seed=3)[0], before)


@pytest.mark.parametrize("command", [np.zeros(2), np.full(3, np.nan), np.zeros((3, 3))])
def test_bad_commands(command: np.ndarray):
    envs = gymnasium.make_vec(VELOCITY, num_envs=2).unwrapped
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"command has shape .*; expected \(3,\) or \(2, 3\), finite"):
        envs.set_command(command)


def test_actions_beyond_the_box_are_clipped():
    results = []
    for size in (1.0, 50.0, 1e300):
        envs = gymnasium.make_vec(VELOCITY, num_envs=2)
        envs.reset(seed=0)
        results.append(envs.step(np.full((2, 12), size))[0])
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


def test_commands_change_and_some_ask_to_stand():
    envs = gymnasium.make_vec(VELOCITY, num_envs=512, command_period=0.1, reward_weights={"alive": 1.0})
    envs.reset(seed=0)
    seen = []
    for _ in range(11):
        envs.step(np.zeros((512, 12), np.float32))
        seen.append(envs.unwrapped.state()["command"])
    assert not np.array_equal(seen[0], seen[-1])
    standing = np.mean([(c == 0).all(axis=1).mean() for c in seen])
    assert 0.05 < standing < 0.15
    commands = np.concatenate(seen)
    assert commands[:, 0].min() < -0.95
    assert commands[:, 0].max() > 0.95
    assert np.abs(commands[:, 1]).max() <= 0.5


def test_commands_can_be_set():
    envs = gymnasium.make_vec(VELOCITY, num_envs=3)
    envs.reset(seed=0)
    envs.unwrapped.set_command(np.array([0.3, -0.1, 0.7]))
    observation, *_ = envs.step(np.zeros((3, 12), np.float32))
    np.testing.assert_allclose(observation[:, 9:12], np.tile([0.6, -0.2, 0.175], (3, 1)), rtol=1e-6)


def test_spec_kwargs_are_json():
    json.dumps(gymnasium.spec(VELOCITY).kwargs)


def played(envs, actions: np.ndarray) -> list[np.ndarray]:
    return [part for action in actions for part in envs.step(action)[:4]]


def test_a_snapshot_goes_on_bit_for_bit():
    """In another batch, made with another seed, while episodes end and begin."""
    first, second = (gymnasium.make_vec(VELOCITY, num_envs=5, max_episode_steps=9) for _ in range(2))
    first.reset(seed=3)
    second.reset(seed=4)
    actions = random_actions(30, 5)
    played(first, actions[:11])
    second.unwrapped.restore(first.unwrapped.snapshot())
    for a, b in zip(played(first, actions[11:]), played(second, actions[11:]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_snapshot_that_does_not_fit_changes_nothing():
    envs, fewer = (gymnasium.make_vec(VELOCITY, num_envs=n).unwrapped for n in (5, 3))
    envs.reset(seed=0)
    fewer.reset(seed=0)
    before = envs.snapshot()
    with pytest.raises(ValueError, match=r"snapshot: .* is float64 \(3, .*\); expected float64 \(5, "):
        envs.restore(fewer.snapshot())
    with pytest.raises(ValueError, match="snapshot: 'q' is missing"):
        envs.restore({name: array for name, array in before.items() if name != "q"})
    for name, array in envs.snapshot().items():
        np.testing.assert_array_equal(array, before[name])
