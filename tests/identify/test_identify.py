"""Identification finds planted parameters within its intervals, and refuses bad logs in one line."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ce_gym import Model, Robot, RobotError, Simulator, load_robot
from ce_gym.__main__ import main
from ce_gym.identify import Identified, Log, LogError, identify, page, read_log, report, simulate_log, to_yaml
from ce_gym.identify.base_fixed import fix_base
from ce_gym.identify.identifiability import correlation_time
from ce_gym.model import assets_folder

pytest.importorskip("scipy")
pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

PLANTED = {
    "rotor_inertia:HR_hip_rotor": 0.8,
    "rotor_inertia:HR_knee_rotor": 1.3,
    "motor_friction:HR_abad_rotor": 0.03,
    "motor_friction:HR_hip_rotor": 0.04,
    "motor_friction:HR_knee_rotor": 0.05,
    "delay": 0.0043,
}
KINDS = ("rotor_inertia", "motor_friction", "delay")


@pytest.fixture(scope="module")
def leg() -> Robot:
    return fix_base(load_robot("mini_cheetah"), ["HR_knee_link"])


@pytest.fixture(scope="module")
def log(leg: Robot) -> Log:
    return simulate_log(leg, 8.0, planted=PLANTED, noise=2e-4, substep=1e-3)


@pytest.fixture(scope="module")
def result(leg: Robot, log: Log) -> Identified:
    return identify(leg, log, kinds=KINDS)


def test_frames_on_the_base_are_left_out():
    """Go2's file has frames on its head."""
    go2 = fix_base(load_robot("go2"), ["FL_calf"])
    assert {frame.body for frame in go2.frames} <= {body.name for body in go2.bodies}
    assert Model(go2).nv == 3


def test_planted_parameters_are_found(result: Identified):
    for name, value in PLANTED.items():
        assert result[name] == pytest.approx(value, rel=0.02), name
        low, high = result.intervals[[parameter.name for parameter in result.parameters].index(name)]
        assert abs(result[name] - value) < high - low, name  # 3.9 standard deviations
    assert (result.std / np.abs(result.values)).max() < 0.02
    assert result.warnings == ()


def test_held_out_error_is_that_of_the_encoders(result: Identified):
    assert result.held_out.max() < 1.3 * 2e-4
    assert result.held_out_before.min() > 5 * result.held_out.max()


@pytest.mark.slow
def test_friction_and_mass_of_joints_without_motors():
    planted = {"joint_friction:shank_driver": 0.03, "joint_damping:thigh": 0.02, "added_mass:foot": 0.05}
    log = simulate_log("planar_leg_linkage", 4.0, planted=planted, noise=1e-4, substep=1e-3)
    links = [b.name for b in load_robot("planar_leg_linkage").bodies if b.kind == "link"]
    fixed = [f"added_mass:{name}" for name in links if name != "foot"]
    result = identify("planar_leg_linkage", log, kinds=("joint_friction", "joint_damping", "added_mass"), fixed=fixed)
    for parameter, value, std in zip(result.parameters, result.values, result.std, strict=True):
        name = parameter.name
        assert abs(value - planted.get(name, 0.0)) < 4 * std + 1e-4 * parameter.scale, name
        assert std < 0.1 * planted.get(name, np.inf), name


def test_the_written_file_loads_and_is_the_same_robot(result: Identified, tmp_path: Path):
    """The robot of the written file moves as the original robot with the estimates as simulator parameters."""
    path = tmp_path / "result.yaml"
    path.write_text(to_yaml(result, "mini_cheetah"))
    laid, plain = Model(fix_base(load_robot(path), ["HR_knee_link"])), Model(result.robot)
    written = [p for p in result.parameters if p.kind != "delay"]
    names = tuple(dict.fromkeys(p.simulator_parameter for p in written))
    ours = Simulator(plain, 1, 0.001, motors="limited", parameters=names)
    for name in names:
        mine = [(p.entry, result[p.name]) for p in written if p.simulator_parameter == name]
        ours.set_parameter(name, [value for _, value in sorted(mine)])
    theirs = Simulator(laid, 1, 0.001, motors="limited")
    bare = Simulator(plain, 1, 0.001, motors="limited")
    for sim in (ours, theirs, bare):
        sim.step(plain.standing_q + 0.3, 50)
    np.testing.assert_allclose(theirs.q, ours.q, rtol=0, atol=1e-7)  # eight digits are written
    assert np.abs(bare.q - ours.q).max() > 1e-3


def test_report_and_page_name_every_parameter(result: Identified):
    text, shown = report(result), page(result)
    for name in PLANTED:
        assert name in text
        assert name in shown
    assert shown.count("<svg") == 6  # two plots for each angle


def test_a_log_is_read_as_it_was_saved(log: Log, tmp_path: Path):
    read = read_log(log.save(tmp_path / "log.csv"))
    assert (read.commanded, read.measured) == (log.commanded, log.measured)
    assert read.dt == pytest.approx(log.dt)
    np.testing.assert_allclose(read.values, log.values, atol=1e-8)


GOOD = "time,command:a,angle:a\n" + "".join(f"{k / 100},0,0\n" for k in range(120))


def in_time(unit: float) -> str:
    """A good log with another unit of time."""
    return "time,command:a,angle:a\n" + "".join(f"{unit * k / 100},0,0\n" for k in range(120))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD.replace("angle:a", "angel:a"), r"column 3 is 'angel:a': expected time, or command:"),
        (GOOD.replace("angle:a", "command:a"), r"column 3 is command:a again: expected each column once"),
        (GOOD.replace("angle:a", "torque:a"), r"no column angle:NAME"),
        (GOOD.replace("0.5,0,0", "0.5,0,x"), r"row 52, column angle:a is 'x': expected a finite number"),
        (GOOD.replace("0.5,0,0", "0.5,nan,0"), r"row 52, column command:a is 'nan'"),
        (GOOD.replace("0.5,0,0", "0.5,0"), r"row 52 has 2 cells: expected 3"),
        (GOOD.replace("0.5,0,0", "0.52,0,0"), r"row 52, column time is 0.52: expected evenly spaced rows"),
        (GOOD[: GOOD.index("0.5,0,0")], r"50 rows: expected at least 100"),
        ("", r"no column time"),
        ("x" * 200_000, r"row 1: field larger than field limit .*: expected names of columns"),
        (in_time(1e3), r"rows 10 apart: expected time in seconds, not in milliseconds, rows 1e-05 to 0.1 s apart"),
        (in_time(1e6), r"rows 10000 apart: expected time in seconds, not in microseconds"),
        (in_time(1e9), r"rows 1e\+07 apart: expected time in seconds, not in nanoseconds"),
        (in_time(1e-6), r"rows 1e-08 apart: expected time in seconds, rows"),
    ],
)
def test_bad_logs_are_one_line(text: str, message: str, tmp_path: Path):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=message) as error:
        read_log(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_logs_that_do_not_fit_the_robot(leg: Robot, log: Log):
    with pytest.raises(LogError, match="no column command:HR_knee_link: expected one for each of"):
        identify(leg, replace(log, commanded=log.commanded[:2], commands=log.commands[:, :2]))
    with pytest.raises(LogError, match="no column determines the position of HR_knee_link"):
        identify(leg, replace(log, measured=log.measured[:2], values=log.values[:, :2]))
    with pytest.raises(RobotError, match=r"column is 'HR_kneelink': .*did you mean 'HR_knee_link'"):
        identify(leg, replace(log, commanded=("HR_kneelink", *log.commanded[1:])))
    fast = np.column_stack([log.values, 400.0 * np.ones(len(log.values))])
    for changes, control, message in (
        (
            {"values": np.degrees(log.values)},
            "position",
            r"angle:HR_abad_link: up to .* radians or metres, not degrees",
        ),
        ({"commands": np.degrees(log.commands)}, "position", r"command:HR_abad_link: up to .* not degrees"),
        (
            {"commands": np.full_like(log.commands, 1e4)},
            "torque",
            r"command:HR_abad_link: .* N m or N, not a thousandth",
        ),
        (
            {"measured": (*log.measured, ("speed", "HR_abad_link")), "values": fast},
            "position",
            r"speed:.* rad/s or m/s",
        ),
    ):
        with pytest.raises(LogError, match=message):
            identify(leg, replace(log, **changes), control=control)
    with pytest.raises(LogError, match="all measurements are constant: expected a robot that moves"):
        identify(leg, replace(log, values=0 * log.values))
    with pytest.raises(LogError, match="rows: expected at least"):
        identify(leg, log, window=4.0)
    with pytest.raises(RobotError, match=r"transmission is 'elastik': expected .*did you mean 'elastic'"):
        identify(leg, log, transmission="elastik")
    with pytest.raises(RobotError, match="kind is 'colour': expected a kind of parameter"):
        identify(leg, log, kinds=("colour",))


def test_inputs_are_not_overwritten(log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for kind in ("yaml", "urdf"):
        shutil.copy(assets_folder() / "mit_humanoid_leg" / f"mit_humanoid_leg.{kind}", tmp_path)
    robot, base = tmp_path / "mit_humanoid_leg.yaml", tmp_path / "mit_humanoid_leg.urdf"
    robot.rename(tmp_path / "leg.yaml")
    (tmp_path / "link.yaml").hardlink_to(base)
    log.save(tmp_path / "leg.csv")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    robot, base, link, file = (str(tmp_path / name) for name in ("leg.yaml", base.name, "link.yaml", "leg.csv"))
    reads, exists = "the command reads this file", "exists already"
    for words, message in (
        ([robot, file], reads),
        ([robot, file, "--out", base, "--force"], reads),
        ([robot, file, "--out", link, "--force"], reads),
        ([robot, file, "--out", f"{base}.yaml", "--html", file, "--force"], reads),
        ([robot, robot, "--simulate", "2", "--force"], reads),
        ([robot, file, "--simulate", "2"], exists),
    ):
        assert main(["identify", *words]) == 2
        assert message in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_robots_without_a_plain_yaml_file_are_refused_before_the_search(
    log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "over.yaml").write_text("robot: mini_cheetah\nidentified: {}\n")
    (tmp_path / "leg.urdf").write_text("<robot/>")
    file = str(log.save(tmp_path / "leg.csv"))
    for robot, message in (
        (str(tmp_path / "over.yaml"), "over.yaml: identified: expected a robot file without"),
        (str(tmp_path / "leg.urdf"), "leg.urdf: expected a robot of the package or a YAML file"),
        ("menagerie:unitree_go2", "menagerie:unitree_go2: expected a robot of the package or a YAML file"),
    ):
        assert main(["identify", robot, file]) == 2
        assert message in (said := capsys.readouterr().err)
        assert said.count("\n") == 1


def test_identified_factors_act_in_any_order(tmp_path: Path):
    """A link's factor is one on what its file has, whatever its rotor's does to it."""
    parts = "rotor_inertia: {HR_knee_rotor: 1.3}", "link_inertia: {HR_hip_link: 2}"
    inertias = []
    for i, order in enumerate((parts, parts[::-1])):
        (tmp_path / f"{i}.yaml").write_text(f"robot: mini_cheetah\nidentified: {{{', '.join(order)}}}\n")
        inertias.append(np.array(load_robot(tmp_path / f"{i}.yaml").body("HR_hip_link").inertial.inertia))
    np.testing.assert_array_equal(*inertias)
    before = load_robot("mini_cheetah")
    rotor = before.body("HR_knee_rotor")
    axis = np.array(rotor.joint.axis)
    spin = axis @ np.array(rotor.inertial.inertia) @ axis
    doubled = 2 * np.array(before.body("HR_hip_link").inertial.inertia)
    assert np.trace(inertias[0]) == pytest.approx(np.trace(doubled) - 0.3 * spin, rel=1e-12)


def test_correlation_in_time():
    """Of white noise 1, of a first-order process (1 + a) / (1 - a)."""
    rng, a = np.random.default_rng(0), 0.6
    white = rng.normal(size=(200, 100, 3))
    assert correlation_time(white) == pytest.approx(1.0, abs=0.05)
    colored = np.zeros_like(white)
    for k in range(1, 100):
        colored[:, k] = a * colored[:, k - 1] + white[:, k]
    assert correlation_time(colored[:, 20:]) == pytest.approx((1 + a) / (1 - a), rel=0.1)


def test_bad_identified_sections_are_one_line(tmp_path: Path):
    path = tmp_path / "over.yaml"
    for text, message in (
        ("{rotor_inertia: {knee: 1.1}}", "identified.rotor_inertia is 'knee'"),
        ("{rotor_inertia: {HR_hip_rotor: -1}}", "identified.rotor_inertia.HR_hip_rotor is -1"),
        ("{colour: {HR_hip_rotor: 1}}", "identified is 'colour'"),
    ):
        path.write_text(f"robot: mini_cheetah\nidentified: {text}\n")
        with pytest.raises(RobotError, match=message):
            load_robot(path)
