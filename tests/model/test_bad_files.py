"""Malformed robots of every format: one clear line each, no hang, nothing that a dependency prints or raises.

All files of a format are loaded, and those that load are built into a `Model`, in one subprocess with a limit on time
and memory; each test looks at what became of one file. `test_model_errors.py` has the table for the YAML + URDF pair.
"""

from __future__ import annotations

import json
import os
import random
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import ce_gym
from ce_gym.dynamics import Model
from ce_gym.model import RobotError, load_robot

DATA = Path(__file__).parents[1] / "data" / "urdf_plus"
SECONDS, BYTES = 90, 8 * 2**30

LOADER = f"""
import json, resource, sys, warnings
from pathlib import Path
resource.setrlimit(resource.RLIMIT_AS, ({BYTES}, {BYTES}))
warnings.simplefilter("ignore")
from ce_gym.dynamics import Model
from ce_gym.model import RobotError, load_robot
for path in sys.argv[1:]:
    answer = dict(file=Path(path).name, error=None, message="", clean=True)
    try:
        Model(load_robot(path)).casadi_function('mass_matrix')
    except BaseException as error:
        clean = error.__cause__ is None and (error.__suppress_context__ or error.__context__ is None)
        answer.update(error=type(error).__name__, message=str(error), clean=clean)
    print(json.dumps(answer), flush=True)
"""


def answers(paths: list[Path]) -> dict[str, dict]:
    """Load files in a subprocess; those after one that hangs have no answer."""
    command = [sys.executable, "-c", LOADER, *map(str, paths)]
    where = {"cwd": paths[0].parent, "env": os.environ | {"PYTHONPATH": str(Path(ce_gym.__file__).parents[1])}}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, **where)
        out, printed = done.stdout, done.stderr
    except subprocess.TimeoutExpired as hung:
        out, printed = (hung.stdout or b"").decode(), "it hangs"
    found = {answer["file"]: answer for answer in map(json.loads, out.splitlines())}
    return found | {"": {"printed": printed}}


def body(name: str = "b", inside: str = '<joint name="j"/>', geom: str = '<geom size=".1"/>', more: str = "") -> str:
    return f'<body name="{name}">{inside}{geom}{more}</body>'


def mjcf(world: str = body(), rest: str = "") -> str:
    return f"<mujoco><worldbody>{world}</worldbody>{rest}</mujoco>"


def mass(value: str, inertia: str = "1 1 1") -> str:
    return f'<inertial pos="0 0 0" mass="{value}" diaginertia="{inertia}"/>'


TWO = body() + body("c", '<joint name="k"/>')
PENDULUMS = body(
    "a", '<joint axis="0 1 0"/>', more=body("b", '<joint axis="0 1 0"/>').replace("<body", '<body pos=".6 0 0"')
)
TIE = '<equality><joint joint1="j" joint2="k" polycoef="{}"/></equality>'

MJCF = {
    # file: content, and what the message must say, in this order
    "empty": ("", ["empty.xml", "root element", "missing", "<mujoco>"]),
    "truncated": (mjcf()[:-20], ["truncated.xml", "malformed XML"]),
    "a URDF": ('<robot name="r"><link name="a"/></robot>', ["root element", "'robot'", "<mujoco>"]),
    "an SDF": ("<!-- <mujoco/> --><sdf/>", ["root element", "'sdf'", "<mujoco>"]),
    "nothing": ("<mujoco/>", ["bodies that move", "a body with a joint"]),
    "nothing moves": (mjcf(body(inside="")), ["bodies that move", "a body with a joint"]),
    "entities": ('<!DOCTYPE a [<!ENTITY b "c">]>' + mjcf(), ["DOCTYPE", "without document type"]),
    "two encodings": (mjcf().encode("utf-16"), ["cannot be read"]),
    "bytes": (bytes(range(256)), ["cannot be read"]),
    "mass nan": (mjcf(body(geom=mass("nan"))), ["mass", "'nan'", "finite"]),
    "mass inf": (mjcf(body(geom=mass("inf"))), ["body_mass", "inf", "finite"]),
    "mass below 0": (mjcf(body(geom=mass("-1"))), ["MuJoCo refuses", "mass and inertia", "larger"]),
    "mass huge": (mjcf(body(geom=mass("1e308", "1e308 1e308 1e308"))), ["body_inertia", "1e+308", "finite"]),
    "mass a word": (mjcf(body(geom=mass("heavy"))), ["MuJoCo refuses"]),
    "no mass": (mjcf(body(geom="")), ["MuJoCo refuses", "mass and inertia"]),
    "inertia": (mjcf(body(geom=mass("1", "1 1 9"))), ["MuJoCo refuses", "A + B >= C"]),
    "position inf": (mjcf(body().replace("<body", '<body pos="inf 0 0"')), ["body_pos", "inf", "finite"]),
    "axis nan": (mjcf(body(inside='<joint axis="nan 0 0"/>')), ["axis", "'nan 0 0'", "finite"]),
    "axis inf": (mjcf(body(inside='<joint axis="inf 0 0"/>')), ["finite"]),
    "axis 0": (mjcf(body(inside='<joint axis="0 0 0"/>')), ["MuJoCo refuses", "axis too small"]),
    "range": (
        mjcf(body(inside='<joint range="3 1" limited="true"/>')),
        ["<joint> range", "'3 1'", "not above the upper"],
    ),
    "damping": (mjcf(body(inside='<joint damping="-3"/>')), ["damping", "-3.0", "0 or more"]),
    "armature below 0": (mjcf(body(inside='<joint armature="-3"/>')), ["armature", "-3.0", "0 or more"]),
    "armature nan": (mjcf(body(inside='<joint armature="nan"/>')), ["armature", "'nan'", "finite"]),
    "two robots": (
        mjcf(body("a", "<freejoint/>") + body("b", "<freejoint/>")),
        ["bodies that move freely", "('a', 'b')", "one robot"],
    ),
    "same name": (mjcf(body() + body()), ["MuJoCo refuses", "repeated name 'b'"]),
    "unknown joint": (mjcf(rest='<equality><joint joint1="x"/></equality>'), ["MuJoCo refuses", "unknown element 'x'"]),
    "ratio inf": (mjcf(TWO, TIE.format("0 inf 0 0 0")), ["eq_data", "inf", "finite"]),
    "ratio nan": (mjcf(TWO, TIE.format("0 nan 0 0 0")), ["polycoef", "nan", "finite"]),
    "too many ties": (
        mjcf(TWO, TIE.format("0 1 0 0 0") + TIE.format("1 2 0 0 0")),
        ["fewer constraints than bodies"],
    ),
    "no freedom left": (
        mjcf(PENDULUMS, '<equality><connect body1="b" anchor=".6 0 0"/></equality>'),
        ["tied by b_to_world", "no freedom", "expected fewer constraints"],
    ),
    "open loop": (
        mjcf(
            PENDULUMS.replace(
                "</body></body>", '<site name="s" pos="1 0 0"/></body></body><site name="t" pos="9 0 0"/>'
            ),
            '<equality><connect site1="s" site2="t"/></equality>',
        ),
        ["does not close at the standing pose"],
    ),
    "base held": (
        mjcf(body("a", "<freejoint/>"), '<equality><connect body1="a" anchor="0 0 0"/></equality>'),
        ["constraint a_to_world", "('a',)", "free joint of a"],
    ),
    "gear": (mjcf(rest='<actuator><motor joint="j" gear="inf"/></actuator>'), ["actuator_gear", "inf", "finite"]),
    "gain": (mjcf(rest='<actuator><position joint="j" kp="-5"/></actuator>'), ["gains.kp.b", "-5.0", "0 or more"]),
    "keyframe": (mjcf(rest='<keyframe><key qpos="1 2 3"/></keyframe>'), ["MuJoCo refuses", "invalid qpos size"]),
    "keyframe inf": (mjcf(rest='<keyframe><key qpos="inf"/></keyframe>'), ["pose.joints.b", "finite"]),
    "gravity": (mjcf(rest='<option gravity="inf 0 0"/>'), ["gravity", "inf", "finite"]),
    "keyword": (mjcf(rest='<compiler angle="grad"/>'), ["MuJoCo refuses", "invalid keyword"]),
    "element": (mjcf(rest="<rotors/>"), ["MuJoCo refuses", "rotors"]),
    "itself": ('<mujoco><include file="itself.xml"/></mujoco>', ["MuJoCo refuses", "already included"]),
    "missing include": ('<mujoco><include file="x.xml"/></mujoco>', ["MuJoCo refuses", "x.xml"]),
    "missing mesh": (mjcf(rest='<asset><mesh name="m" file="m.stl"/></asset>'), ["MuJoCo refuses", "m.stl"]),
    "a million copies": (
        mjcf(f'<replicate count="1000000">{body()}</replicate>'),
        ["<replicate>", "1000000 copies", "at most"],
    ),
    "a field of gigabytes": (
        mjcf(rest='<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>'),
        ["nrow", "'100000'", "at most"],
    ),
    "a stack of terabytes": (mjcf(rest='<size memory="100000G"/>'), ["<size> memory", "'100000G'", "at most"]),
    "nested": (mjcf("<body>" * 3000 + "</body>" * 3000), ["MuJoCo refuses", "too deep"]),
}

BARS, LEG = ((DATA / f"{name}.urdf").read_text() for name in ("four_bar", "mit_humanoid_leg"))


def edited(text: str, *edits: tuple[str, str]) -> str:
    for old, new in edits:
        assert old in text, f"{old!r} is not in the file"
        text = text.replace(old, new, 1)
    return text


URDF_PLUS = {
    "truncated": (BARS[:-30], ["truncated.urdf", "malformed XML"]),
    "entities": ('<!DOCTYPE r [<!ENTITY a "&a;&a;">]>' + BARS.split("\n", 1)[1], ["DOCTYPE"]),
    "loop type": (
        edited(BARS, ('"loop1" type="revolute"', '"loop1" type="screw"')),
        ["'loop1' type", "'screw'", "ball"],
    ),
    "no loop type": (edited(BARS, ('"loop1" type="revolute"', '"loop1"')), ["loop 'loop1' type", "missing"]),
    "loop end": (edited(BARS, ('<predecessor link="link2">', '<predecessor link="lnk2">')), ["'lnk2'", "'link2'"]),
    "no loop end": (
        edited(BARS, ('<successor link="link3">', '<follower link="link3">'), ("</successor>", "</follower>")),
        ["loop 'loop1' <successor>", "missing"],
    ),
    "loop on itself": (
        edited(BARS, ('<successor link="link3">', '<successor link="link2">')),
        ["loop 'loop1'", "'link2'", "two links that can move against each other"],
    ),
    "loop axis": (
        edited(BARS, ('</successor>\n        <axis xyz="0 0 1"', '</successor>\n<axis xyz="0 0 0"')),
        ["axis"],
    ),
    "loop axis nan": (
        edited(BARS, ('</successor>\n        <axis xyz="0 0 1"', '</successor>\n<axis xyz="nan 0 1"')),
        ["loop 'loop1' <axis xyz>", "'nan 0 1'", "3 finite"],
    ),
    "loop origin": (
        edited(BARS, ('<origin xyz="1.0 0.0 0.0"/>\n        </pred', '<origin xyz="1"/></pred')),
        ["origin"],
    ),
    "loop out of reach": (
        edited(BARS, ('<origin xyz="1.0 0.0 0.0"/>\n        </pred', '<origin xyz="9 0 0"/></pred')),
        ["loop1", "does not close"],
    ),
    "loop across axes": (
        edited(BARS, ('</successor>\n        <axis xyz="0 0 1"', '</successor>\n<axis xyz="1 0 0"')),
        ["loop1", "expected"],
    ),
    "independent": (
        edited(BARS, ('independent="true"', 'independent="yes"')),
        ["'joint1' independent", "'yes'", "true or"],
    ),
    "none independent": (edited(BARS, ('independent="true"', 'independent="false"')), ["has 1 freedom", "unlike none"]),
    "all independent": (
        BARS.replace('independent="false"', 'independent="true"'),
        ["has 1 freedom", "unlike link1, link2, link3"],
    ),
    "coupling end": (edited(LEG, ('<successor link="knee_rotor"', '<successor link="rotor"')), ["'rotor'", "rotor"]),
    "coupling ends": (
        edited(LEG, ('<successor link="knee_rotor"/>', "")),
        ["'knee_transmission' <successor>", "missing"],
    ),
    "coupling ratio 0": (
        edited(LEG, ('ratio value="12.0"', 'ratio value="0"')),
        ["'knee_transmission'", "0.0", "other"],
    ),
    "coupling ratio nan": (edited(LEG, ('ratio value="12.0"', 'ratio value="nan"')), ["'knee_transmission'", "'nan'"]),
    "no ratio": (edited(LEG, ('<ratio value="12.0"/>', "")), ["'knee_transmission' <ratio>", "missing"]),
    "coupling to its carrier": (
        edited(LEG, ('<predecessor link="knee_link"', '<predecessor link="hip_ry_link"')),
        ["'knee_transmission'", "neither of which carries the other"],
    ),
    "coupling to the base": (
        edited(LEG, ('<predecessor link="knee_link"', '<predecessor link="base"')),
        ["'knee_transmission'", "two links that move"],
    ),
    "coupling missing": (
        LEG.replace(
            LEG[LEG.index('  <coupling name="knee_t') : LEG.index('  <joint independent="false" name="hipy_to_ankle')],
            "",
        ),
        ["knee_rotor"],
    ),
    "coupling twice": (
        LEG.replace("</robot>", LEG[LEG.index('  <coupling name="ankle_t') :]),
        ["'ankle_transmission'", "used once"],
    ),
    "two parents": (
        edited(BARS, ('<child link="link3"/>', '<child link="link2"/>')),
        ["'link2' parents", "close a loop by a constraint"],
    ),
    "rotor inertia": (edited(LEG, ('ixx="1.084e-4"', 'ixx="-1"')), ["'hip_rz_rotor' inertia", "semidefinite"]),
}

ROD = "{{name: t, type: rod, first: {}, second: {}, length: {}}}"
END = "{{body: {}, point: {}}}"
HERE, THERE = END.format("trunk", "[0, 0, 0]"), END.format("foot", "[0, 0, 0]")
YAML_LOOPS = {
    "no such kind": ("{name: t, type: spring}", ["constraints[0].type", "'spring'", "linear, loop, rod, function"]),
    "no kind": ("{name: t}", ["constraints[0].type", "missing"]),
    "unknown body": (
        ROD.format(END.format("thgh", "[0, 0, 0]"), THERE, 1),
        ["constraints[0].first", "'thgh'", "'thigh'"],
    ),
    "no end": ("{name: t, type: rod, first: {}, second: {}, length: 1}", ["constraints[0].first.body", "missing"]),
    "two numbers": (ROD.format(END.format("trunk", "[0, 0]"), THERE, 1), ["first.point", "[0, 0]", "3 numbers"]),
    "length 0": (ROD.format(HERE, THERE, 0), ["constraint 't' length", "0.0", "above 0"]),
    "length nan": (ROD.format(HERE, THERE, ".nan"), ["constraints[0].length", "nan", "finite"]),
    "one body": (ROD.format(THERE, END.format("shank", "[0, 0, 1]"), 1), ["constraint 't'", "two different bodies"]),
    "both joints tied": (ROD.format(HERE, THERE, 0.4), ["expected"]),
    "out of reach": (ROD.format(HERE, THERE, 9), ["expected"]),
    "base held by a joint": (
        "{name: t, type: loop, joint: ball, first: {body: trunk}, second: {body: world}}",
        ["constraint t", "('trunk',)", "free joint of trunk"],
    ),
    "base held by a rod": (
        ROD.format(HERE, END.format("world", "[0, 0, 0]"), 1),
        ["constraint t", "('trunk',)", "free joint of trunk"],
    ),
    "no loop": (
        "{name: t, type: loop, joint: ball, first: {body: trunk}, second: {body: thigh}}",
        ["is redundant", "expected it left out"],
    ),
    "screw joint": ("{name: t, type: loop, joint: screw}", ["constraints[0].joint", "'screw'", "revolute, ball"]),
    "axis of a ball": ("{name: t, type: loop, joint: ball, axis: [0, 0, 1]}", ["constraints[0].axis", "no axis"]),
    "axis 0": ("{name: t, type: loop, joint: revolute, axis: [0, 0, 0]}", ["constraints[0].axis", "other than 0"]),
    "unknown function": (
        "{name: t, type: function, function: f, arguments: [thigh, shank]}",
        ["constraint 't'", "'f'"],
    ),
    "list for a name": ("{name: t, type: function, function: [f], arguments: [thigh]}", ["function", "['f']", "text"]),
}


@pytest.mark.parametrize(("entry", "parts"), YAML_LOOPS.values(), ids=YAML_LOOPS)
def test_constraints_in_yaml(write_robot, entry, parts):
    path = write_robot(("gains:", f"constraints: [{entry}]\nindependent: [thigh, shank]\ngains:"))
    with pytest.raises(RobotError) as caught:
        Model(load_robot(path))
    assert "\n" not in str(caught.value)
    assert re.search(".*".join(map(re.escape, parts)), str(caught.value)), caught.value


def cases(table: dict[str, tuple]) -> list:
    return [pytest.param(name, parts, id=name) for name, (_, parts) in table.items()]


def write(folder: Path, table: dict[str, tuple], suffix: str) -> list[Path]:
    paths = []
    for name, (content, _) in table.items():
        path = folder / f"{name}{suffix}"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        paths.append(path)
    return paths


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """What became of every file, by format and name."""
    folders = {suffix: tmp_path_factory.mktemp("bad") for suffix in (".xml", ".urdf")}
    tables = {".xml": MJCF, ".urdf": URDF_PLUS}
    return {suffix: answers(write(folders[suffix], tables[suffix], suffix)) for suffix in tables}


def check(answer: dict | None, parts: list[str]) -> None:
    assert answer is not None, "no answer: this file, or one before it, hangs or ends the process"
    assert answer["error"] == "RobotError", f"{answer['error']}: {answer['message']}"
    assert answer["clean"], "a traceback of a dependency would be shown"
    assert "\n" not in answer["message"]
    assert len(answer["message"]) < 500
    assert answer["message"].startswith(("/", "the cluster")) or answer["file"] in answer["message"]
    assert re.search(".*".join(map(re.escape, parts)), answer["message"]), answer["message"]


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco") is None, reason="needs mujoco")
@pytest.mark.parametrize(("name", "parts"), cases(MJCF))
def test_mjcf(loaded, name, parts):
    check(loaded[".xml"].get(f"{name}.xml"), parts)


@pytest.mark.parametrize(("name", "parts"), cases(URDF_PLUS))
def test_urdf_plus(loaded, name, parts):
    check(loaded[".urdf"].get(f"{name}.urdf"), parts)


@pytest.mark.parametrize("suffix", [".xml", ".urdf"])
def test_nothing_is_printed(loaded, suffix):
    assert loaded[suffix][""]["printed"] == ""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".xml", ".urdf"])
def test_damaged_files_show_nothing_but_our_errors(tmp_path, suffix):
    """Cut, double and replace words at random: a robot or a RobotError, nothing else."""
    if suffix == ".xml":
        pytest.importorskip("mujoco")
    rng = random.Random(1)
    sources = [mjcf(TWO, TIE.format("0 2 0 0 0"))] if suffix == ".xml" else [BARS, LEG]
    paths = []
    for i in range(150):
        words = re.split(r"(\W)", rng.choice(sources))
        at = rng.randrange(len(words))
        words[at] = rng.choice(["", words[at] * 2, "-1", "1e308", "nan", "<", '"', "&a;", "\n", "é", rng.choice(words)])
        paths.append(tmp_path / f"{i}{suffix}")
        paths[-1].write_text("".join(words), encoding="utf-8")
    found = answers(paths)
    printed = found.pop("")["printed"]
    assert len(found) == len(paths), printed
    errors = {answer["error"] for answer in found.values()}
    assert errors == {None, "RobotError"}, [a for a in found.values() if a["error"] not in (None, "RobotError")]
    assert all("\n" not in answer["message"] and answer["clean"] for answer in found.values())
