"""Bad input gives one line that names the file, the key, the value and what was expected."""

import contextlib
import dataclasses
import math
import random
import re

import pytest

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
from ce_gym.model.errors import shown

YAML_ERRORS = [
    # edit, and what the message must say (file, key, value, expected), in this order
    (("ratios: {thigh: 6}", "ratios: {thihg: 6}"), ["leg.yaml", "hip_rotor.ratios", "'thihg'", "'thigh'"]),
    (("ratios: {thigh: 6}", "ratios: {thigh: 0}"), ["leg.yaml", "hip_rotor.ratios.thigh", "0.0", "other than 0"]),
    (("ratios: {thigh: 6}", "ratios: {thigh: six}"), ["leg.yaml", "ratios.thigh", "'six'", "finite number"]),
    (("ratios: {thigh: 6}", "ratios: {}"), ["leg.yaml", "hip_rotor.ratios", "{}", "at least one link"]),
    (("ratios: {thigh: 6}", "ratios: {hip_rotor: 6}"), ["leg.yaml", "hip_rotor.ratios", "rotor itself"]),
    (("ratios: {thigh: 6}", "ratios: {trunk: 6}"), ["leg.yaml", "hip_rotor", "'trunk'", "one degree of freedom"]),
    (("ratios: {thigh: 6}", "ratios: 6"), ["leg.yaml", "hip_rotor.ratios", "6", "a mapping"]),
    (("parent: trunk", "parent: trunc"), ["leg.yaml", "hip_rotor.parent", "'trunc'", "'trunk'"]),
    (("parent: trunk", "parent: hip_rotor"), ["leg.yaml", "hip_rotor.parent", "'hip_rotor'", "name of a body"]),
    (("parent: trunk", "parent: 3"), ["leg.yaml", "hip_rotor.parent", "3", "text"]),
    (("parent: trunk\n", "parnt: trunk\n"), ["leg.yaml", "rotors.hip_rotor", "'parnt'", "'parent'"]),
    (("parent: trunk\n", "parent:\n"), ["leg.yaml", "rotors.hip_rotor.parent", "missing", "text"]),
    (("  hip_rotor:\n", "  thigh:\n"), ["leg.yaml", "rotors.thigh", "no other body"]),
    (("  knee_rotor:\n", "  hip_rotor:\n"), ["leg.yaml", "duplicate key 'hip_rotor'"]),
    (("    mass: 0.1\n    inertia: [1e-4", "    mass: -0.1\n    inertia: [1e-4"), ["leg.yaml", "mass", "-0.1"]),
    (("    mass: 0.1\n", ""), ["leg.yaml", "hip_rotor.mass", "missing", "finite number"]),
    (("    mass: 0.1\n", "    mass: true\n"), ["leg.yaml", "hip_rotor.mass", "True", "finite number"]),
    (("    mass: 0.1\n", "    mass: .nan\n"), ["leg.yaml", "hip_rotor.mass", "nan", "finite number"]),
    (("    mass: 0.1\n", "    mass: 1e400\n"), ["leg.yaml", "hip_rotor.mass", "inf", "finite number"]),
    (("    mass: 0.1\n", f"    mass: 1{'0' * 400}\n"), ["leg.yaml", "hip_rotor.mass", "finite number"]),
    (("    mass: 0.1\n", f"    mass: 1{'0' * 5000}\n"), ["leg.yaml", "malformed"]),
    (("    mass: 0.1\n", f"    mass: [0x{'f' * 5000}]\n"), ["leg.yaml", "hip_rotor.mass", "finite number"]),
    (("xyz: [0, 0, 0]\n", "xyz: [0, 0]\n"), ["leg.yaml", "hip_rotor.xyz", "[0, 0]", "3 numbers"]),
    (("xyz: [0, 0, 0]\n", "xyz: [0, x, 0]\n"), ["leg.yaml", "hip_rotor.xyz[1]", "'x'", "finite number"]),
    (("xyz: [0, 0, 0]\n", "xyz: 0\n"), ["leg.yaml", "hip_rotor.xyz", "0", "3 numbers"]),
    (("axis: [0, 1, 0]\n", "axis: [0, 0, 0]\n"), ["leg.yaml", "hip_rotor.axis", "length other than 0"]),
    (("[1e-4, 0, 0, 2e-4, 0, 1e-4]", "[-1e-4, 0, 0, 2e-4, 0, 1e-4]"), ["leg.yaml", "inertia", "semidefinite"]),
    (("[1e-4, 0, 0, 2e-4, 0, 1e-4]", "[1e-4, 9, 0, 2e-4, 0, 1e-4]"), ["leg.yaml", "inertia", "semidefinite"]),
    (("gains:", "joint_friction: -1\ngains:"), ["leg.yaml", "link 'thigh' joint friction", "-1.0", "0 or more"]),
    (("gains:", "joint_friction: {hip_rotor: 1}\ngains:"), ["leg.yaml", "joint_friction", "'hip_rotor'", "a link"]),
    (("gains:", "gians:"), ["leg.yaml", "top level", "'gians'", "'gains'"]),
    (("base: floating", "base: flying"), ["leg.yaml", "base", "'flying'", "floating, fixed"]),
    (("base: floating", "base: yes"), ["leg.yaml", "base", "True", "text"]),
    (("urdf: leg.urdf", "urdf: log.urdf"), ["log.urdf", "cannot be read", "No such file"]),
    (("urdf: leg.urdf", "name: leg"), ["leg.yaml", "urdf", "missing", "what the links are"]),
    (("urdf: leg.urdf", "urdf: leg.urdf\nindependent: [thigh]"), ["leg.yaml", "shank, knee_rotor", "()", "1 of them"]),
    (("urdf: leg.urdf", "urdf: leg.urdf\nindependent: [thigh, shin]"), ["leg.yaml", "independent", "'shin'", "name"]),
    (("urdf: leg.urdf", "urdf: leg.urdf\nindependent: [thigh, [shank]]"), ["leg.yaml", "independent[1]", "text"]),
    (("urdf: leg.urdf", "urdf: leg.urdf\nindependent: []"), ["leg.yaml", "independent", "()", "1 of them"]),
    (("hip_rotor: {torque", "hip_rotr: {torque"), ["leg.yaml", "motors", "'hip_rotr'", "'hip_rotor'"]),
    (("{torque: 3}", "{torque: -3}"), ["leg.yaml", "motors.hip_rotor.torque", "-3.0", "0 or more"]),
    (("{torque: 3}", "{torqe: 3}"), ["leg.yaml", "motors.hip_rotor", "'torqe'", "'torque'"]),
    (("body: foot", "body: food"), ["leg.yaml", "contacts.toe.body", "'food'", "'foot'"]),
    (("body: foot", "body: world"), ["leg.yaml", "contacts.toe.body", "'world'", "a body that moves"]),
    (("radius: 0.02", "radius: -0.02"), ["leg.yaml", "contacts.toe.radius", "-0.02", "0 or more"]),
    (("joints: {thigh: 0.1}", "joints: {hip: 0.1}"), ["leg.yaml", "pose.joints", "'hip'", "independent joint"]),
    (("joints: {thigh: 0.1}", "joints: [0.1]"), ["leg.yaml", "pose.joints", "[0.1]", "a mapping"]),
    (("kp: 20", "kp: -20"), ["leg.yaml", "gains.kp", "-20.0", "0 or more"]),
    (("kd: {thigh: 1, shank: 2}", "kd: {thigh: 1}"), ["leg.yaml", "gains.kd.shank", "missing", "every independent"]),
    (("kd: {thigh: 1, shank: 2}", "kd: {thigh: 1, shin: 2}"), ["leg.yaml", "gains.kd", "'shin'", "independent joint"]),
    (("gains:", "material: {friction: -1}\ngains:"), ["leg.yaml", "material.friction", "-1.0", "0 or more"]),
    (("gains:", "gravity: [0, 0]\ngains:"), ["leg.yaml", "gravity", "[0, 0]", "3 numbers"]),
    (("gains:", "constraints: {}\ngains:"), ["leg.yaml", "constraints", "{}", "a list"]),
    (("gains:", "constraints: [3]\ngains:"), ["leg.yaml", "constraints[0]", "3", "a mapping"]),
    (
        ("gains:", "constraints: [{name: t, type: belt, coefficients: {}}]\ngains:"),
        ["leg.yaml", "constraints[0].type", "'belt'", "linear"],
    ),
    (
        ("gains:", "constraints: [{name: t, type: linear, coefficients: {thigh: 1}}]\ngains:"),
        ["leg.yaml", "constraint 't'", "at least two"],
    ),
    (
        ("gains:", "constraints: [{name: t, type: linear, coefficients: {thigh: 1, toe: 1}}]\ngains:"),
        ["leg.yaml", "constraints[0].coefficients", "'toe'", "name of a body"],
    ),
    (
        ("gains:", "constraints: [{name: hip_rotor, type: linear, coefficients: {thigh: 1, shank: 1}}]\ngains:"),
        ["leg.yaml", "constraint name", "'hip_rotor'", "used once"],
    ),
    (("  toe:", "  3:"), ["leg.yaml", "contacts.3", "3", "quotes"]),
    (("gains:", "!!int '': 1\ngains:"), ["leg.yaml", "malformed YAML"]),
    (("gains:", "gains: ["), ["leg.yaml", "malformed YAML", "line"]),
    (("gains:", "gains: !!python/object:os.system "), ["leg.yaml", "malformed YAML"]),
    (("gains:", f"x: {'[' * 5000}\ngains:"), ["leg.yaml", "malformed YAML"]),
]

URDF_ERRORS = [
    (('<link name="foot"/>', '<link name="shank"/>'), ["leg.urdf", "link name", "'shank'", "no other link"]),
    (('<link name="foot"/>', "<link/>"), ["leg.urdf", "<link name>", "missing", "a name"]),
    (('<link name="foot"/>', '<link name="foot"/><link name="hat"/>'), ["leg.urdf", "root links", "hat", "one link"]),
    (('<child link="foot"/>', '<child link="fot"/>'), ["leg.urdf", "'ankle' <child link>", "'fot'", "'foot'"]),
    (('<child link="foot"/>', ""), ["leg.urdf", "'ankle' <child>", "missing", "<child>"]),
    (
        ('<child link="foot"/>', '<child link="thigh"/>'),
        ["leg.urdf", "'thigh' parents", "'hip' and 'ankle'", "one joint"],
    ),
    (
        ('<parent link="trunk"/>', '<parent link="foot"/>'),
        ["leg.urdf", "joints", "foot -> thigh", "cycle needs a constraint"],
    ),
    (
        ("</robot>", '<joint name="up" type="fixed"><parent link="foot"/><child link="trunk"/></joint></robot>'),
        ["leg.urdf", "joints", "->", "cycle needs a constraint"],
    ),
    (('<joint name="knee"', '<joint name="hip"'), ["leg.urdf", "joint name", "'hip'", "no other joint"]),
    (('type="fixed"', 'type="planar"'), ["leg.urdf", "'ankle' type", "'planar'", "revolute"]),
    (
        ('<joint name="knee" type="revolute">', '<joint name="knee" type="floating">'),
        ["leg.urdf", "'knee' type", "'floating'", "one degree of freedom"],
    ),
    (('<mass value="2"/>', '<mass value="0"/>'), ["leg.urdf", "'thigh' mass", "0.0", "above 0"]),
    (('<mass value="2"/>', '<mass value="-2"/>'), ["leg.urdf", "'thigh' <mass value>", "-2.0", "not negative"]),
    (('<mass value="2"/>', '<mass value="1e400"/>'), ["leg.urdf", "'thigh' <mass value>", "'1e400'", "finite"]),
    (('<mass value="2"/>', '<mass value="two"/>'), ["leg.urdf", "'thigh' <mass value>", "'two'", "finite"]),
    (('<mass value="2"/>', '<mass value="2 2"/>'), ["leg.urdf", "'thigh' <mass value>", "'2 2'", "finite"]),
    (('<mass value="2"/>', ""), ["leg.urdf", "'thigh' <mass>", "missing", "<mass>"]),
    (('ixx="0.02" ', ""), ["leg.urdf", "'thigh' <inertia ixx>", "missing", "finite"]),
    (('ixx="0.02" ', 'ixx="nan" '), ["leg.urdf", "'thigh' <inertia ixx>", "'nan'", "finite"]),
    (('ixx="0.02" ', 'ixx="-0.02" '), ["leg.urdf", "'thigh' inertia", "semidefinite"]),
    (('<origin xyz="0 0 -0.2"/>', '<origin xyz="0 0"/>'), ["leg.urdf", "'knee' <origin xyz>", "'0 0'", "3 finite"]),
    (('<origin xyz="0 0 -0.2"/>', '<origin rpy="inf 0 0"/>'), ["leg.urdf", "'knee' <origin rpy>", "3 finite"]),
    (('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'), ["leg.urdf", "'hip' <axis xyz>", "length other than 0"]),
    (('lower="-1"', 'lower="3"'), ["leg.urdf", "'thigh' joint limits", "(3.0, 2.0)", "not above the upper"]),
    (('effort="30"', 'effort="-30"'), ["leg.urdf", "'thigh' joint torque", "-30.0", "0 or more"]),
    (('velocity="20"', 'velocity="fast"'), ["leg.urdf", "'hip' <limit velocity>", "'fast'", "finite"]),
    (('rgba="1 0 0 1"', 'rgba="1 0 0"'), ["leg.urdf", "'red' <color rgba>", "'1 0 0'", "4 finite"]),
    (("</robot>", ""), ["leg.urdf", "malformed XML"]),
    (("<robot name", "<sdf name"), ["leg.urdf", "malformed XML"]),
    (("<robot name", '<!DOCTYPE r [<!ENTITY a "b">]><robot name'), ["leg.urdf", "DOCTYPE", "without document type"]),
    (('<origin xyz="0 0 -0.2"/>', '<mimic joint="hop"/>'), ["leg.urdf", "'knee' <mimic joint>", "'hop'", "'hip'"]),
    (
        ('<link name="foot"/>', '<link name="foot"><visual/></link>'),
        ["leg.urdf", "'foot' <geometry>", "missing", "<geometry>"],
    ),
    (
        (
            '<link name="foot"/>',
            '<link name="foot"><visual><geometry><sphere radius="-1"/></geometry></visual></link>',
        ),
        ["leg.urdf", "'foot' <sphere> size", "above 0"],
    ),
]


def message_of(call) -> str:
    with pytest.raises(RobotError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 500
    assert caught.value.__cause__ is None
    assert caught.value.__suppress_context__ or caught.value.__context__ is None
    return message


def says(message: str, parts: list[str]) -> bool:
    return re.search(".*".join(re.escape(part) for part in parts), message) is not None


@pytest.mark.parametrize(("edit", "parts"), YAML_ERRORS + URDF_ERRORS, ids=lambda value: str(value[1])[:40])
def test_one_line_says_where_and_what(write_robot, edit, parts):
    load_robot(write_robot())
    path = write_robot(edit)
    message = message_of(lambda: load_robot(path))
    assert says(message, parts), message


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ("", ["r.yaml", "empty", "a mapping"]),
        ("# nothing\n", ["r.yaml", "empty", "a mapping"]),
        ("- a\n- b\n", ["r.yaml", "top level", "['a', 'b']", "a mapping"]),
        ("just text", ["r.yaml", "top level", "'just text'", "a mapping"]),
        ("a: &a [*a]\nurdf: *a\n", ["r.yaml", "line 1", "'a' stands inside"]),
        ("name: &a [&b [*a, *b], *a]\nurdf: *a\n", ["r.yaml", "line 1", "'a' stands inside"]),
        ("\x00", ["r.yaml", "malformed YAML"]),
    ],
)
def test_yaml_files_that_hold_no_mapping(tmp_path, content, parts):
    path = tmp_path / "r.yaml"
    path.write_text(content)
    message = message_of(lambda: load_robot(path))
    assert says(message, parts), message


def test_messages_stop_inside_a_value_that_aliases_make_huge():
    class Counted:
        times = 0

        def __repr__(self):
            Counted.times += 1
            return "x" * 10_000

    assert len(shown([[Counted()] * 1000] * 1000)) <= 60
    assert Counted.times < 100


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (b"", ["r.urdf", "malformed XML"]),
        (b"<sdf/>", ["r.urdf", "root element", "'sdf'", "<robot>"]),
        (b"<robot/>", ["r.urdf", "<robot>", "at least one <link>"]),
        (b'<robot name="r"><link name="world"/></robot>', ["r.urdf", "bodies", "at least one body"]),
        (b"\xff\xfe<robot/>", ["r.urdf", "malformed XML"]),
        (b'<?xml version="1.0" encoding="no-such"?><robot/>', ["r.urdf"]),
    ],
)
def test_urdf_files_that_hold_no_robot(tmp_path, content, parts):
    path = tmp_path / "r.urdf"
    path.write_bytes(content)
    message = message_of(lambda: load_robot(path))
    assert says(message, parts), message


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("mini_cheeta", ["robot", "'mini_cheeta'", "did you mean 'mini_cheetah'"]),
        ("zebra", ["robot", "'zebra'", "mini_cheetah, mit_humanoid"]),
        ("", ["robot", "''", "mini_cheetah"]),
        ("no/such/robot.yaml", ["no/such/robot.yaml", "cannot be read", "No such file"]),
        ("no/such/robot.urdf", ["no/such/robot.urdf", "cannot be read", "No such file"]),
        ("robot.json", ["robot.json", "'.json'", ".yaml, .urdf or .xml"]),
        ("nul\0.urdf", ["cannot be read"]),
    ],
)
def test_robots_that_do_not_exist(name, parts):
    message = message_of(lambda: load_robot(name))
    assert says(message, parts), message


UNIT = Inertial(1.0, (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
ARM = Body("arm", "link", None, Placement(), Joint("revolute"), UNIT)
HAND = dataclasses.replace(ARM, name="hand", parent="arm")


def by_hand(*bodies: Body, **fields) -> Robot:
    return Robot("by hand", bodies, independent=tuple(body.name for body in bodies), **fields)


@pytest.mark.parametrize(
    ("robot", "parts"),
    [
        (by_hand(), ["by hand", "bodies", "at least one"]),
        (by_hand(ARM, ARM), ["by hand", "body name", "'arm'", "no other body"]),
        (by_hand(HAND, ARM), ["by hand", "'hand' parent", "'arm'", "listed before"]),
        (by_hand(ARM, dataclasses.replace(HAND, joint=Joint("free"))), ["'hand' joint type", "'free'", "first body"]),
        (by_hand(dataclasses.replace(ARM, joint=Joint("screw"))), ["'arm' joint type", "'screw'", "prismatic"]),
        (by_hand(dataclasses.replace(ARM, joint=Joint("revolute", (0, 0, 2)))), ["'arm' joint axis", "unit axis"]),
        (by_hand(dataclasses.replace(ARM, joint=Joint("revolute", damping=-1))), ["'arm' joint damping", "-1"]),
        (
            by_hand(dataclasses.replace(ARM, joint=Joint("revolute", position=(math.nan, 1)))),
            ["'arm' joint limits", "nan"],
        ),
        (
            by_hand(
                dataclasses.replace(ARM, inertial=dataclasses.replace(UNIT, inertia=((1, 1, 0), (0, 1, 0), (0, 0, 1))))
            ),
            ["'arm' inertia", "symmetric"],
        ),
        (
            by_hand(dataclasses.replace(ARM, placement=Placement(rotation=((1, 0, 0), (0, 1, 0), (0, 0, -1))))),
            ["'arm' rotation", "rotation matrix"],
        ),
        (
            by_hand(dataclasses.replace(ARM, placement=Placement(position=(0, math.inf, 0)))),
            ["'arm' position", "inf", "finite"],
        ),
        (
            by_hand(ARM, HAND, constraints=(LinearConstraint("t", (("arm", 1.0), ("hnad", 1.0))),)),
            ["constraint 't'", "'hnad'", "'hand'"],
        ),
        (
            by_hand(ARM, HAND, constraints=(LinearConstraint("t", (("arm", 1.0), ("hand", 0.0))),)),
            ["constraint 't' coefficient of 'hand'", "0.0", "other than 0"],
        ),
        (
            by_hand(ARM, HAND, constraints=(LinearConstraint("t", (("arm", 1.0), ("arm", 1.0))),)),
            ["constraint 't'", "each once"],
        ),
    ],
)
def test_robots_made_by_hand_are_checked_too(robot, parts):
    check_robot(by_hand(ARM, HAND))
    message = message_of(lambda: check_robot(robot))
    assert says(message, parts), message


@pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")
def test_damaged_files_never_show_a_traceback_of_a_dependency(write_robot, tmp_path):
    """Cut, double and replace words at random: a robot or a RobotError, nothing else."""
    rng = random.Random(0)
    accepted = 0
    for _ in range(300):
        path = write_robot()
        victim = rng.choice([path, tmp_path / "leg.urdf"])
        words = re.split(r"(\W)", victim.read_text())
        i = rng.randrange(len(words))
        words[i] = rng.choice(
            ["", words[i] * 2, "-1", "1e308", "nan", "{", "*", '"', "~", "\n", "é", rng.choice(words)]
        )
        victim.write_text("".join(words))
        with contextlib.suppress(RobotError):
            load_robot(path)
            accepted += 1
    assert 50 < accepted < 200, "some damage does no harm, most is found"
