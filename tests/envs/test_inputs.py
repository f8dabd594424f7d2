"""What environments are given from outside: arguments, actions, seeds and commands, good ones and bad ones."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym  # noqa: F401 - registers the environments

VELOCITY = "ce_gym/MiniCheetahVelocity-v0"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"transmission": "rigid"}, "transmission='rigid'; expected one of exact, coupled, armature, none"),
        ({"task": "fly"}, "task='fly'; expected one of velocity"),
        ({"robot": "mini_cheeta"}, "mini_cheetah"),
        ({"robot": "mit_humanoid_leg"}, "fixed base"),
        ({"rewards": {"style": 1.0}}, "no reward term 'style'; expected one of"),
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


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (np.zeros(2), r"command has shape \(2,\); expected \(3,\) or \(2, 3\)"),
        (np.full(3, np.nan), "command holds a number that is not finite"),
        (np.zeros((3, 3)), r"command has shape \(3, 3\); expected"),
        ("fast", "command is a str; expected an array of real numbers"),
    ],
)
def test_bad_commands(command, message: str):
    envs = gymnasium.make_vec(VELOCITY, num_envs=2).unwrapped
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=message):
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
    envs = gymnasium.make_vec(VELOCITY, num_envs=512, robot=TRIPOD, command_period=0.1)
    envs.reset(seed=0)
    seen = []
    for _ in range(11):
        envs.step(np.zeros((512, 2), np.float32))
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
