"""`python -m ce_gym new`: what it guesses of a URDF and of an MJCF file, and that the file it writes is complete."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from mjcf_files import GEOMS

from ce_gym.__main__ import main, run
from ce_gym.dynamics import Model
from ce_gym.envs.custom import missing
from ce_gym.model import RobotError, load_robot
from ce_gym.new_robot.picture import marks_of, write_picture
from ce_gym.new_robot.robot_file import write_new_robot
from ce_gym.viewer.raytrace.picture import Picture

PUP = Path(__file__).parents[1] / "data" / "own_robot" / "pup.urdf"


@pytest.fixture
def pup(tmp_path):
    return Path(shutil.copy(PUP, tmp_path))


def test_a_urdf_becomes_a_robot_that_tasks_can_use(pup):
    path, robot, _ = write_new_robot(pup)
    assert path == pup.with_suffix(".yaml")
    assert not missing(robot)
    feet = {c.body: (c.position, c.radius) for c in robot.contacts if c.group == "foot"}
    assert feet == {f"{leg}_shank": ((0.0, 0.0, -0.16), 0.02) for leg in ("fl", "fr", "hl", "hr")}
    assert len([c for c in robot.contacts if c.group == "torso"]) == 8
    angles = dict(robot.pose.joints)
    assert {angles[f"{leg}_shank"] for leg in ("fl", "fr", "hl", "hr")} == {-2 * angles["fl_thigh"]}, "as limits allow"
    assert np.cos(angles["fl_thigh"]) == pytest.approx(0.87, abs=0.03), "thigh and shank are equally long"
    model = Model(robot)
    points = model.contact_points(model.standing_q, np.zeros(model.nv))[0]
    lowest = min(z - c.radius for c, z in zip(robot.contacts, points[:, 2], strict=True))
    assert lowest == pytest.approx(0.0, abs=1e-6)
    assert robot.body("fl_thigh").joint.torque == 16.0


def test_rotors_are_there_to_be_filled_in(pup):
    """The template's lines, without their #, are a robot with a rotor at every joint."""
    path, robot, _ = write_new_robot(pup)
    assert not list(robot.rotors())
    text = path.read_text()
    lines = [line for line in text.splitlines() if line == "# rotors:" or line.startswith("#   ")]
    assert len(lines) == 1 + len(robot.independent)
    for line in lines:
        text = text.replace(line, line.removeprefix("# "), 1)
    path.write_text(text)
    assert [rotor.name for rotor in load_robot(path).rotors()] == [f"{joint}_rotor" for joint in robot.joint_names]


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_an_mjcf_file_keeps_what_it_says(tmp_path):
    pytest.importorskip("mujoco")
    actuator = '<actuator><motor joint="hip" ctrlrange="-6 6"/></actuator>'
    key = '<keyframe><key qpos="0 0 0.6 1 0 0 0 0.25"/></keyframe>'
    start = '<mujoco model="m"><compiler angle="radian" autolimits="true"/>'
    (tmp_path / "hopper.xml").write_text(f"{start}{GEOMS}{actuator}{key}</mujoco>")
    _, robot, _ = write_new_robot(tmp_path / "hopper.xml", tmp_path / "other.yaml")
    assert robot.contacts == load_robot(tmp_path / "hopper.xml").contacts
    assert robot.pose.joints == (("leg", 0.25),)
    assert robot.pose.height == pytest.approx(0.4 * np.cos(0.25) + 0.02, abs=1e-5), "feet just touch"


def test_a_picture_shows_the_contacts(pup, tmp_path):
    """Without the red and orange marks, the picture of the robot has neither colour."""
    pytest.importorskip("embreex")
    _, robot, _ = write_new_robot(pup)
    model = Model(robot)
    bare, marked = (Picture(model, model.standing_q, marks=marks) for marks in (None, marks_of(robot)))
    red, bare_red = (
        (drawn[..., 0] > 3.0 * drawn[..., 1:].max(-1)).sum()
        for drawn in (picture.draw(model.standing_q).astype(float) for picture in (marked, bare))
    )
    assert red > 100 > bare_red
    assert write_picture(tmp_path / "pup.png", robot)
    assert (tmp_path / "pup.png").read_bytes().startswith(b"\x89PNG")


def test_a_warning_is_printed_once(capsys):
    def work() -> int:
        for _ in range(3):
            warnings.warn("the same", stacklevel=1)
        warnings.warn("another", stacklevel=1)
        return 0

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run(work) == 0
    assert capsys.readouterr().err == "ce_gym: warning: the same\nce_gym: warning: another\n"


def test_what_it_refuses(pup, tmp_path, capsys):
    for argv, message in (
        ([str(pup)], "pup.yaml: exists already; expected another name, or --force"),
        ([str(pup), "--out", str(pup), "--force"], "pup.urdf: the command reads this file"),
    ):
        pup.with_suffix(".yaml").touch()
        assert main(["new", *argv]) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(RobotError, match=r"file type '\.yaml': expected a file that ends in \.urdf or \.xml"):
        write_new_robot(pup.with_suffix(".yaml"), tmp_path / "x.yaml")


def test_the_command_says_how_to_go_on(pup, capsys):
    assert main(["new", str(pup)]) == 0
    out = capsys.readouterr().out
    assert "8 joints, 12 contact spheres" in out
    assert "train my_robots:ce_gym/PupVelocity-v0" in out
    assert ("a picture" in out) == pup.with_suffix(".png").is_file()
    assert main(["inspect", str(pup.with_suffix(".yaml")), "--no-errors"]) == 0
    assert "Environments: it has what every task needs" in capsys.readouterr().out
    assert main(["inspect", "mit_humanoid_leg", "--no-errors"]) == 0
    assert "a floating base, because tasks are about walking" in capsys.readouterr().out
