"""Whether gains carry a robot: an inverted pendulum on an ankle stands above m g h and falls below it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym.__main__ import main
from ce_gym.diagnostics.standing import fallen_after, has_fallen, joints_at_feet, report_standing
from ce_gym.diagnostics.standing_text import as_text, standing_report
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
    np.testing.assert_array_equal(np.isinf(fallen_after(model, factors)), [False, False, True, True])


def test_what_would_carry_it(tmp_path: Path) -> None:
    """A bit less than half of what it takes: the first factor above 2 does, and it falls as a pendulum does."""
    report = report_standing(Model(pole(tmp_path, 0.45 * TOPPLING)))
    assert report.ankles == ("foot",)
    assert report.toppling == pytest.approx(TOPPLING, rel=1e-9)
    assert report.stiffness == pytest.approx(0.45 * TOPPLING, rel=1e-9)
    assert report.factor == report.ankle_factor == 2.8
    rate = np.sqrt(0.55 * TOPPLING / (MASS * HEIGHT**2 + 0.1))  # of growth, but for damping
    undamped = np.arccosh(0.5 / (0.02 / HEIGHT / rate)) / rate  # until it has tilted by 0.5 rad
    assert report.after is not None
    assert undamped < report.after < 2.5 * undamped
    words = as_text(report)
    assert "All position gains times 2.8 would carry it." in words
    assert "Those of foot" in words


def test_a_quadruped_stands(capsys: pytest.CaptureFixture[str]) -> None:
    assert "stands 30 s" in standing_report(Model("mini_cheetah"))
    assert main(["inspect", "mini_cheetah", "--no-errors", "--no-timing"]) == 0
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
