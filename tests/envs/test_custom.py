"""A robot of one's own gets environments under its own ids, or one line that says what it lacks."""

from __future__ import annotations

import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from ce_gym.envs.custom import register_robot, register_task
from ce_gym.envs.runtime import setup
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.tasks import TASKS
from ce_gym.model import RobotError, assets_folder, load_robot
from ce_gym.model.assets import OTHERS

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


@pytest.fixture
def dog(tmp_path: Path):
    """Return a function that writes a copy of a shipped robot, with edits, under another name."""

    def write(*edits: tuple[str, str], name: str = "my-dog") -> Path:
        shutil.copytree(assets_folder() / "mini_cheetah", tmp_path / name, dirs_exist_ok=True)
        path = tmp_path / name / "mini_cheetah.yaml"
        text = path.read_text()
        for old, new in (("name: mini_cheetah", f"name: {name}"), *edits):
            assert old in text
            text = text.replace(old, new)
        path.write_text(text)
        return path

    return write


@pytest.fixture(autouse=True)
def registry():
    """Leave all registries as they were."""
    registries = (gymnasium.registry, setup.KNOWN, OTHERS)
    copies = [dict(each) for each in registries]
    yield
    for each, copy in zip(registries, copies, strict=True):
        each.clear()
        each.update(copy)


def test_every_task_has_an_exact_and_a_simplified_id(dog):
    ids = register_robot(dog())
    assert len(set(ids)) == len(TASKS) * 2
    assert set(ids) >= {"ce_gym/MyDogVelocity-v0", "ce_gym/MyDogVelocity-Armature-v0"}
    assert all(env_id in gymnasium.registry for env_id in ids)
    assert Path(gymnasium.spec(ids[0]).kwargs["robot"]).is_absolute(), "it works from any folder"


def test_the_environment_is_that_robot_s(dog):
    path = dog(("height: ", "height: 0.31 #"))
    ids = register_robot(path, name="flat dog")
    assert ids[0] == "ce_gym/FlatDogVelocity-v0"
    env = gymnasium.make("ce_gym/FlatDogVelocity-v0", transmission="none")
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
    assert not info.get("diverged", False)
    env.close()


def test_limits_follow_the_file(dog):
    ids = register_robot(dog(("\ntasks:", "\ntasks:\n  velocity: {episode_length: 300, rewards: {gait: 0.5}}")))
    spec, other = gymnasium.spec(ids[0]), gymnasium.spec("ce_gym/MiniCheetahVelocity-v0")
    assert (spec.max_episode_steps, other.max_episode_steps) == (300, 1000)
    assert spec.reward_threshold == 2 * other.reward_threshold


def test_twice_is_once_but_another_robot_needs_another_name(dog):
    path = dog()
    assert register_robot(path) == register_robot(str(path))
    other = dog(name="my_dog")
    with pytest.raises(RobotError, match=r"MyDogVelocity-v0'.*expected an id that no other robot has"):
        register_robot(other)
    assert register_robot(other, name="Rex")[0] == "ce_gym/RexVelocity-v0"


def test_a_shipped_robot_s_ids_are_not_taken_over(dog):
    with pytest.raises(RobotError, match="MiniCheetahVelocity"):
        register_robot(dog(), name="mini_cheetah")


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        ([("group: foot", "group: hoof")], "'foot' is missing: expected at least one contact sphere"),
        ([("height: ", "height: -")], "pose.height is -"),
    ],
    ids=["no feet", "no height"],
)
def test_what_a_task_needs_is_said(dog, edits, message):
    with pytest.raises(RobotError) as caught:
        register_robot(dog(*edits))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_fixed_robot_cannot_walk():
    with pytest.raises(RobotError, match="base is 'fixed': expected a floating base"):
        register_robot(assets_folder() / "mit_humanoid_leg" / "mit_humanoid_leg.yaml")


def test_a_name_needs_letters(dog):
    with pytest.raises(RobotError, match="expected a name with letters"):
        register_robot(dog(), name="--")


def test_a_robot_without_knee_spheres_has_every_task(dog):
    path = dog()
    path.write_text("\n".join(line for line in path.read_text().splitlines() if "group: knee" not in line))
    ids = register_robot(path)
    for task in TASKS:
        program = make_program(str(path), task)
        assert {c.group for c in program.model.robot.contacts if c.name in program.contacts} == {"foot"}
        assert f"ce_gym/MyDog{task.capitalize()}-v0" in ids
    with pytest.raises(ValueError, match="contacts='knee'; expected"):
        make_program(str(path), "stand", contacts=["foot", "knee"])


def test_a_registered_robot_has_a_name(dog):
    path = dog()
    register_robot(path, name="rex")
    assert load_robot("rex").source == load_robot(path).source
    with pytest.raises(RobotError, match=r"robot is 'rexx'.*did you mean 'rex'"):
        load_robot("rexx")


def test_a_task_of_one_s_own(dog):
    register_robot(dog(("\ntasks:", "\ntasks:\n  crawl: {episode_length: 200}")).resolve(), name="rex")
    changes = {"rewards": {"base_height": 0}, "command_range": [[0, 0.2], [0, 0], [0, 0]], "episode_length": 500}
    ids = register_task("crawl", robots=["rex", "go1"], reward_threshold=3.0, **changes)
    assert ids == tuple(f"ce_gym/{robot}Crawl{level}-v0" for robot in ("Rex", "Go1") for level in ("", "-Armature"))
    assert [gymnasium.spec(env_id).max_episode_steps for env_id in ids] == [200, 200, 500, 500]
    assert {gymnasium.spec(env_id).reward_threshold for env_id in ids} == {3.0}
    env = gymnasium.make(ids[3]).unwrapped
    task = env.batch.program.task
    assert (env.model.transmission, task.command_range[0]) == ("armature", (0, 0.2))
    assert "base_height" not in task.rewards
    assert register_task("crawl", robots=["rex", "go1"], reward_threshold=3.0, **changes) == ids


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"name": "Crawl", "robots": ["go1"]}, ValueError, "name='Crawl'; expected lower-case letters"),
        ({"name": "crawl", "base": "wlak", "robots": ["go1"]}, ValueError, "base='wlak'; expected one of velocity"),
        ({"name": "crawl", "robots": ["go11"]}, RobotError, "robot is 'go11'"),
        ({"name": "run", "robots": ["go1"]}, ValueError, "name='run'; expected a name that no other task has"),
        ({"name": "crawl", "robots": ["go1"], "histry": 2}, Exception, "histry"),
    ],
)
def test_a_wrong_task_is_not_registered(arguments, error, message):
    before = dict(gymnasium.registry)
    with pytest.raises(error) as caught:
        register_task(**arguments)
    assert message in str(caught.value)
    assert dict(gymnasium.registry) == before
    assert "crawl" not in setup.KNOWN
