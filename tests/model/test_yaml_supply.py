"""Heat and cogging of motors and a battery in robot files: what is read, and what is refused in one line."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from ce_gym.model import Battery, Heat, Robot, RobotError, load_robot
from ce_gym.model.assets import assets_folder
from ce_gym.model.formats.motor_library import motor_types

ROBOT = "mit_humanoid_leg"
HEAT = "winding_capacity: 16, housing_capacity: 500, winding_to_housing: 1, housing_to_ambient: 2"
KNOWN = "torque: 3, velocity: 200, motor_constant: 0.15"


@pytest.fixture
def read(tmp_path: Path):
    """Return a function that reads a leg with other motors and more beside them."""

    def load(knee: str, more: str = "") -> Robot:
        shutil.copytree(assets_folder() / ROBOT, tmp_path / ROBOT, dirs_exist_ok=True)
        path = tmp_path / ROBOT / f"{ROBOT}.yaml"
        text = re.sub(r"(?m)^motors:\n(  .*\n)*", f"motors:\n  knee_rotor: {{{knee}}}\n", path.read_text())
        path.write_text(f"{text}\n{more}\n")
        return load_robot(path)

    return load


def test_figures_are_read(read):
    robot = read(
        f"{KNOWN}, heat: {{{HEAT}, hot: 130}}, cogging: [[12, 0.02, 0.5], [84, 0.01]]",
        "battery: {voltage: 24, resistance: 0.1}",
    )
    (motor,) = robot.motors
    assert motor.heat == Heat(16, 500, 1, 2, hot=130)
    assert motor.cogging == ((12, 0.02, 0.5), (84, 0.01, 0.0))
    assert motor.motor_constant == 0.15
    assert robot.battery == Battery(24, 0.1, 24, 0)


def test_heat_of_the_library_is_asked_for(read):
    entry = motor_types()["mit_mini_cheetah"]
    (plain,), (warm,) = (read(f"use: mit_mini_cheetah{more}").motors for more in ("", ", heat: library"))
    assert plain.heat is None
    assert (
        plain.motor_constant == entry.motor_constant == pytest.approx(0.05 * (1.5 / entry.resistance) ** 0.5, abs=1e-4)
    )
    assert warm.heat == entry.heat


@pytest.mark.parametrize(
    ("knee", "more", "message"),
    [
        (f"torque: 3, heat: {{{HEAT}}}", "", "motors.knee_rotor.motor_constant is missing"),
        (f"motor_constant: 1, heat: {{{HEAT}}}", "", "motors.knee_rotor.torque is missing"),
        (f"{KNOWN}, heat: {{{HEAT}, hot: 90}}", "", "motors.knee_rotor.heat.hot is 90.0: expected more than"),
        (f"{KNOWN}, heat: {{{HEAT}, hat: 90}}", "", "did you mean 'hot'"),
        (f"{KNOWN}, heat: {{winding_capacity: 3}}", "", "motors.knee_rotor.heat"),
        (f"{KNOWN}, heat: library", "", "motors.knee_rotor.heat is 'library': expected figures, or `use`"),
        ("use: unitree_4010, heat: library", "", "motors.knee_rotor.heat is 'library'"),
        (f"{KNOWN}, cogging: [[0.5, 0.1]]", "", "motors.knee_rotor.cogging[0][0] is 0.5: expected a whole number"),
        (f"{KNOWN}, cogging: [[12, -0.1]]", "", "motors.knee_rotor.cogging[0][1] is -0.1"),
        (f"{KNOWN}, cogging: [12, 0.1]", "", "motors.knee_rotor.cogging[0] is 12: expected order in a turn"),
        (KNOWN, "battery: {voltage: 0, resistance: 1}", "battery.voltage is 0.0: expected more than 0 [V]"),
        (KNOWN, "battery: {voltage: 24}", "battery.resistance is missing"),
        (KNOWN, "battery: {voltage: 24, resistance: -1}", "battery.resistance is -1.0"),
        ("torque: 3, motor_constant: 1", "battery: {voltage: 24, resistance: 1}", "knee_rotor.velocity is missing"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(read, knee, more, message):
    with pytest.raises(RobotError, match=re.escape(message)) as caught:
        read(knee, more)
    assert "\n" not in str(caught.value)
