"""Every registered id: Gymnasium's checker, specs, transmission levels."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import ce_gym
from ce_gym.envs.registration import BIPEDS
from ce_gym.envs.runtime.setup import own_task
from ce_gym.policies import shelf

IDS = sorted(ce_gym.environment_ids())
VELOCITY = "ce_gym/MiniCheetahVelocity-v0"
CHECKED = (  # each has to be compiled; `pytest tests/envs/test_ids.py -m stress -n auto` checks them all
    *(f"ce_gym/MiniCheetah{task}-v0" for task in ("Run", "Jump", "Backflip")),
    "ce_gym/MiniCheetahVelocity-Armature-v0",
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


@pytest.mark.stress
@pytest.mark.parametrize("env_id", IDS)
def test_the_checkers_of_gymnasium_and_sb3_are_silent(env_id: str):
    """Rendering depends on the robot only, so it is checked with one id of each."""
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(env_id).unwrapped
        check_env(env, skip_render_check=not env_id.endswith("Velocity-v0"))
        sb3.check_env(env)
        env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_spec_survives_json(env_id: str):
    spec = gymnasium.spec(env_id)
    again = EnvSpec.from_json(spec.to_json())
    assert again == spec


def test_an_environment_from_its_spec():
    spec = EnvSpec.from_json(gymnasium.spec("ce_gym/MiniCheetahVelocity-Armature-v0").to_json())
    assert gymnasium.make(spec).unwrapped.model.transmission == "armature"


def test_ids_are_few():
    listed = {env_id for env_id in gymnasium.registry if env_id.startswith("ce_gym/")}
    assert set(IDS) <= listed
    assert len(IDS) <= 160
    assert {re.sub(r"-Armature(?=-v0)", "", env_id) for env_id in IDS} == {i for i in IDS if "-Armature" not in i}


def test_unknown_ids_have_the_error_of_gymnasium():
    with pytest.raises(gymnasium.error.NameNotFound, match=r"doesn't exist in namespace ce_gym\. Did you mean"):
        gymnasium.make("ce_gym/TelloStnd-None-v0")
    with pytest.raises(gymnasium.error.NameNotFound, match="doesn't exist"):
        gymnasium.make("CartPool-None-v0")


@pytest.mark.parametrize("env_id", [env_id for env_id in IDS if "-Armature" not in env_id])
def test_limits_of_the_spec_are_those_of_the_task(env_id: str):
    spec = gymnasium.spec(env_id)
    task = own_task(ce_gym.load_robot(spec.kwargs["robot"]), spec.kwargs["task"])
    assert spec.max_episode_steps == task.episode_length
    assert spec.reward_threshold > 0
    if spec.kwargs["task"] == "velocity":
        assert (spec.kwargs["robot"] in BIPEDS) == ("gait" in task.rewards)


def test_shipped_policies_solve_their_environments():
    """With the arguments of the id; the return is in the card."""
    solved = 0
    for name in ce_gym.shipped_policies():
        record = ce_gym.load_policy(name).record
        if set(record["env_kwargs"]) <= {"transmission"}:
            row = next(line for line in (shelf() / name / "card.md").read_text().splitlines() if "(trained)" in line)
            assert float(row.split("|")[-2]) > gymnasium.spec(record["env"]).reward_threshold, name
            solved += 1
    assert solved >= 15


def test_random_numbers_and_seeds_are_as_gymnasium_keeps_them():
    options = {"transmission": "none", "num_threads": 1}
    for env in (gymnasium.make(VELOCITY, **options).unwrapped, gymnasium.make_vec(VELOCITY, 2, **options).unwrapped):
        env.reset(seed=np.int64(5))
        assert env.np_random_seed == 5
        assert env.np_random.random() == np.random.Generator(np.random.PCG64(5)).random()
        copy = pickle.loads(pickle.dumps(env))
        assert copy.np_random_seed == 5
        assert copy.np_random.random() == env.np_random.random()
        assert type(env).metadata["render_fps"] == env.metadata["render_fps"] == 50
        env.close()


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
