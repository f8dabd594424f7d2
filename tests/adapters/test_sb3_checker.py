"""Stable-Baselines3's own checker has nothing to say about the environments."""

from __future__ import annotations

import warnings

import gymnasium
from stable_baselines3.common.env_checker import check_env

import ce_gym


def test_the_checker_is_silent():
    for env_id in ce_gym.environment_ids():
        env = gymnasium.make(env_id).unwrapped
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env)
