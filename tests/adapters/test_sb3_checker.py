"""Stable-Baselines3's own checker has nothing to say about the environments."""

from __future__ import annotations

import warnings

import gymnasium
import pytest
from stable_baselines3.common.env_checker import check_env

import ce_gym


@pytest.mark.slow
def test_the_checker_is_silent():
    """On every task and a skill; others differ in numbers only, and each has to be compiled."""
    tasks = {"velocity", "run", "stand", "jump", "backflip"}
    ids = [
        i for i, a in ce_gym.environment_ids().items() if a["robot"] == "mini_cheetah" and a["transmission"] == "exact"
    ]
    ids = [i for i in ids if ce_gym.environment_ids()[i]["task"] in tasks]
    assert len(ids) == len(tasks)
    for env_id in ids:
        env = gymnasium.make(env_id).unwrapped
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env)
