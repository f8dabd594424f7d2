"""Dry friction and bandwidth of motors in robot files: what is read, and what is refused in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ce_gym.model import DriveFriction, Motor, RobotError, load_robot
from ce_gym.model.assets import assets_folder

ROBOT = "mit_humanoid_leg"


@pytest.fixture
def read(tmp_path: Path):
    """Return a function that reads a leg whose knee has another friction."""

    def load(friction: str) -> Motor:
        shutil.copytree(assets_folder() / ROBOT, tmp_path / ROBOT, dirs_exist_ok=True)
        path = tmp_path / ROBOT / f"{ROBOT}.yaml"
        lines = [
            line if not line.strip().startswith("knee_rotor: {torque") else f"  knee_rotor: {{friction: {friction}}}"
            for line in path.read_text().splitlines()
        ]
        path.write_text("\n".join(lines))
        return next(motor for motor in load_robot(path).motors if motor.rotor == "knee_rotor")

    return load


def test_a_bandwidth(read):
    assert read("0, bandwidth: 50") == Motor("knee_rotor", bandwidth=50.0)


def test_a_number_or_a_mapping(read):
    assert read("0.02") == Motor("knee_rotor", friction=0.02)
    assert read("{coulomb: 0.02}") == Motor("knee_rotor", friction=0.02)
    drive = DriveFriction(0.01, 5.0, load_motor=0.1, load_external=0.1, stribeck_load_motor=0.2)
    text = "{stribeck: 0.01, stribeck_speed: 5, load: 0.1, stribeck_load_motor: 0.2}"
    assert read(text) == Motor("knee_rotor", drive_friction=drive)
    assert drive.loaded
    assert not DriveFriction(0.01, 5.0).loaded
    assert DriveFriction(backdriving_efficiency=0.0).loaded


@pytest.mark.parametrize(
    ("friction", "message"),
    [
        ("-1", "motors.knee_rotor.friction is -1.0"),
        ("{coulomb: -1}", "motors.knee_rotor.friction is -1.0"),
        ("{colomb: 1}", "did you mean 'coulomb'"),
        ("{load: 0.1, load_motor: 0.1}", "motors.knee_rotor.friction.load_motor is 0.1: expected none beside 'load'"),
        ("{load_motor: -0.1}", "motors.knee_rotor.friction.load_motor is -0.1"),
        ("{stribeck: 0.1}", "motors.knee_rotor.friction.stribeck_speed is missing"),
        ("{stribeck: 0.1, stribeck_speed: 0}", "stribeck_speed is 0.0: expected more than 0"),
        ("{efficiency: 0}", "motors.knee_rotor.friction.efficiency is 0.0"),
        ("{backdriving_efficiency: 1.5}", "motors.knee_rotor.friction.backdriving_efficiency is 1.5"),
        ("0, bandwidth: 0", "motors.knee_rotor.bandwidth is 0.0: expected more than 0 [Hz]"),
        ("[0.1]", "motors.knee_rotor.friction is [0.1]"),
    ],
)
def test_mistakes_are_one_line(read, friction: str, message: str):
    with pytest.raises(RobotError) as error:
        read(friction)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
