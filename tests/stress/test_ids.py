"""Every registered id: the checkers of Gymnasium and Stable-Baselines3 have nothing to say. Each has to be compiled."""

import warnings

import gymnasium
import pytest
from gymnasium.utils import env_checker

import ce_gym


@pytest.mark.stress
@pytest.mark.parametrize("env_id", sorted(ce_gym.environment_ids()))
def test_checkers_are_silent(env_id: str):
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    for check in (env_checker.check_env, sb3.check_env):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env = gymnasium.make(env_id).unwrapped
            check(env)
            env.close()
