"""Files made to hang, to exhaust memory or to slip nonsense past the checks: one line each, in bounded time and memory.

Files of a format are loaded in one subprocess with limits, as in `test_bad_files.py`, whose helpers these tests use.
"""

from __future__ import annotations

import math
import os
from importlib.util import find_spec

import numpy as np
import pytest
from test_bad_files import TWO, answers, body, cases, check, mjcf, write

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


def doubling(rounds: int, entry: str) -> str:
    """Lines in which each names the one before ten times."""
    lines = ["a0: &a0 {x0: 1, y0: 2, z0: 3}"]
    lines += [f"a{i}: &a{i} {entry.format(', '.join([f'*a{i - 1}'] * 10))}" for i in range(1, rounds)]
    return "\n".join(lines) + "\n"


YAML = {
    "alias bomb": (doubling(12, "[{}]"), ["alias bomb.yaml", "malformed", "line", "50000 values, aliases counted"]),
    "merge bomb": (doubling(12, "{{<<: [{}]}}"), ["malformed", "50000 values, aliases counted"]),
    "itself": ("a: &a [1, *a]\n", ["malformed", "line 1", "'a' stands inside"]),
    "itself, merged": ("a: &a {<<: *a}\n", ["malformed", "line 1", "'a' stands inside"]),
    "many values": ("a: [" + "1, " * 60_000 + "1]\n", ["malformed", "50000 values"]),
    "long digits": ("a: " + "1" * 1_000_000 + "\n", ["malformed", "1000000 characters"]),
    "long sum": ("a: " + "1:" * 500_000 + "1\n", ["malformed", "characters"]),
    "megabytes": ("a: 1\n# " + "x" * (5 * 2**20), ["megabytes.yaml", "5242", "at most 4194304"]),
    "escape in a key": ('"\\e[31mred": 1\nurdf: x\n', ["escape in a key.yaml", r"\x1b[31mred", "urdf"]),
    "a device": ("urdf: /dev/zero\n", ["/dev/zero", "not a regular file"]),
    "a folder": ("urdf: .\n", ["not a regular file"]),
}

BIG = "<replicate count='200'>{}</replicate>"
FLEX = '<flexcomp name="f" type="grid" count="100 100 100" spacing=".1 .1 .1" dim="3"/>'
HIDDEN = "<!--" * 200_000
MJCF = {
    "replicated": (mjcf(BIG.format(BIG.format(BIG.format(body())))), ["<replicate>", "40000 copies", "at most"]),
    "flexible": (mjcf(body(more=FLEX)), ["flexcomp", "1000000 copies", "at most"]),
    "keyframes": (mjcf(rest='<size nkey="1000000000"/>'), ["nkey", "'1000000000'", "at most"]),
    "user data": (mjcf(rest='<size nuser_body="1000000000"/>'), ["nuser_body", "'1000000000'", "at most"]),
    "arena": (mjcf(rest='<size memory="64G"/>'), ["memory", "'64G'", "at most"]),
    "picture": (
        mjcf(rest='<asset><texture type="2d" builtin="flat" width="9999" height="9999"/></asset>'),
        ["texture", "[9999, 9999]", "at most"],
    ),
    "gear": (mjcf(rest='<actuator><position joint="j" kp="1" gear="1e300"/></actuator>'), ["actuator_gear", "1e+300"]),
    "gain": (mjcf(rest='<actuator><position joint="j" kp="1e300"/></actuator>'), ["actuator_gainprm", "1e+300"]),
    "armature": (mjcf(body(inside='<joint name="j" armature="1e200"/>')), ["dof_armature", "1e+200", "up to"]),
    "range": (mjcf(body(inside='<joint range="1 -1"/>')), ["<joint> range", "'1 -1'", "not above the upper"]),
    "control range": (
        mjcf(rest='<actuator><motor joint="j" ctrlrange="1 -1"/></actuator>'),
        ["<motor> ctrlrange", "'1 -1'", "not above the upper"],
    ),
    "mesh of zeros": (mjcf(rest='<asset><mesh name="m" file="/dev/zero"/></asset>'), ["/dev/zero", "not a regular"]),
    "open comments": (HIDDEN + mjcf(), ["root element", "missing"]),
    "crowd": (mjcf("".join(body(f"b{i}", "<joint/>") for i in range(600))), ["size", "600 bodies", "at most"]),
    "other comments": (mjcf(f"<!-- a -- b -->{TWO}") + "<", ["malformed XML"]),
}

INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
LINK = f'<link name="l{{i}}"><inertial><mass value="1"/>{INERTIA}</inertial></link>'
JOINT = '<joint name="j{i}" type="revolute"><parent link="l{p}"/><child link="l{i}"/></joint>'


def chain(count: int) -> str:
    return (
        "<robot>"
        + LINK.format(i=0)
        + "".join((LINK + JOINT).format(i=i, p=i - 1) for i in range(1, count))
        + "</robot>"
    )


URDF = {
    "long chain": (chain(2000), ["number of links", "2000", "at most"]),
    "mass 1e300": (chain(2).replace('mass value="1"', 'mass value="1e300"'), ["mass", "1e+300", "up to 1e+12"]),
    "ratio": (
        chain(3).replace('<child link="l2"/>', '<child link="l2"/><mimic joint="j1" multiplier="1e200"/>'),
        ["coefficient", "e+200", "up to 1e+12"],
    ),
    "escape": (chain(2).replace('"l1"', '"\N{PILE OF POO}&#x9b;31m"'), ["link name", r"\x9b31m", "can be printed"]),
}
FORMATS = {".yaml": YAML, ".xml": MJCF, ".urdf": URDF}


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """What became of every file, by suffix and name."""
    folders = {suffix: tmp_path_factory.mktemp("hostile") for suffix in FORMATS}
    return {suffix: answers(write(folders[suffix], table, suffix)) for suffix, table in FORMATS.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "name", "parts"),
    [pytest.param(s, *case.values, id=f"{case.id}{s}") for s, table in FORMATS.items() for case in cases(table)],
)
def test_files(loaded, suffix, name, parts):
    if suffix == ".xml" and find_spec("mujoco") is None:
        pytest.skip("needs mujoco")
    answer = loaded[suffix].get(f"{name}{suffix}")
    assert answer is None or answer["message"].isprintable()
    check(answer, parts)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("suffix", [".yaml", ".urdf", ".xml"])
def test_a_pipe_that_nobody_writes_into_is_refused_at_once(tmp_path, suffix):
    os.mkfifo(tmp_path / f"pipe{suffix}")
    answer = answers([tmp_path / f"pipe{suffix}"])[f"pipe{suffix}"]
    check(answer, ["not a regular file", "expected"])


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
    with pytest.raises(RobotError, match=r"leg\.yaml: pose\.height is 0\.3: .*'toe', now -0\.\d+ m high"):
        Model(load_robot(write_robot(("height: 0.5", "height: 0.3"))))


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
        robot = load_robot(write(mjcf(joints)))
    messages = [str(w.message) for w in caught]
    assert len(messages) == 1
    assert len(messages[0]) < 600
    assert "\n" not in messages[0]
    assert sum("spring" in note for note in robot.notes) == 40
