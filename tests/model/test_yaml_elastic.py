"""Elastic transmissions in robot files: what is read, and what is refused in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import Elasticity, RobotError, load_robot
from ce_gym.model.assets import assets_folder
from ce_gym.model.description import Robot

ROBOT = "mit_humanoid_leg"


@pytest.fixture
def read(tmp_path: Path):
    """Return a function that reads a leg whose file has a section more."""

    def load(section: str) -> Robot:
        shutil.copytree(assets_folder() / ROBOT, tmp_path / ROBOT, dirs_exist_ok=True)
        path = tmp_path / ROBOT / f"{ROBOT}.yaml"
        path.write_text((assets_folder() / ROBOT / path.name).read_text() + f"\nelastic: {section}\n")
        return load_robot(path)

    return load


def test_names_and_patterns(read):
    robot = read(
        '{knee_rotor: {stiffness: 3, backlash: 0.1}, "*_r?_rotor": {stiffness: 5}, "*": {stiffness: 7, preload: 2}}'
    )
    belt, gear = Elasticity("ankle_rotor", 7.0, preload=2.0), Elasticity("knee_rotor", 3.0, backlash=0.1)
    hips = [Elasticity(f"hip_{axis}_rotor", 7.0, preload=2.0) for axis in ("rz", "rx", "ry")]
    assert set(robot.elastic) == {belt, gear, *hips}, "a pattern goes before those above it, a name before all"
    assert gear.stretch == "knee_rotor_stretch"
    assert [one.linear for one in (belt, gear, Elasticity("spring", 1.0))] == [False, False, True]


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("{knee_rotor: {}}", "elastic.knee_rotor.stiffness is missing"),
        ("{knee_rotor: {stiffness: 0}}", "elastic.knee_rotor.stiffness is 0.0: expected more than 0"),
        ("{knee_rotor: {stiffness: 1, damping: -1}}", "elastic.knee_rotor.damping is -1.0"),
        ("{knee_rotor: {stiffness: 1, backlash: -1}}", "elastic.knee_rotor.backlash is -1.0"),
        ("{knee_rotor: {stiffness: 1, preload: 0}}", "elastic.knee_rotor.preload is 0.0: expected more than 0"),
        (
            "{knee_rotor: {stiffness: 1, preload: 1, backlash: 1}}",
            "preload is 1.0: expected none where there is backlash",
        ),
        ("{knee_rotor: {stifness: 1}}", "did you mean 'stiffness'"),
        ("{knee_motor: {stiffness: 1}}", "did you mean 'knee_rotor'"),
        ('{"*_motor": {stiffness: 1}}', "a pattern that fits a name"),
        ("{knee_rotor: 3}", "elastic.knee_rotor is 3: expected a mapping"),
    ],
)
def test_mistakes_are_one_line(read, section: str, message: str):
    with pytest.raises(RobotError) as error:
        read(section)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_mjcf_has_no_such_level(read):
    with pytest.raises(RobotError, match="MJCF has no such drives"):
        to_mjcf(read("{knee_rotor: {stiffness: 1}}"), transmission="elastic")
