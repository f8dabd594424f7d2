"""Every registered id: Gymnasium's checker, specs, transmission levels."""

from __future__ import annotations

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import ce_gym

IDS = sorted(ce_gym.environment_ids())
VELOCITY = "ce_gym/MiniCheetahVelocity-v0"
LEVELS = ("Exact", "Coupled", "Armature", "None")
ONE_TASK = ("Go1", "Go2", "BerkeleyHumanoid")  # robots that differ from others in their figures alone
CHECKED = [  # every robot, task and level, but not all of their products: each has to be compiled
    env_id
    for env_id in IDS
    if env_id.startswith("ce_gym/MiniCheetahVelocity")
    or (
        not env_id.endswith(tuple(f"-{level}-v0" for level in LEVELS))
        and (env_id.endswith("Velocity-v0") or not env_id.startswith(tuple(f"ce_gym/{robot}" for robot in ONE_TASK)))
    )
]


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
