"""Malformed robots of every format: one clear line each, no hang, nothing that a dependency prints or raises.

All files are loaded, and valid ones built into a `Model`, in a subprocess with a limit on time and memory; each test
looks at the answer for one file. `error_cases.yaml` is the table of files and messages.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from leg_files import URDF, YAML
from mjcf_files import body, plain_mjcf

import ce_gym
from ce_gym.model import Body, Inertial, Joint, LinearConstraint, Placement, Robot, RobotError, check_robot, load_robot
from ce_gym.model.errors import shown

DATA = Path(__file__).parents[1] / "data" / "urdf_plus"
SECONDS, BYTES = 90, 8 * 2**30
LOADER = f"""
import json, resource, sys, warnings
resource.setrlimit(resource.RLIMIT_AS, ({BYTES}, {BYTES}))
warnings.simplefilter("ignore")
from ce_gym.dynamics import Model
from ce_gym.model import load_robot
for path in sys.argv[1:]:
    answer = dict(path=path, error=None, message="", clean=True)
    try:
        Model(load_robot(path)).casadi_function('mass_matrix')
    except BaseException as error:
        clean = error.__cause__ is None and (error.__suppress_context__ or error.__context__ is None)
        answer.update(error=type(error).__name__, message=str(error), clean=clean)
    print(json.dumps(answer), flush=True)
"""


def answers(paths: list[Path]) -> tuple[dict[Path, dict], str]:
    """Load files in a subprocess; return answers by path, without files after one that hangs, and printed text."""
    command = [sys.executable, "-c", LOADER, *map(str, paths)]
    where = {"cwd": paths[0].parent, "env": os.environ | {"PYTHONPATH": str(Path(ce_gym.__file__).parents[1])}}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, **where)
        out, printed = done.stdout, done.stderr
    except subprocess.TimeoutExpired as hung:
        out, printed = (hung.stdout or b"").decode(), "it hangs"
    return {Path(answer["path"]): answer for answer in map(json.loads, out.splitlines())}, printed


def check(answer: dict | None, path: Path, parts: list[str]) -> None:
    assert answer is not None, "no answer: this file, or one before it, hangs or ends the process"
    assert answer["error"] == "RobotError", f"{answer['error']}: {answer['message']}"
    assert answer["clean"], "a traceback of a dependency would be shown"
    check_message(answer["message"], parts)
    assert answer["message"].startswith(("/", "the cluster")) or path.stem in answer["message"]


def check_message(message: str, parts: list[str]) -> None:
    assert message.isprintable()
    assert len(message) < 500
    assert re.search(".*".join(map(re.escape, parts)), message), message


@dataclasses.dataclass(frozen=True)
class Case:
    """A file and parts of its error message in order; the content of a leg is its URDF, a form feed, its YAML."""

    id: str
    file: str
    content: str | bytes
    parts: list[str]

    def write(self, folder: Path) -> Path:
        """Write the files of the case and return the path to load."""
        folder.mkdir()
        files = {self.file: self.content}
        if self.file == "leg":
            urdf, _, text = str(self.content).partition("\f")
            files = {"leg.yaml": text, "leg.urdf": urdf}
        for name, content in files.items():
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return folder / next(iter(files))


def base_of(file: str) -> str:
    if file == "leg":
        return f"{URDF}\f{YAML}"
    return (DATA / file).read_text() if (DATA / file).is_file() else ""


def table() -> Iterator[Case]:
    for group in yaml.safe_load((Path(__file__).parent / "error_cases.yaml").read_text()):
        base, old = base_of(group["file"]), group.get("replace", "")
        assert old in base, f"{old!r} is not in {group['file']}"
        for case, message in group["cases"].items():
            new = group.get("with", "@").replace("@", case)
            content = base.replace(old, new, 1) if old else base + new
            yield Case(f"{group['file']}: {case}"[:70], group["file"], content, message.split(" .. "))


def doubling(rounds: int, entry: str) -> str:
    """Lines in which each names the one before ten times."""
    lines = ["a0: &a0 {x0: 1, y0: 2, z0: 3}"]
    lines += [f"a{i}: &a{i} {entry.format(', '.join([f'*a{i - 1}'] * 10))}" for i in range(1, rounds)]
    return "\n".join(lines) + "\n"


def chain(count: int, mass: str = "1", name: str = "l{i}", mimic: str = "") -> str:
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    link = f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial></link>'
    ends = f'<parent link="{name.replace("i}", "p}")}"/><child link="{name}"/>{{tie}}'
    text = link.format(i=0)
    for i in range(1, count):
        joint = f'<joint name="j{{i}}" type="revolute">{ends}</joint>'
        text += (link + joint).format(i=i, p=i - 1, tie=mimic if i == 2 else "")
    return f"<robot>{text}</robot>"


LEG, BARS, HUMANOID = base_of("leg"), base_of("four_bar.urdf"), base_of("mit_humanoid_leg.urdf")
KNEE = HUMANOID[
    HUMANOID.index('  <coupling name="knee_t') : HUMANOID.index('  <joint independent="false" name="hipy_to_ankle')
]
NO_END = BARS.replace('<successor link="link3">', '<follower link="link3">').replace("</successor>", "</follower>")
GENERATED = [
    Case("400 digits", "leg", LEG.replace("mass: 0.1", f"mass: 1{'0' * 400}"), ["hip_rotor.mass", "finite number"]),
    Case("5000 digits", "leg", LEG.replace("mass: 0.1", f"mass: 1{'0' * 5000}"), ["leg.yaml", "malformed"]),
    Case("hex", "leg", LEG.replace("mass: 0.1", f"mass: [0x{'f' * 5000}]"), ["hip_rotor.mass", "finite number"]),
    Case("nested lists", "leg", f"{LEG}x: {'[' * 5000}", ["leg.yaml", "malformed YAML"]),
    Case("alias bomb", "r.yaml", doubling(12, "[{}]"), ["malformed", "line", "50000 values, aliases counted"]),
    Case("merge bomb", "r.yaml", doubling(12, "{{<<: [{}]}}"), ["malformed", "50000 values, aliases counted"]),
    Case("many values", "r.yaml", "a: [" + "1, " * 60_000 + "1]\n", ["malformed", "50000 values"]),
    Case("long digits", "r.yaml", "a: " + "1" * 1_000_000 + "\n", ["malformed", "1000000 characters"]),
    Case("long sum", "r.yaml", "a: " + "1:" * 500_000 + "1\n", ["malformed", "characters"]),
    Case("megabytes", "r.yaml", "a: 1\n# " + "x" * (5 * 2**20), ["r.yaml", "5242", "at most 4194304"]),
    Case("UTF-16 mark", "r.urdf", b"\xff\xfe<robot/>", ["r.urdf", "malformed XML"]),
    Case("long chain", "r.urdf", chain(2000), ["number of links", "2000", "at most"]),
    Case("mass 1e300", "r.urdf", chain(2, mass="1e300"), ["mass", "1e+300", "up to 1e+12"]),
    Case(
        "ratio",
        "r.urdf",
        chain(3, mimic='<mimic joint="j1" multiplier="1e200"/>'),
        ["coefficient", "e+200", "up to 1e+12"],
    ),
    Case("escape", "r.urdf", chain(2, name="\N{PILE OF POO}&#x9b;{i}"), ["link name", r"\x9b0", "can be printed"]),
    Case("truncated", "r.urdf", BARS[:-30], ["r.urdf", "malformed XML"]),
    Case("entities", "r.urdf", '<!DOCTYPE r [<!ENTITY a "&a;&a;">]>' + BARS.split("\n", 1)[1], ["DOCTYPE"]),
    Case("no loop end", "r.urdf", NO_END, ["loop 'loop1' <successor>", "missing"]),
    Case(
        "all independent",
        "r.urdf",
        BARS.replace('independent="false"', 'independent="true"'),
        ["has 1 freedom", "unlike link1, link2, link3"],
    ),
    Case("coupling missing", "r.urdf", HUMANOID.replace(KNEE, ""), ["knee_rotor"]),
    Case(
        "coupling twice",
        "r.urdf",
        HUMANOID.replace("</robot>", HUMANOID[HUMANOID.index('  <coupling name="ankle_t') :]),
        ["'ankle_transmission'", "used once"],
    ),
    Case("two encodings", "r.xml", plain_mjcf().encode("utf-16"), ["cannot be read"]),
    Case("bytes", "r.xml", bytes(range(256)), ["cannot be read"]),
    Case("nested", "r.xml", plain_mjcf("<body>" * 3000 + "</body>" * 3000), ["MuJoCo refuses", "too deep"]),
    Case("open comments", "r.xml", "<!--" * 200_000 + plain_mjcf(), ["root element", "missing"]),
    Case(
        "crowd",
        "r.xml",
        plain_mjcf("".join(body(f"b{i}", "<joint/>") for i in range(600))),
        ["size", "600 bodies", "most"],
    ),
]
CASES = [*table(), *GENERATED]
MJCF_CASES, OTHER_CASES = ([case for case in CASES if case.file.endswith(".xml") == mjcf] for mjcf in (True, False))


def loaded(folder: Path, cases: list[Case]) -> tuple[list[Path], dict[Path, dict], str]:
    paths = [case.write(folder / str(i)) for i, case in enumerate(cases)]
    return (paths, *answers(paths))


@pytest.fixture(scope="module")
def other_answers(tmp_path_factory):
    return loaded(tmp_path_factory.mktemp("errors"), OTHER_CASES)


@pytest.fixture(scope="module")
def mjcf_answers(tmp_path_factory):
    return loaded(tmp_path_factory.mktemp("errors"), MJCF_CASES)


@pytest.mark.parametrize("i", range(len(OTHER_CASES)), ids=lambda i: OTHER_CASES[i].id)
def test_one_line_says_where_and_what(other_answers, i):
    paths, found, _ = other_answers
    check(found.get(paths[i]), paths[i], OTHER_CASES[i].parts)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco") is None, reason="needs mujoco")
@pytest.mark.parametrize("i", range(len(MJCF_CASES)), ids=lambda i: MJCF_CASES[i].id)
def test_one_line_says_where_and_what_in_mjcf(mjcf_answers, i):
    paths, found, _ = mjcf_answers
    check(found.get(paths[i]), paths[i], MJCF_CASES[i].parts)


@pytest.mark.parametrize("format", ["other_answers", pytest.param("mjcf_answers", marks=pytest.mark.slow)])
def test_nothing_is_printed(request, format):
    assert request.getfixturevalue(format)[2] == ""


def test_the_files_without_mistake_are_robots(tmp_path):
    for file in ("leg", "four_bar.urdf", "mit_humanoid_leg.urdf"):
        load_robot(Case(file, file, base_of(file), []).write(tmp_path / file))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("suffix", [".yaml", ".urdf", ".xml"])
def test_a_pipe_that_nobody_writes_into_is_refused_at_once(tmp_path, suffix):
    path = tmp_path / f"pipe{suffix}"
    os.mkfifo(path)
    check(answers([path])[0][path], path, ["not a regular file", "expected"])


@pytest.mark.parametrize(
    ("file", "source"),
    [
        pytest.param("r.xml", plain_mjcf(body() + body("c", '<joint name="k"/>')), marks=pytest.mark.slow),
        pytest.param("r.urdf", BARS, marks=pytest.mark.slow),
        pytest.param("r.urdf", HUMANOID, marks=pytest.mark.slow),
        ("leg", LEG),
    ],
)
def test_damaged_files_show_nothing_but_our_errors(tmp_path, file, source):
    """Cut, double and replace words at random: a robot or a RobotError, nothing else."""
    if file == "r.xml":
        pytest.importorskip("mujoco")
    rng, cases = random.Random(1), []
    for i in range(150):
        words = re.split(r"(\W)", source)
        at = rng.choice([k for k, word in enumerate(words) if word != "\f"])
        damage = ["", words[at] * 2, "-1", "1e308", "nan", "<", "{", "*", '"', "&a;", "\n", "é", rng.choice(words)]
        words[at] = rng.choice(damage)
        cases.append(Case(str(i), file, "".join(words), []))
    paths, found, printed = loaded(tmp_path, cases)
    assert found.keys() == set(paths), printed
    wrong = [answer for answer in found.values() if answer["error"] not in (None, "RobotError")]
    assert wrong == []
    assert all("\n" not in answer["message"] and answer["clean"] for answer in found.values())
    assert file != "leg" or 25 < sum(answer["error"] is None for answer in found.values()) < 100, "some is harmless"


def test_messages_stop_inside_a_value_that_aliases_make_huge():
    class Counted:
        times = 0

        def __repr__(self):
            Counted.times += 1
            return "x" * 10_000

    assert len(shown([[Counted()] * 1000] * 1000)) <= 60
    assert Counted.times < 100


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
    with pytest.raises(RobotError) as caught:
        load_robot(name)
    check_message(str(caught.value), parts)


UNIT = Inertial(1.0, (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
ARM = Body("arm", "link", None, Placement(), Joint("revolute"), UNIT)
HAND = dataclasses.replace(ARM, name="hand", parent="arm")


def by_hand(*bodies: Body, **fields) -> Robot:
    return Robot("by hand", bodies, independent=tuple(body.name for body in bodies), **fields)


def arm(**fields) -> Robot:
    return by_hand(dataclasses.replace(ARM, **fields))


def tied(*coefficients: tuple[str, float]) -> Robot:
    return by_hand(ARM, HAND, constraints=(LinearConstraint("t", coefficients),))


@pytest.mark.parametrize(
    ("robot", "parts"),
    [
        (by_hand(), ["by hand", "bodies", "at least one"]),
        (by_hand(ARM, ARM), ["by hand", "body name", "'arm'", "no other body"]),
        (by_hand(HAND, ARM), ["by hand", "'hand' parent", "'arm'", "listed before"]),
        (by_hand(ARM, dataclasses.replace(HAND, joint=Joint("free"))), ["'hand' joint type", "'free'", "first body"]),
        (arm(joint=Joint("screw")), ["'arm' joint type", "'screw'", "prismatic"]),
        (arm(joint=Joint("revolute", (0, 0, 2))), ["'arm' joint axis", "unit axis"]),
        (arm(joint=Joint("revolute", damping=-1)), ["'arm' joint damping", "-1"]),
        (arm(joint=Joint("revolute", position=(math.nan, 1))), ["'arm' joint limits", "nan"]),
        (
            arm(inertial=dataclasses.replace(UNIT, inertia=((1, 1, 0), (0, 1, 0), (0, 0, 1)))),
            ["'arm' inertia", "symmetric"],
        ),
        (arm(placement=Placement(rotation=((1, 0, 0), (0, 1, 0), (0, 0, -1)))), ["'arm' rotation", "rotation matrix"]),
        (arm(placement=Placement(position=(0, math.inf, 0))), ["'arm' position", "inf", "finite"]),
        (tied(("arm", 1.0), ("hnad", 1.0)), ["constraint 't'", "'hnad'", "'hand'"]),
        (tied(("arm", 1.0), ("hand", 0.0)), ["constraint 't' coefficient of 'hand'", "0.0", "other than 0"]),
        (tied(("arm", 1.0), ("arm", 1.0)), ["constraint 't'", "each once"]),
    ],
)
def test_robots_made_by_hand_are_checked_too(robot, parts):
    check_robot(by_hand(ARM, HAND))
    with pytest.raises(RobotError) as caught:
        check_robot(robot)
    check_message(str(caught.value), parts)
