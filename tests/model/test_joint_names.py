"""Joints have the names of the URDF or MJCF file; files may name them, or the links that they move."""

import textwrap

import pytest

from ce_gym import Model, RobotError, load_robot

URDF = """
<robot name="arm">
  <link name="base"/>
  <link name="upper">{inertial}</link>
  <link name="lower">{inertial}</link>
  <joint name="{first}" type="revolute">
    <parent link="base"/><child link="upper"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="9"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="9"/>
  </joint>
</robot>
"""
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
YAML = """
urdf: arm.urdf
base: fixed
rotors:
  elbow_rotor: {{inertia: 1e-4, ratios: {{{elbow}: 10.0}}}}
motors:
  elbow_rotor: {{torque: 1.0}}
independent: [{shoulder}, {elbow}]
pose: {{joints: {{{shoulder}: 0.5, {elbow}: 0.2}}}}
gains: {{kp: {{{pattern}: 30.0, {shoulder}: 40.0}}, kd: 1.0}}
joint_friction: {{{elbow}: 0.1}}
"""
MJCF = """
<mujoco><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0"/><geom size="0.1" mass="1"/>
<body name="lower" pos="0 0 -1"><joint axis="0 1 0" armature="0.1"/><geom size="0.1" mass="1"/></body></body>
</worldbody></mujoco>
"""


def robot(folder, text, first="shoulder"):
    (folder / "arm.urdf").write_text(URDF.format(first=first, inertial=INERTIAL))
    (folder / "arm.yaml").write_text(textwrap.dedent(text))
    return load_robot(folder / "arm.yaml")


def test_a_yaml_file_may_name_joints_or_links(tmp_path):
    by_link = robot(tmp_path, YAML.format(shoulder="upper", elbow="lower", pattern="low*"))
    by_joint = robot(tmp_path, YAML.format(shoulder="shoulder", elbow="elbow", pattern="elb*"))
    assert by_joint == by_link
    assert by_joint.gains.kp == (("upper", 40.0), ("lower", 30.0))
    assert by_joint.joint_names == Model(by_joint).joint_names == ("shoulder", "elbow")


def test_a_joint_named_twice_is_refused(tmp_path):
    text = "urdf: arm.urdf\nbase: fixed\npose: {joints: {elbow: 0.1, lower: 0.2}}\n"
    with pytest.raises(RobotError, match=r"pose\.joints\.elbow.*each joint once; 'lower' is the link that it moves"):
        robot(tmp_path, text)


def test_the_name_of_another_link_is_not_taken_for_a_joint(tmp_path):
    """`lower` is the link that the elbow moves, so the joint of `upper` keeps the name of its link."""
    text = "urdf: arm.urdf\nbase: fixed\npose: {joints: {lower: 0.2}}\n"
    read = robot(tmp_path, text, first="lower")
    assert read.joint_names == ("upper", "elbow")
    assert read.pose.joints == (("lower", 0.2),)


def test_mjcf_joints_without_a_name_have_that_of_their_link(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(MJCF)
    (tmp_path / "arm.yaml").write_text("mjcf: arm.xml\ngears: {lower: 8}\npose: {joints: {shoulder: 0.3}}\n")
    read = load_robot(tmp_path / "arm.yaml")
    assert read.joint_names == ("shoulder", "lower")
    assert dict(read.pose.joints)["upper"] == 0.3


def test_gears_of_mjcf_files_may_name_joints(tmp_path):
    pytest.importorskip("mujoco")
    named = MJCF.replace("<joint axis", '<joint name="elbow" axis')
    ratios = []
    for joint in ("elbow", "lower"):
        (tmp_path / "arm.xml").write_text(named)
        (tmp_path / "arm.yaml").write_text(f"mjcf: arm.xml\ngears: {{{joint}: 8}}\n")
        ratios.append(load_robot(tmp_path / "arm.yaml").constraints)
    assert ratios[0] == ratios[1]
