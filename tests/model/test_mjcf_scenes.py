"""MJCF in several files, and keyframes: what is read, and what the message says if a part is missing."""

from __future__ import annotations

import re

import numpy as np
import pytest

from ce_gym.model import RobotError, load_robot

pytest.importorskip("mujoco")

LEG = '<body name="leg"><joint name="hip" axis="0 1 0"/><geom name="shin" size=".05" pos="0 0 -.4"/></body>'
TRUNK = f'<body name="trunk" pos="0 0 .45"><freejoint/><geom name="hull" size=".1"/>{LEG}</body>'
FLOOR = '<geom name="floor" type="plane" size="0 0 1" friction="0.7"/>'
ROBOT = f"<mujoco><worldbody>{TRUNK}</worldbody></mujoco>"
NEEDY = ROBOT.replace("</mujoco>", '<contact><pair geom1="floor" geom2="shin"/></contact></mujoco>')
SCENE = f'<mujoco>{{}}<include file="robot.xml"/><worldbody>{FLOOR}</worldbody></mujoco>'


def test_a_scene_that_includes_its_robot_is_the_robot(tmp_path):
    (tmp_path / "robot.xml").write_text(NEEDY)
    (tmp_path / "scene.xml").write_text(SCENE.format(""))
    robot = load_robot(tmp_path / "scene.xml")
    assert [body.name for body in robot.bodies] == ["trunk", "leg"]
    assert robot.material.friction == 1.0  # of the pair: the larger of the two


@pytest.mark.parametrize("name", ["dog", ""])
@pytest.mark.parametrize("scene", ["dog scene", "scene", ""])
def test_a_scene_has_the_name_of_its_robot(tmp_path, name, scene):
    def model(text: str, name: str) -> str:
        return text.replace("<mujoco>", f'<mujoco model="{name}">') if name else text

    (tmp_path / "light.xml").write_text('<mujoco model="light"><worldbody><light pos="0 0 3"/></worldbody></mujoco>')
    (tmp_path / "robot.xml").write_text(model(ROBOT, name))
    (tmp_path / "scene.xml").write_text(model(SCENE.format('<include file="light.xml"/>'), scene))
    assert load_robot(tmp_path / "scene.xml").name == (name or "robot")
    assert load_robot(tmp_path / "robot.xml").name == (name or "robot")


def test_a_scene_that_attaches_its_robot_is_the_robot(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOT)
    attach = f'{FLOOR}<frame pos="0 0 1"><attach model="robot" prefix="my_"/></frame>'
    text = f'<mujoco><asset><model name="robot" file="robot.xml"/></asset><worldbody>{attach}</worldbody></mujoco>'
    (tmp_path / "scene.xml").write_text(text)
    robot = load_robot(tmp_path / "scene.xml")
    assert [body.name for body in robot.bodies] == ["my_trunk", "my_leg"]
    assert robot.pose.height == 1.45


@pytest.mark.parametrize("scene", ["scene.xml", "flat scene.xml"])
@pytest.mark.parametrize("text", [NEEDY, f"<mujocoinclude><worldbody>{TRUNK}</worldbody></mujocoinclude>"])
def test_a_robot_that_needs_its_scene_says_which(tmp_path, scene, text):
    (tmp_path / "robot.xml").write_text(text)
    (tmp_path / "other.xml").write_text("<mujoco/>")
    (tmp_path / scene).write_text(SCENE.format(""))
    with pytest.raises(RobotError, match=rf"MuJoCo refuses .*; it is a part of {re.escape(scene)}: read that$"):
        load_robot(tmp_path / "robot.xml")


def test_a_robot_that_cannot_be_read_for_other_reasons_has_no_hint(tmp_path):
    (tmp_path / "robot.xml").write_text(NEEDY.replace("shin", "missing", 1))
    (tmp_path / "scene.xml").write_text(SCENE.format(""))
    with pytest.raises(RobotError, match=r"refuses the file: expected valid MJCF \([^)]*\)$"):
        load_robot(tmp_path / "robot.xml")


def test_a_scene_without_its_robot_says_where_it_may_be(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "scene.xml").write_text(f"<mujoco><worldbody>{FLOOR}</worldbody></mujoco>")
    with pytest.raises(RobotError, match=r"bodies that move is \(\): .* a scene for the robot in robot.xml"):
        load_robot(tmp_path / "scene.xml")
    (tmp_path / "robot.xml").write_text("<mujoco><default><joint/></default></mujoco>")
    with pytest.raises(RobotError, match=r"expected at least one body with a joint$"):
        load_robot(tmp_path / "scene.xml")


def keyframe(quaternion) -> str:
    values = " ".join(str(x) for x in quaternion)
    key = f'<keyframe><key qpos="3 -2 0.44 {values} 0.1"/></keyframe></mujoco>'
    return ROBOT.replace("</mujoco>", key)


@pytest.mark.parametrize(
    "quaternion",
    [
        (1, 0, 0, 0),
        (-1, 0, 0, 0),
        (0.7071, 0, 0, 0.7071),
        (-0.5, 0, 0, 0.8660254),
        (0, 0, 0, 1),
        (0, 0, 0, -3),
        (0.99999999, 1e-4, 1e-4, 0),
    ],
)
def test_a_keyframe_turned_about_the_vertical_is_upright(tmp_path, quaternion):
    (tmp_path / "robot.xml").write_text(keyframe(quaternion))
    robot = load_robot(tmp_path / "robot.xml")
    assert not any("inclination" in note for note in robot.notes)
    assert (robot.pose.height, robot.pose.joints) == (0.44, (("leg", 0.1),))


@pytest.mark.parametrize(
    ("quaternion", "degrees"),
    [((np.cos(0.1), np.sin(0.1), 0, 0), "11.5"), ((0, 1, 0, 0), "180"), ((0.5, 0.5, 0.5, 0.5), "90")],
)
def test_a_keyframe_that_is_inclined_is_said(tmp_path, quaternion, degrees):
    (tmp_path / "robot.xml").write_text(keyframe(quaternion))
    with pytest.warns(UserWarning, match=rf"inclination of the base in the reference pose \({degrees} degrees\)"):
        load_robot(tmp_path / "robot.xml")


def test_a_base_turned_in_the_file_is_upright(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOT.replace('name="trunk"', 'name="trunk" euler="0 0 70"'))
    assert not any("inclination" in note for note in load_robot(tmp_path / "robot.xml").notes)
