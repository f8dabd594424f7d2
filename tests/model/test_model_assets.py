"""The robots that come with the package stand and load as they should, and are found wherever they are installed."""

import math
import os
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import pytest

import ce_gym.model
from ce_gym.model import InertiaWarning, Robot, RobotError, load_robot, robots
from ce_gym.model.checks.robot import _warn_of_inertia, check_robot

NAMES = ["mini_cheetah", "mit_humanoid_leg"]


@pytest.fixture(params=NAMES)
def name(request) -> str:
    return request.param


@pytest.fixture
def robot(name) -> Robot:
    return load_robot(name)


def test_motors_reach_the_joint_torques(robot):
    """Joint torque = sum over its motors of ratio * motor torque, unless a belt couples joints."""
    ratios = {constraint.name: dict(constraint.coefficients) for constraint in robot.constraints}
    for motor in robot.motors:
        links = {link: -ratio for link, ratio in ratios[motor.rotor].items() if link != motor.rotor}
        for link, ratio in links.items():
            alone = sum(link in other for other in ratios.values()) == 1
            if alone and len(links) == 1:
                assert motor.torque * ratio == pytest.approx(robot.body(link).joint.torque, rel=1e-12)
    assert len(robot.motors) == len(list(robot.rotors()))


def test_right_angles_are_exact():
    mini_cheetah = load_robot("mini_cheetah")
    assert mini_cheetah.body("FL_hip_link").placement.rotation == ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))


def test_feet_just_touch_in_the_standing_pose():
    """The planar leg by hand: hip and knee axes are -y of the body, so that the shank hangs at hip + knee."""
    mini_cheetah = load_robot("mini_cheetah")
    angles = dict(mini_cheetah.pose.joints)
    for foot in (contact for contact in mini_cheetah.contacts if contact.group == "foot"):
        leg = foot.name[:2]
        thigh, shank = angles[f"{leg}_hip_link"], angles[f"{leg}_hip_link"] + angles[f"{leg}_knee_link"]
        height = mini_cheetah.pose.height - 0.209 * math.cos(thigh) + foot.position[2] * math.cos(shank)
        assert height == pytest.approx(foot.radius, abs=1e-6)
    assert sorted({contact.group for contact in mini_cheetah.contacts}) == ["foot", "knee", "torso"]
    assert len(mini_cheetah.contacts) == 4 + 4 + 8


def test_second_load_is_equal_and_hashes_alike(name):
    first, second = load_robot(name), load_robot(name)
    assert first is not second
    assert first == second
    assert hash(first) == hash(second)
    assert set(NAMES) <= set(robots())


def test_impossible_inertia_is_warned_about_once_unless_it_is_kept_knowingly():
    robot = load_robot("mini_cheetah")
    unknowing = replace(robot, kept_inertia=("H*_hip_link",))
    _warn_of_inertia.cache_clear()
    with pytest.warns(InertiaWarning, match=r"mini_cheetah: the inertia of FR_hip_link, FL_hip_link violates"):
        check_robot(unknowing)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_robot(unknowing)
        _warn_of_inertia.cache_clear()
        check_robot(robot)


def test_no_robot_that_is_shipped_warns():
    _warn_of_inertia.cache_clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in robots():
            load_robot(name)


def test_inertia_that_is_kept_must_be_impossible():
    with pytest.raises(RobotError, match=r"kept_inertia is 'HR_knee_link': expected one of HR_hip_link"):
        check_robot(replace(load_robot("mini_cheetah"), kept_inertia=("HR_knee_link",)))


@pytest.mark.parametrize("inside", [True, False], ids=["wheel", "checkout"])
def test_assets_are_found_in_a_wheel_and_in_a_checkout(tmp_path, inside):
    package = Path(ce_gym.model.__file__).parents[1]
    shutil.copytree(package / "model", tmp_path / "ce_gym" / "model")
    (tmp_path / "ce_gym" / "__init__.py").touch()  # else an installed package would come first
    source = ce_gym.model.assets_folder()
    shutil.copytree(source, tmp_path / "ce_gym" / "assets" if inside else tmp_path / "assets")
    code = "import ce_gym.model as m; print(m.__file__, m.robots(), m.load_robot('mit_humanoid_leg').source)"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    result = subprocess.run(
        [sys.executable, "-P", "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert all(name in result.stdout for name in NAMES)
    assert result.stdout.count(str(tmp_path)) == 2
