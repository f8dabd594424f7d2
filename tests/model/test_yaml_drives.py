"""Motors, elastic transmissions and a battery in robot files; `error_cases.yaml` has the mistakes."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import Battery, DriveFriction, Elasticity, Heat, Motor, Robot, RobotError, load_robot
from ce_gym.model.assets import assets_folder
from ce_gym.model.formats.motor_library import motor_types

ROBOT = "mit_humanoid_leg"
HEAT = "winding_capacity: 16, housing_capacity: 500, winding_to_housing: 1, housing_to_ambient: 2"


@pytest.fixture
def read(tmp_path: Path):
    """Return a function that reads a leg with another motor at the knee, and more keys."""

    def load(knee: str, more: str = "") -> Robot:
        shutil.copytree(assets_folder() / ROBOT, tmp_path / ROBOT, dirs_exist_ok=True)
        path = tmp_path / ROBOT / f"{ROBOT}.yaml"
        text = re.sub(r"(?m)^motors:\n(  .*\n)*", f"motors:\n  knee_rotor: {{{knee}}}\n", path.read_text())
        path.write_text(f"{text}\n{more}\n")
        return load_robot(path)

    return load


def test_heat_cogging_and_a_battery(read):
    robot = read(
        f"torque: 3, velocity: 200, motor_constant: 0.15, heat: {{{HEAT}, hot: 130}}, "
        "cogging: [[12, 0.02, 0.5], [84, 0.01]]",
        "battery: {voltage: 24, resistance: 0.1}",
    )
    (motor,) = robot.motors
    assert motor.heat == Heat(16, 500, 1, 2, hot=130)
    assert motor.cogging == ((12, 0.02, 0.5), (84, 0.01, 0.0))
    assert motor.motor_constant == 0.15
    assert robot.battery == Battery(24, 0.1, 24, 0)


def test_heat_of_the_library_is_optional(read):
    entry = motor_types()["mit_mini_cheetah"]
    (plain,), (warm,) = (read(f"use: mit_mini_cheetah{more}").motors for more in ("", ", heat: library"))
    assert plain.heat is None
    constant = 0.05 * (1.5 / entry.resistance) ** 0.5
    assert plain.motor_constant == entry.motor_constant == pytest.approx(constant, abs=1e-4)
    assert warm.heat == entry.heat


def test_friction_is_a_number_or_a_mapping(read):
    drive = DriveFriction(0.01, 5.0, load_motor=0.1, load_external=0.1, stribeck_load_motor=0.2)
    for text, motor in (
        ("friction: 0, bandwidth: 50", Motor("knee_rotor", bandwidth=50.0)),
        ("friction: 0.02", Motor("knee_rotor", friction=0.02)),
        ("friction: {coulomb: 0.02}", Motor("knee_rotor", friction=0.02)),
        (
            "friction: {stribeck: 0.01, stribeck_speed: 5, load: 0.1, stribeck_load_motor: 0.2}",
            Motor("knee_rotor", drive_friction=drive),
        ),
    ):
        assert read(text).motors == (motor,)
    assert drive.loaded
    assert not DriveFriction(0.01, 5.0).loaded
    assert DriveFriction(backdriving_efficiency=0.0).loaded


def test_names_and_patterns_of_elastic_transmissions(read):
    robot = read(
        "torque: 1",
        "elastic: {knee_rotor: {stiffness: 3, backlash: 0.1}, "
        '"*_r?_rotor": {stiffness: 5}, "*": {stiffness: 7, preload: 2}}',
    )
    belt, gear = Elasticity("ankle_rotor", 7.0, preload=2.0), Elasticity("knee_rotor", 3.0, backlash=0.1)
    hips = [Elasticity(f"hip_{axis}_rotor", 7.0, preload=2.0) for axis in ("rz", "rx", "ry")]
    assert set(robot.elastic) == {belt, gear, *hips}, "a pattern goes before those above it, a name before all"
    assert gear.stretch == "knee_rotor_stretch"
    assert [one.linear for one in (belt, gear, Elasticity("spring", 1.0))] == [False, False, True]
    with pytest.raises(RobotError, match="MJCF has no such drives"):
        to_mjcf(robot, transmission="elastic")
