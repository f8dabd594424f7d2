"""Feet, trunk, wheels, limits and gains that `python -m ce_gym new` finds, on small robots made here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym.diagnostics.robot import findings
from ce_gym.dynamics import Model
from ce_gym.dynamics.standing import contact_heights, standing_pose
from ce_gym.dynamics.standing_load import load_of
from ce_gym.envs.runtime.setup import make_program
from ce_gym.model import load_robot
from ce_gym.model.description import Robot
from ce_gym.new_robot.robot_file import write_new_robot

INERTIA = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'
THIGH, SHANK, BALL = 0.3, 0.25, 0.03


def link(name: str, mass: float = 0.0, shapes: str = "", com: str = "0 0 0") -> str:
    inertial = f'<inertial><origin xyz="{com}"/><mass value="{mass}"/>{INERTIA}</inertial>' if mass else ""
    return f'<link name="{name}">{inertial}{shapes}</link>'


def joint(parent: str, child: str, at: str, kind: str = "fixed", limit: str = "-2 2 40", axis: str = "0 1 0") -> str:
    lower, upper, effort = limit.split()
    limits = f'<limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="20"/>' if kind != "fixed" else ""
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/><axis xyz="{axis}"/>'
    return f'<joint name="{child}_joint" type="{kind}">{ends}{limits}</joint>'


def shape(geometry: str, at: str = "0 0 0", tag: str = "collision") -> str:
    return f'<{tag}><origin xyz="{at}"/><geometry>{geometry}</geometry></{tag}>'


def write_mesh(path: Path, size: tuple[float, float, float], centre: tuple[float, float, float]) -> str:
    """Write the twelve triangles of a box as an OBJ file, and return the element that names it."""
    signs = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    corners = [[c + s * e / 2 for c, s, e in zip(centre, sign, size, strict=True)] for sign in signs]
    faces = ["1 2 4", "1 4 3", "5 7 8", "5 8 6", "1 5 6", "1 6 2", "3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4"]
    lines = [f"v {' '.join(map(str, corner))}" for corner in corners] + [f"f {face}" for face in faces]
    path.write_text("\n".join(lines))
    return f'<mesh filename="{path.name}"/>'


def quadruped(offset: float = 0.05, effort: str = "40", foot: str = "", shin: str = "") -> str:
    """Return a URDF whose trunk is a link on a fixed joint; feet are `offset` before or behind the line of the leg."""
    box = shape('<box size="0.6 0.2 0.12"/>', "0.01 0 0.02")
    parts = [link("base", 1.0, shape('<box size="0.001 0.001 0.001"/>', tag="visual")), link("body", 7.0, box)]
    parts.append(joint("base", "body", "0 0 0.04"))
    limit = f"-3 3 {effort}"
    for leg, x, y in (("fl", 0.25, 0.1), ("fr", 0.25, -0.1), ("hl", -0.25, 0.1), ("hr", -0.25, -0.1)):
        parts += [link(f"{leg}_upper", 0.5, com="0 0 -0.1"), link(f"{leg}_lower", 0.3, shin, "0.02 0.01 -0.08")]
        parts += [link(f"{leg}_foot", shapes=foot), joint("body", f"{leg}_upper", f"{x} {y} 0", "revolute", limit)]
        parts.append(joint(f"{leg}_upper", f"{leg}_lower", f"0 0 -{THIGH}", "revolute", limit))
        parts.append(joint(f"{leg}_lower", f"{leg}_foot", f"{np.copysign(offset, x)} 0 -{SHANK}"))
    return f'<robot name="quad">{"".join(parts)}</robot>'


def new(folder: Path, urdf: str) -> tuple[Robot, str, tuple[str, ...]]:
    """Return the robot of a new YAML file, the text of the file, and the lines to check."""
    (folder / "r.urdf").write_text(urdf)
    path, robot, guesses = write_new_robot(folder / "r.urdf")
    return robot, path.read_text(), guesses.warnings


def foot_heights(robot: Robot) -> list[float]:
    standing = standing_pose(Model(robot).mechanism)
    heights = contact_heights(robot, standing)
    return [heights[c.name] for c in robot.contacts if c.group == "foot"]


def test_mirrored_legs_all_have_a_foot_on_the_ground(tmp_path):
    """Bent the same way, the hind feet would be higher than the front feet."""
    robot, text, warnings = new(tmp_path, quadruped(foot=shape(f'<sphere radius="{BALL}"/>')))
    feet = [c for c in robot.contacts if c.group == "foot"]
    assert [(c.name, c.radius) for c in feet] == [(f"{leg}_foot", BALL) for leg in ("fl", "fr", "hl", "hr")]
    assert foot_heights(robot) == pytest.approx([0.0] * 4, abs=1e-6)
    assert warnings == ()
    angles = {joint.name: dict(robot.pose.joints)[joint.name] for joint in robot.bodies[1:]}
    assert angles["fl_lower"] == pytest.approx(-angles["hl_lower"], abs=1e-5)
    assert abs(angles["fl_lower"]) > 0.5
    hips = {leg: standing_pose(Model(robot).mechanism).p[f"{leg}_upper"][0] for leg in ("fl", "hl")}
    points = Model(robot).contact_points(robot.standing_q, np.zeros(14))[0]
    assert points[0, 0] == pytest.approx(hips["fl"], abs=1e-4), "feet are below hips"
    assert points[2, 0] == pytest.approx(hips["hl"], abs=1e-4)
    length = THIGH + np.hypot(0.05, SHANK)
    assert robot.pose.height == pytest.approx(0.87 * length + BALL - 0.04, abs=1e-4), "the body is above the base"
    assert "height: auto" in text
    assert "the collision sphere of 'fl_foot'" in text


def test_the_trunk_is_the_box_around_the_shapes_of_all_links_fixed_to_the_base(tmp_path):
    robot, _, _ = new(tmp_path, quadruped(foot=shape(f'<sphere radius="{BALL}"/>')))
    corners = np.array([c.position for c in robot.contacts if c.group == "torso"])
    np.testing.assert_allclose([corners.min(0), corners.max(0)], [[-0.29, -0.1, 0.0], [0.31, 0.1, 0.12]], atol=1e-9)


def test_a_foot_without_shapes_is_at_its_frame_and_reported(tmp_path):
    robot, text, warnings = new(tmp_path, quadruped())
    assert [c.position for c in robot.contacts[:4]] == [(x, 0.0, -SHANK) for x in (0.05, 0.05, -0.05, -0.05)]
    assert [line.split(":")[0] for line in warnings] == [f"contact '{leg}_foot'" for leg in ("fl", "fr", "hl", "hr")]
    assert "the origin of frame 'fl_foot'" in text
    assert text.index("# Check first:") < text.index("contacts:")


@pytest.mark.parametrize("tag", ["collision", "visual"])
def test_a_sole_has_the_corners_of_its_mesh(tmp_path, tag):
    """The mesh is on the shank, whose frame `sole` has no shape; ankles keep the sole flat while knees bend."""
    pytest.importorskip("trimesh")
    mesh = write_mesh(tmp_path / "sole.obj", (0.2, 0.08, 0.02), (0.03, 0.0, -0.05))
    parts = [link("base", 8.0, shape('<box size="0.2 0.3 0.3"/>'))]
    for side, y in (("l", 0.1), ("r", -0.1)):
        parts += [link(f"{side}_thigh", 1.0), link(f"{side}_shin", 0.6), link(f"{side}_end", 0.4, shape(mesh, tag=tag))]
        parts += [link(f"{side}_sole"), joint(f"{side}_end", f"{side}_sole", "0.03 0 -0.06")]
        parts.append(joint("base", f"{side}_thigh", f"0 {y} -0.2", "revolute"))
        parts.append(joint(f"{side}_thigh", f"{side}_shin", "0 0 -0.3", "revolute", "-2 2 40"))
        parts.append(joint(f"{side}_shin", f"{side}_end", "0 0 -0.3", "revolute", "-1 1 40"))
    robot, text, warnings = new(tmp_path, f'<robot name="biped">{"".join(parts)}</robot>')
    corners = sorted(c.position for c in robot.contacts if c.body == "l_end")
    assert corners == [(x, y, -0.06) for x in (-0.07, 0.13) for y in (-0.04, 0.04)]
    assert foot_heights(robot) == pytest.approx([0.0] * 8, abs=1e-5)
    thigh, shin, end = (dict(robot.pose.joints)[f"l_{name}"] for name in ("thigh", "shin", "end"))
    assert shin > 0.3, "knees point forward"
    assert thigh + shin + end == pytest.approx(0.0, abs=1e-5), "soles stay flat"
    assert warnings == ()
    assert f"{tag} mesh of 'l_end'" in text
    task = make_program(tmp_path / "r.yaml", "velocity", transmission="none").task
    assert "gait_phase" in task.observations
    assert task.command_range[0][1] < 1.0


def test_wheels_roll(tmp_path):
    wheel = '<collision><origin xyz="0 0.02 0" rpy="1.5707963 0 0"/><geometry><cylinder radius="0.07" length="0.04"/>'
    parts = [link("base", 5.0, shape('<box size="0.3 0.2 0.1"/>'))]
    for side, y in (("l", 0.1), ("r", -0.1)):
        parts += [link(f"{side}_wheel", 0.3, f"{wheel}</geometry></collision>")]
        parts.append(joint("base", f"{side}_wheel", f"0 {y} -0.1", "continuous"))
    robot, text, _ = new(tmp_path, f'<robot name="cart">{"".join(parts)}</robot>')
    rims = [c for c in robot.contacts if c.body == "l_wheel"]
    assert {c.rim for c in rims} == {0.07}
    assert sorted(c.position[1] for c in rims) == pytest.approx([0.0, 0.04], abs=1e-6)
    assert robot.pose.height == pytest.approx(0.17, abs=1e-5)
    assert "rolls: true" in text
    assert "gait_phase" not in make_program(tmp_path / "r.yaml", "velocity", transmission="none").task.observations


def test_a_leg_without_a_foot_is_reported(tmp_path):
    """Without the name of a foot on the last leg, its lowest link is not taken for a foot in silence."""
    urdf = quadruped(foot=shape(f'<sphere radius="{BALL}"/>')).replace("hr_foot", "hr_tip")
    robot, _, warnings = new(tmp_path, urdf)
    assert sum(c.group == "foot" for c in robot.contacts) == 3
    assert any("'hr_upper' is like a leg and has no foot" in line for line in warnings)


def test_placeholders_of_torque_are_replaced_and_gains_hold_the_load(tmp_path):
    foot = shape(f'<sphere radius="{BALL}"/>')
    robot, text, _ = new(tmp_path, quadruped(effort="1000", foot=foot))
    model = Model(robot)
    load = load_of(model.mechanism, standing_pose(model.mechanism), [c for c in robot.contacts if c.group == "foot"])
    assert {robot.body(joint).joint.torque for joint in robot.driven} == {float(f"{0.75 * load.toppling:.2g}")}
    assert "limits of the file (1000) are placeholders" in text
    kp = dict(robot.gains.kp)
    assert all(kp[joint] >= 0.99 * abs(load.torques[joint]) / 0.15 for joint in robot.driven), "sag below 0.15 rad"
    assert sum(kp[f"{leg}_lower"] for leg in ("fl", "fr", "hl", "hr")) > load.toppling
    assert not [line for line in findings(model, standing_pose(model.mechanism), load) if "torque" in line]
    (tmp_path / "strong").mkdir()
    strong, text, _ = new(tmp_path / "strong", quadruped(effort="40", foot=foot))
    assert strong.body("fl_upper").joint.torque == 40.0
    assert "limits:" not in text


def test_commands_scale_by_froude(tmp_path):
    """Speeds are shares of sqrt(g h)."""
    robot, _, _ = new(tmp_path, quadruped(foot=shape(f'<sphere radius="{BALL}"/>')))
    model = Model(robot)
    load = load_of(model.mechanism, standing_pose(model.mechanism), [c for c in robot.contacts if c.group == "foot"])
    forward = dict(dict(robot.tasks)["velocity"])["command_range"][0]
    assert forward[1] == pytest.approx(0.55 * np.sqrt(9.81 * load.height), rel=0.05)  # written with two digits
    assert load_robot(tmp_path / "r.yaml").tasks == robot.tasks
