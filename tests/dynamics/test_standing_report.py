"""Whether gains carry a robot: an inverted pendulum on an ankle stands above m g h and falls below it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ce_gym.__main__ import main
from ce_gym.diagnostics.standing import (
    StandingReport,
    as_text,
    contact_heights,
    fall_times,
    has_fallen,
    joints_at_feet,
    pitch_stiffness,
    seconds_to_compile,
    simulate_standing,
    standing_contacts,
    standing_report,
)
from ce_gym.dynamics import Model

MASS, HEIGHT, FOOT = 10.0, 0.8, 1.0  # [kg], of the trunk above the ankle [m], of the foot [kg]
TOPPLING = 9.81 * (MASS * HEIGHT - FOOT * 0.08)
URDF = f"""<robot name="pole"><link name="trunk"><inertial><mass value="{MASS}"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<link name="foot"><inertial><origin xyz="0 0 -0.08"/><mass value="{FOOT}"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
<joint name="ankle" type="revolute"><parent link="trunk"/><child link="foot"/><origin xyz="0 0 -{HEIGHT}"/>
<axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" effort="1000" velocity="50"/></joint></robot>"""
YAML = """name: pole
urdf: pole.urdf
base: floating
contacts:
  a: {body: foot, position: [0.3, 0.2, -0.1], radius: 0, group: foot}
  b: {body: foot, position: [0.3, -0.2, -0.1], radius: 0, group: foot}
  c: {body: foot, position: [-0.3, 0.2, -0.1], radius: 0, group: foot}
  d: {body: foot, position: [-0.3, -0.2, -0.1], radius: 0, group: foot}
  head: {body: trunk, position: [0, 0, 0.1], radius: 0.05, group: torso}
material: {stiffness: 1.0e+6, damping: 5000, friction: 1.0}
pose: {height: 0.9}
gains: {kp: KP, kd: 5}
"""


def pole(folder: Path, kp: float) -> str:
    """Write a trunk on a wide flat foot, with one ankle in pitch, and return its file."""
    (folder / "pole.urdf").write_text(URDF)
    (folder / "pole.yaml").write_text(YAML.replace("KP", f"{kp}"))
    return str(folder / "pole.yaml")


def test_pendulum_falls_below_its_weight_times_height_and_stands_above(tmp_path: Path) -> None:
    model = Model(pole(tmp_path, TOPPLING))
    factors = np.array([0.8, 0.95, 1.05, 1.2])[:, None]
    np.testing.assert_array_equal(np.isinf(fall_times(model, factors)), [False, False, True, True])


def test_what_would_carry_it(tmp_path: Path) -> None:
    """With 0.45 of the necessary stiffness the first factor above 2 suffices; else the pole falls as a pendulum."""
    report = simulate_standing(Model(pole(tmp_path, 0.45 * TOPPLING)))
    assert report.ankles == ("foot",)
    assert report.toppling == pytest.approx(TOPPLING, rel=1e-9)
    assert report.stiffness == pytest.approx(0.45 * TOPPLING, rel=1e-9)
    assert report.factor == report.ankle_factor == 2.8
    rate = np.sqrt(0.55 * TOPPLING / (MASS * HEIGHT**2 + 0.1))  # of growth, but for damping
    undamped = np.arccosh(0.5 / (0.02 / HEIGHT / rate)) / rate  # until it has tilted by 0.5 rad
    assert report.fall_time is not None
    assert undamped < report.fall_time < 2.5 * undamped
    words = as_text(report)
    assert "All position gains times 2.8 would hold the robot." in words
    assert "Gains of foot alone" in words


def boxes(feet: int, torso: int, shanks: int) -> str:
    """Return entries of boxes, eight contacts each, foot boxes one above the other."""
    foot = "{{body: foot, shape: box, size: [0.6, 0.4, 0.02], position: [0, 0, {z}], group: foot}}"
    rest = "{{body: trunk, shape: box, size: [0.1, 0.1, 0.1], position: [0, 0, {z}], group: {group}}}"
    lines = [f"  foot{i}: {foot.format(z=-0.09 + 0.02 * i)}" for i in range(feet)]
    lines += [f"  torso{i}: {rest.format(z=0.01 * i, group='torso')}" for i in range(torso)]
    lines += [f"  shank{i}: {rest.format(z=0.01 * i, group='shank')}" for i in range(shanks)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("counts", "chosen", "choice"),
    [
        ((1, 1, 1), 24, "all"),
        ((1, 1, 28), 16, "groups foot and torso"),
        ((2, 10, 0), 16, "group foot"),
        ((6, 1, 20), 24, "the lowest of group foot"),
    ],
)
def test_of_many_contacts_some_are_compiled(tmp_path: Path, counts: tuple, chosen: int, choice: str) -> None:
    file = Path(pole(tmp_path, 2 * TOPPLING))
    before, after = YAML.index("  a: {body"), YAML.index("material:")
    file.write_text(f"{YAML[:before]}{boxes(*counts)}\n{YAML[after:]}".replace("KP", f"{2 * TOPPLING}"))
    model = Model(file)
    assert len(model.robot.contacts) == 8 * sum(counts)
    names, words = standing_contacts(model)
    assert (len(names), words) == (chosen, choice)
    if choice.startswith("the lowest"):
        lowest = {f"foot{i}" for i in range(3)}  # boxes of 8 contacts, some as low as the next box's
        assert lowest <= {name.split("_")[0] for name in names}
    assert seconds_to_compile(model) < 60
    if sum(counts) == 30:
        words = standing_report(model)
        assert "stands 30 s" in words
        assert "Simulated with 16 of its 240 contacts: groups foot and torso." in words


def report(**figures: Any) -> StandingReport:
    """Return a report of a robot that falls, with some figures changed."""
    usual = {"fall_time": 0.3, "ankles": ("knee",), "ankle_factor": None, "factor": 4.0, "toppling": 30.0}
    usual |= {"stiffness": 20.0, "gap": 0.0, "contacts": 8, "choice": "all", "all_contacts": 8}
    return StandingReport(**(usual | figures))


def test_figures_that_mean_nothing_are_not_printed() -> None:
    assert "times height above these joints is 30 N m/rad; their gains hold 20" in as_text(report())
    assert "Gains of knee alone would not hold the robot, not even times 64." in as_text(report())
    below = as_text(report(toppling=-822.0))
    assert "-822" not in below
    assert "centre of mass is below these joints" in below
    sideways = as_text(report(stiffness=0.0))
    assert "None of these joints turns about the lateral axis" in sideways
    assert "hold 0" not in sideways
    assert "lowest contact is 0.054 m below the ground" in as_text(report(gap=-0.054))
    assert "lowest contact is 0.120 m above the ground" in as_text(report(gap=0.12, fall_time=None))
    assert "lowest contact" not in as_text(report(gap=0.009))


def test_gains_about_other_axes_do_not_hold_in_pitch(tmp_path: Path) -> None:
    """An ankle that rolls, its axis turned by a rounded right angle: the lateral part of the axis is rounding."""
    file = Path(pole(tmp_path, TOPPLING))
    (tmp_path / "pole.urdf").write_text(URDF.replace('<axis xyz="0 1 0"/>', '<axis xyz="1 1e-15 0"/>'))
    assert pitch_stiffness(Model(file), ("foot",)) == 0.0
    (tmp_path / "pole.urdf").write_text(URDF.replace('<axis xyz="0 1 0"/>', '<axis xyz="1 1 0"/>'))
    assert pitch_stiffness(Model(file), ("foot",)) == pytest.approx(TOPPLING / 2, rel=1e-9)


def test_the_gap_below_a_robot_is_that_of_its_lowest_contact(tmp_path: Path) -> None:
    """The pole's foot is 0.9 m below its base."""
    file = Path(pole(tmp_path, TOPPLING))
    file.write_text(file.read_text().replace("height: 0.9", "height: 0.93"))
    assert contact_heights(Model(file)).min() == pytest.approx(0.03, abs=1e-12)


@pytest.mark.slow
def test_a_quadruped_stands(capsys: pytest.CaptureFixture[str]) -> None:
    assert "stands 30 s" in standing_report(Model("mini_cheetah"))
    assert main(["inspect", "mini_cheetah", "--no-errors", "--no-standing"]) == 0
    assert "Without a policy" not in capsys.readouterr().out
    assert main(["inspect", "mini_cheetah", "--no-errors"]) == 0
    assert "Without a policy: stands" in capsys.readouterr().out


def test_ankles_are_both_joints_of_an_ankle() -> None:
    assert joints_at_feet(Model("t1"))[:2] == ("left_ankle_roll", "left_ankle_pitch")
    assert len(joints_at_feet(Model("mini_cheetah"))) == 4  # its knees


def test_fallen_is_tilted_or_low(tmp_path: Path) -> None:
    model = Model(pole(tmp_path, 1.0))
    q = np.tile(model.standing_q, (3, 1))
    q[1, 3:7] = np.cos(0.3), 0.0, np.sin(0.3), 0.0  # 0.6 rad
    q[2, 2] = 0.5
    np.testing.assert_array_equal(has_fallen(model.robot, q), [False, True, True])
