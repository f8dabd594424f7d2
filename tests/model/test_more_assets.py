"""The humanoids stand on flat feet, with the repairs their files speak of."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from published import read_facts, rotation

from ce_gym.model import Robot, load_robot, robots
from ce_gym.model.description import ContactSphere

NAMES = ("mit_humanoid", "jvrc1")


@pytest.fixture(scope="module", params=NAMES)
def robot(request) -> Robot:
    return load_robot(request.param)


@pytest.fixture(scope="module")
def facts(robot) -> dict:
    return read_facts(robot.name)


def standing(robot: Robot, facts: dict) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Position and rotation of each link in the standing pose, from the published placements alone."""
    poses, angles = {}, dict(robot.pose.joints)
    for fact in facts["bodies"]:
        if fact["joint"]["type"] == "free":
            poses[fact["name"]] = (np.array([0, 0, robot.pose.height]), np.eye(3))
        elif fact["kind"] == "link":
            p, R = poses[fact["parent"]]
            turn = rotation(angles.get(fact["name"], 0.0) * np.array(fact["joint"]["axis"]))
            place = fact["placement"]
            poses[fact["name"]] = (p + R @ place["xyz"], R @ rotation(place["rpy"]) @ turn)
    return poses


def soles(robot: Robot) -> list[ContactSphere]:
    return [contact for contact in robot.contacts if contact.group == "foot"]


def test_they_are_found_by_name():
    assert set(NAMES) <= set(robots())


def test_motors_reach_the_limits_of_their_joints(robot):
    """Of the joint furthest along a belt, for a motor whose belt runs over several."""
    ratios = {constraint.name: dict(constraint.coefficients) for constraint in robot.constraints}
    assert {motor.rotor for motor in robot.motors} == {rotor.name for rotor in robot.rotors()}
    for motor in robot.motors:
        link = [name for name in robot.independent if name in ratios[motor.rotor]][-1]
        ratio, joint = -ratios[motor.rotor][link], robot.body(link).joint
        assert motor.torque * ratio == pytest.approx(joint.torque, rel=1e-12)
        assert motor.velocity == pytest.approx(joint.velocity * ratio, rel=1e-12)


def test_soles_lie_flat_on_the_ground(robot, facts):
    poses = standing(robot, facts)
    heights = [(p + R @ sole.position)[2] for sole in soles(robot) for p, R in [poses[sole.body]]]
    assert np.abs(heights).max() < 1e-6
    assert list(Counter(sole.body for sole in soles(robot)).values()) == [4, 4]
    assert all(sole.radius == 0.0 for sole in soles(robot))
    clear = [contact for contact in robot.contacts if contact.group != "foot"]
    assert min((p + R @ c.position)[2] - c.radius for c in clear for p, R in [poses[c.body]]) > 0.1


def test_centre_of_mass_is_above_the_middle_of_the_soles(robot, facts):
    poses, moment = standing(robot, facts), np.zeros(3)
    for body in robot.bodies:
        p, R = poses[body.name if body.kind == "link" else body.parent]
        if body.kind == "rotor":  # its centre of mass is its origin
            p = p + R @ body.placement.position
        moment += body.inertial.mass * (p + R @ body.inertial.com)
    corners = np.array([p + R @ sole.position for sole in soles(robot) for p, R in [poses[sole.body]]])
    np.testing.assert_allclose(moment[:2] / robot.total_mass, corners.mean(axis=0)[:2], atol=2e-3)


def test_soles_are_the_published_ones(robot, facts):
    """Toe and heel points of the one robot; the sole of the other, to a hundredth of a metre."""
    corners = np.array([sole.position for sole in soles(robot)])
    if "foot_sole" in facts:
        centre, half = np.array(facts["foot_sole"]["centre"]), np.array(facts["foot_sole"]["half_extents_xy"])
        expected = np.array([centre[:2] - half, centre[:2] + half]).round(2)
        assert corners[:, 2] == pytest.approx(centre[2], abs=1e-6)
        np.testing.assert_array_equal([corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)], expected)
    else:
        points = {p["name"]: p["offset"] for p in facts["contact_points"]}
        for sole in soles(robot):
            x, _, z = points[f"{sole.name.rpartition('_')[0]}_contact"]
            assert (sole.position[0], sole.position[2]) == (x, z)


def test_left_and_right_mirror_each_other(robot):
    """Contacts, placements, limits, pose and gains; joints about x and z turn the other way round."""

    def other(name: str) -> str:
        return name.replace("left", "right")

    contacts = {contact.name: contact for contact in robot.contacts}
    pose, kp, kd = dict(robot.pose.joints), dict(robot.gains.kp), dict(robot.gains.kd)
    for contact in (c for c in robot.contacts if "left" in c.name):
        twin = contacts[other(contact.name)]
        assert (twin.body, twin.radius, twin.group) == (other(contact.body), contact.radius, contact.group)
    for body in (b for b in robot.bodies if "left" in b.name):
        twin = robot.body(other(body.name))
        x, y, z = body.placement.position
        assert twin.placement.position == (x, -y, z)
        assert len(twin.shapes) == len(body.shapes)
        for shape, mirrored in zip(body.shapes, twin.shapes, strict=True):
            x, y, z = shape.placement.position
            assert (mirrored.size, mirrored.color) == (shape.size, shape.color)
            assert mirrored.placement.position == (x, -y, z)
        if body.name in robot.independent:
            sign = 1 if body.joint.axis[1] else -1
            low, high = body.joint.position
            assert twin.joint.position == ((low, high) if sign == 1 else (-high, -low))
            assert pose[twin.name] == sign * pose[body.name]
            assert (kp[twin.name], kd[twin.name]) == (kp[body.name], kd[body.name])


def test_falling_is_noticed(robot):
    assert Counter(contact.group for contact in robot.contacts)["knee"] == 2
    assert Counter(contact.group for contact in robot.contacts)["arm"] == 4
    assert Counter(contact.group for contact in robot.contacts)["torso"] >= 8


def test_feet_are_drawn_down_to_the_soles(robot):
    """Boxes are not turned in these feet, so that half their height below their centre is where they end."""
    for sole in soles(robot):
        boxes = [shape for shape in robot.body(sole.body).shapes if shape.type == "box"]
        lowest = min(shape.placement.position[2] - shape.size[2] / 2 for shape in boxes)
        assert lowest == pytest.approx(sole.position[2], abs=1e-9)


def test_every_link_is_drawn(robot):
    assert all(body.shapes for body in robot.bodies if body.kind == "link")


def test_repairs_are_noted():
    """Both hips of the repaired robot are at one height, and its file says that the published ones are not."""
    jvrc1 = load_robot("jvrc1")
    assert jvrc1.body("right-hip-pitch").placement.position == (0.0, -0.096, 0.0)
    assert jvrc1.body("left-hip-pitch").placement.position == (0.0, 0.096, 0.0)
    assert any("repaired" in note and "hip" in note for note in jvrc1.notes)
    assert any("inertia" in note for note in jvrc1.notes)


def test_links_are_a_plain_urdf(robot):
    """Whatever reads URDF can read the links: nothing of the paper authors' extension, no rotors, no capsules."""
    root = ElementTree.parse(Path(robot.source).with_suffix(".urdf")).getroot()
    assert {element.tag for element in root} == {"material", "link", "joint"}
    assert {shape.tag for shape in root.iterfind(".//geometry/*")} <= {"box", "cylinder", "sphere"}
    assert not [link for link in root.iter("link") if "rotor" in link.get("name", "")]
