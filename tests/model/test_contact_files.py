"""Shapes under `contacts:` of a YAML file, and collisions of a URDF: which spheres stand for them."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.model import RobotError, load_robot

INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
BOX = '<collision><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.1 0.04"/></geometry></collision>'
ROD = '<collision><geometry><cylinder radius="0.02" length="0.3"/></geometry></collision>'
MESH = '<collision><geometry><mesh filename="hull.stl"/></geometry></collision>'
URDF = f"""<robot name="m"><link name="trunk">{INERTIAL}{MESH}</link>
<joint name="hip" type="revolute"><parent link="trunk"/><child link="leg"/><axis xyz="0 1 0"/><limit lower="-1" upper="1"/></joint>
<link name="leg">{INERTIAL}{ROD}</link>
<joint name="ankle" type="fixed"><parent link="leg"/><child link="sole"/><origin xyz="0 0 -0.3" rpy="0 0 1.5707963267948966"/></joint>
<link name="sole">{BOX}</link></robot>"""  # noqa: E501


@pytest.fixture
def contacts(tmp_path):
    """Write contacts into a robot's file, and load it."""

    def load(text: str):
        (tmp_path / "m.urdf").write_text(URDF)
        (tmp_path / "m.yaml").write_text(f"urdf: m.urdf\ncontacts: {{{text}}}\n")
        return load_robot(tmp_path / "m.yaml").contacts

    return load


def places(spheres) -> set[tuple[float, ...]]:
    return {tuple(np.round(sphere.position, 12) + 0.0) for sphere in spheres}


def test_a_box_is_its_corners(contacts):
    box = contacts("foot: {body: leg, shape: box, size: [0.2, 0.1, 0.04], position: [0, 0, -0.5], group: sole}")
    assert [sphere.name for sphere in box] == [f"foot_corner{i}" for i in range(1, 9)]
    assert {(sphere.body, sphere.radius, sphere.group) for sphere in box} == {("leg", 0.0, "sole")}
    assert places(box) == {(x, y, z) for x in (0.1, -0.1) for y in (0.05, -0.05) for z in (-0.48, -0.52)}


def test_of_a_face_and_with_edges_rounded_inwards(contacts):
    sole = contacts("foot: {body: leg, shape: box, size: [0.2, 0.1, 0.04], radius: 0.01, face: -z}")
    assert places(sole) == {(x, y, -0.01) for x in (0.09, -0.09) for y in (0.04, -0.04)}
    assert {sphere.radius for sphere in sole} == {0.01}


def test_a_capsule_and_a_cylinder_that_are_turned(contacts):
    capsule = contacts("shin: {body: leg, shape: capsule, size: [0.02, 0.3], rpy: [0, 1.5707963267948966, 0]}")
    assert places(capsule) == {(0.15, 0.0, 0.0), (-0.15, 0.0, 0.0)}
    assert {sphere.radius for sphere in capsule} == {0.02}
    wheel = contacts("wheel: {body: leg, shape: cylinder, size: [0.1, 0.04], rim: 16}")
    assert len(wheel) == 32
    np.testing.assert_allclose([np.hypot(*sphere.position[:2]) for sphere in wheel], 0.1)
    assert {sphere.position[2] for sphere in wheel} == {0.02, -0.02}


def test_collisions_of_a_link_that_is_merged_into_another(contacts):
    sole = contacts("sole: {body: sole, shape: collision, face: -z}")
    assert {sphere.body for sphere in sole} == {"leg"}
    assert places(sole) == {(x, y, -0.32) for x in (0.05, -0.05) for y in (0.0, 0.2)}
    assert len(contacts("rod: {body: leg, shape: collision}")) == 16


def robot_with(tmp_path, text: str):
    (tmp_path / "m.urdf").write_text(URDF)
    (tmp_path / "m.yaml").write_text(f"urdf: m.urdf\n{text}\n")
    return load_robot(tmp_path / "m.yaml")


def test_capsules_and_pairs_of_links_by_any_name_of_theirs(tmp_path):
    ball = "capsules: {sole: {from: [0, 0, 0], radius: 0.03}, trunk: [{from: [0, 0, 0], to: [1, 0, 0], radius: 0.1}]}"
    with pytest.raises(RobotError, match="not parent and child"):
        robot_with(tmp_path, f"{ball}\nself_collisions: [[trunk, sole]]")
    sole, trunk = robot_with(tmp_path, ball).capsules
    assert (sole.body, sole.start, sole.end, sole.radius) == ("leg", (0.0, 0.0, -0.3), (0.0, 0.0, -0.3), 0.03)
    assert (trunk.body, trunk.end) == ("trunk", (1.0, 0.0, 0.0))


def test_a_link_without_primitives_is_refused(contacts):
    for link, said in (("trunk", "a mesh"), ("hoof", "hoof")):
        with pytest.raises(RobotError, match=said):
            contacts(f"foot: {{body: {link}, shape: collision}}")
    with pytest.raises(RobotError, match=r"foot\.rolls is True: expected `shape: cylinder`"):
        contacts("foot: {body: leg, shape: collision, rolls: true}")


def test_a_cylinder_that_rolls_is_its_two_rims(contacts):
    """Each a circle about the cylinder's axis, rounded inwards."""
    rims = contacts(
        "w: {body: leg, shape: cylinder, size: [0.1, 0.04], radius: 0.01, rpy: [1.5707963267948966, 0, 0], rolls: true}"
    )
    assert [(rim.name, rim.radius) for rim in rims] == [("w_rim1", 0.01), ("w_rim2", 0.01)]
    np.testing.assert_allclose([rim.rim for rim in rims], 0.09)
    assert places(rims) == {(0.0, -0.01, 0.0), (0.0, 0.01, 0.0)}
    np.testing.assert_allclose([rim.axis for rim in rims], [[0, -1, 0]] * 2, atol=1e-12)
    assert len(contacts("w: {body: leg, shape: cylinder, size: [0.1, 0.04], face: -z, rolls: true}")) == 1
