"""Robots that load but cannot stand or move, files that are repaired, and limits on size."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mjcf_files import body, plain_mjcf

from ce_gym.dynamics import Model
from ce_gym.model import (
    Body,
    Inertial,
    Joint,
    LinearConstraint,
    Placement,
    Robot,
    RobotError,
    check_robot,
    load_robot,
)
from ce_gym.model.checks.robot import MOST_BODIES
from ce_gym.model.formats import text_file
from ce_gym.model.formats.reading import read_yaml


def test_aliases_within_reason_are_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("a: &a {x: 1}\nb: &b {<<: *a, y: 2}\nc: {<<: *b, z: 3}\nd: [*a, *b]\n")
    data = read_yaml(path).data
    assert data["c"] == {"x": 1, "y": 2, "z": 3}
    assert data["d"] == [{"x": 1}, {"x": 1, "y": 2}]


def test_a_file_that_grows_while_it_is_read_is_cut_off(tmp_path, monkeypatch):
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\n" * 100)
    monkeypatch.setattr(text_file, "check_regular", lambda *arguments: None)
    with pytest.raises(RobotError, match="more than 100 bytes"):
        text_file.read_text(path, "a file", largest=100)


def link(name: str, parent: str | None, mass: float = 1.0, **joint) -> Body:
    inertia = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01)) if mass else ((0.0,) * 3,) * 3
    figures = Inertial(mass, (0.0, 0.0, -0.1 if mass else 0.0), inertia)
    return Body(name, "link", parent, Placement(), Joint("revolute", (0.0, 1.0, 0.0), **joint), figures)


def test_parallel_joints_in_one_place_with_nothing_between_them():
    robot = Robot("r", (link("a", None, 0.0), link("b", "a")), independent=("a", "b"))
    with pytest.raises(RobotError, match=r"^r: the mass matrix at the standing pose is not positive definite in a, b"):
        Model(robot)
    moved = Robot("r", (link("a", None), link("b", "a")), independent=("a", "b"))
    assert np.linalg.eigvalsh(Model(moved).mass_matrix([0.0, 0.0]))[0] > 0.0


@pytest.mark.parametrize("ratio", [1e6, 1e9])
def test_a_ratio_that_leaves_no_digits_is_refused(ratio: float):
    """A rotor on one of two joints: the condition number of the mass matrix is about the squared ratio."""
    rotor = Body("rotor", "rotor", None, Placement(), Joint("revolute", (0.0, 1.0, 0.0)), link("x", None).inertial)
    tie = LinearConstraint("gear", (("rotor", 1.0), ("b", -ratio)))
    robot = Robot("r", (link("a", None), link("b", "a"), rotor), (tie,), ("a", "b"))
    if ratio == 1e6:
        Model(robot)
    else:
        with pytest.raises(
            RobotError, match=r"eigenvalues from .* \(a\) to .* \(b\): expected a ratio of at most 1e\+14"
        ):
            Model(robot)


def test_a_differential_of_ratio_1e10_hides_its_links():
    rotor = Body("rotor", "rotor", None, Placement(), Joint("revolute", (0.0, 1.0, 0.0)), link("x", None).inertial)
    for ratio, works in ((10.0, True), (1e10, False)):
        tie = LinearConstraint("gear", (("rotor", 1.0), ("a", -ratio), ("b", -ratio)))
        robot = Robot("r", (link("a", None), link("b", "a"), rotor), (tie,), ("a", "b"))
        if works:
            Model(robot)
        else:
            with pytest.raises(RobotError, match="not positive definite in a, b"):
                Model(robot)


def test_a_standing_pose_beyond_limits(write_robot):
    path = write_robot(("joints: {thigh: 0.1}", "joints: {thigh: 2.5}"))
    with pytest.raises(RobotError, match=r"leg\.yaml: pose\.joints\.thigh is 2\.5: .* -1 to 2"):
        load_robot(path)


def test_joints_that_a_pose_does_not_name_are_within_limits(write_robot, tmp_path):
    limits = ('<axis xyz="0 1 0"/>\n  </joint>', '<axis xyz="0 1 0"/><limit lower="-2" upper="-0.5"/></joint>')
    robot = load_robot(write_robot(limits))
    assert dict(robot.pose.joints) == {"thigh": 0.1, "shank": -0.5}
    alone = write_robot(limits).rename(tmp_path / "other.yaml").with_name("leg.urdf")
    assert dict(load_robot(alone).pose.joints) == {"shank": -0.5}


def test_a_standing_pose_below_ground(write_robot):
    """The hip bends by 0.1 rad, so the ball of the toe is 0.5 cos 0.1 below the base, and 0.02 m further down."""
    right = 0.5 * np.cos(0.1) + 0.02
    with pytest.raises(RobotError, match=rf"leg\.yaml: pose\.height is 0\.3: expected {right:.4f}, .* contact 'toe'"):
        Model(load_robot(write_robot(("height: 0.52", "height: 0.3"))))
    Model(load_robot(write_robot(("height: 0.52", f"height: {right - 0.009}"))))
    for height in ("height: auto, ", ""):
        auto = load_robot(write_robot(("height: 0.52, ", height)))
        assert auto.pose.height == pytest.approx(right, abs=1e-12)
    with pytest.raises(RobotError, match=r"pose\.height is 'lots': expected a number .* or auto"):
        load_robot(write_robot(("height: 0.52", "height: lots")))


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_an_mjcf_file_drawn_below_ground_and_beyond_its_limits_is_lifted_and_moved(write):
    pytest.importorskip("mujoco")
    ball = '<geom name="g" size=".1"/>'
    knee = body("knee", '<joint name="k" axis="0 1 0" range="-2 -1"/>', '<geom size=".1" pos="0 0 -.3"/>')
    world = '<geom type="plane" size="1 1 1"/>' + body("base", "<freejoint/>", ball, knee.replace("<body", "<body"))
    for key, note in (("", "limits, of knee"), ('<keyframe><key qpos="0 0 0 1 0 0 0 -1"/></keyframe>', "under ground")):
        text = f'<mujoco><compiler angle="radian"/><worldbody>{world}</worldbody>{key}</mujoco>'
        robot = load_robot(write(text))
        assert dict(robot.pose.joints) == {"knee": -1.0}
        assert robot.pose.height == pytest.approx(0.3 * math.cos(1.0) + 0.1)
        assert any(note in each for each in robot.notes)
        Model(robot)


def test_too_many_bodies():
    bodies = tuple(link(f"b{i}", f"b{i - 1}" if i else None) for i in range(MOST_BODIES + 1))
    robot = Robot("r", bodies, independent=tuple(b.name for b in bodies))
    with pytest.raises(RobotError, match=f"number of bodies is {MOST_BODIES + 1}"):
        check_robot(robot)


def test_a_summary_of_what_is_left_out_is_short(write):
    pytest.importorskip("mujoco")
    joints = "".join(body(f"b{i}", f'<joint name="j{i}" stiffness="2 1"/>') for i in range(40))
    with pytest.warns(
        UserWarning, match="left out: nonlinear part of the spring of joint j0, j1, j2 and 37 more"
    ) as caught:
        robot = load_robot(write(plain_mjcf(joints)))
    messages = [str(w.message) for w in caught]
    assert len(messages) == 1
    assert len(messages[0]) < 600
    assert "\n" not in messages[0]
    assert sum("spring" in note for note in robot.notes) == 40
