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
from ce_gym.envs.registration import STRETCHING

IDS = sorted(ce_gym.environment_ids())
VELOCITY = "ce_gym/MiniCheetahVelocity-v0"
ROBOTS = {
    arguments["robot"]: env_id for env_id, arguments in ce_gym.environment_ids().items() if "Velocity-v0" in env_id
}
CHECKED = (  # each has to be compiled; `pytest tests/stress -m stress` checks them all
    *(f"ce_gym/MiniCheetah{task}-v0" for task in ("Run", "Jump", "Backflip")),
    "ce_gym/MiniCheetahVelocity-Elastic-v0",
    "ce_gym/CassieVelocity-v0",
)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", CHECKED)
def test_gymnasium_check_env_is_silent(env_id: str):
    env = gymnasium.make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()
    env.close()  # closing twice is allowed


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
    assert levels == {"exact", "coupled", "armature", "none", "elastic"}


def test_robots_with_elastic_transmissions_have_that_level():
    assert [robot for robot in ROBOTS if ce_gym.load_robot(robot).elastic] == list(STRETCHING)


def test_ids_work_in_a_process_that_has_not_imported_the_package():
    code = f"import gymnasium; gymnasium.make('ce_gym:{VELOCITY}').reset(seed=0); print('made')"
    result = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "made"


@pytest.mark.slow
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
