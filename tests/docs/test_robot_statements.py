"""Statements of the pages about shipped robots agree with the robots' files.

Each row is a sentence with its figures worked out from the robot: it fails if page or file changes without the other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

import ce_gym
from ce_gym.diagnostics.levels import levels_report
from ce_gym.diagnostics.standing import joints_at_feet, pitch_stiffness, toppling
from ce_gym.dynamics import Model
from ce_gym.model import Robot
from ce_gym.model.mechanism import is_axisymmetric

ROOT = Path(ce_gym.__file__).parents[1]
WORDS = ("", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
WORDS += ("thirteen", "fourteen", "fifteen", "sixteen")
pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.InertiaWarning")


@cache
def model(name: str, level: str = "exact") -> Model:
    return Model(name, level)


def robot(name: str) -> Robot:
    return model(name).robot


def ratios(name: str) -> list[float]:
    """Return the gear ratios of a robot, ascending: rotors turn by them for a joint."""
    rotors = {body.name for body in robot(name).rotors()}
    ties = [tie for tie in robot(name).constraints if tie.linear and rotors & set(tie.bodies)]
    return sorted({abs(x) for tie in ties for body, x in dict(tie.coefficients).items() if body not in rotors})


def undriven(name: str) -> list[str]:
    """Return the joints that no rotor turns with."""
    tied = {body for tie in robot(name).constraints for body in tie.bodies}
    return [joint for joint in robot(name).commanded if joint not in tied]


def gains(name: str, *parts: str) -> set[float]:
    return {gain for joint, gain in robot(name).gains.kp if any(part in joint for part in parts)}


def the(values: set[float]) -> str:
    (value,) = values
    return f"{value:g}"


def instructions(name: str, level: str = "exact") -> int:
    return model(name, level).n_instructions("forward_dynamics")


def rods(name: str) -> int:
    return sum(type(tie).__name__ == "RodConstraint" for tie in robot(name).constraints)


def belts(name: str) -> bool:
    rotors = {body.name for body in robot(name).rotors()}
    return any(tie.linear and rotors & set(tie.bodies) and len(tie.bodies) > 2 for tie in robot(name).constraints)


def level_row(name: str) -> str:
    """Return the figures of `armature` as the report prints them, cells of a row of a page."""
    line = next(line for line in levels_report(model(name)).splitlines() if line.startswith("  armature"))
    return " | ".join(re.split(r"\s{2,}", line.strip())[1:])


def floating() -> list[str]:
    return [name for name in ce_gym.robots() if robot(name).floating]


def walking() -> set[str]:
    return {name.partition("_velocity")[0] for name in ce_gym.shipped_policies() if "_velocity" in name}


def holds(name: str) -> bool:
    """Whether the position gains of the ankles are larger than weight times height above them."""
    at_feet = joints_at_feet(model(name))
    return pitch_stiffness(model(name), at_feet) > toppling(model(name), at_feet)


def kept(name: str) -> tuple[str, ...]:
    return robot(name).kept_inertia


CHEETAH, HUMANOID, TELLO, ANYMAL, JVRC, G1 = "mini_cheetah", "mit_humanoid", "tello", "anymal_c", "jvrc1", "g1"
_STANDING = {"cassie": "Cassie", "dr_legs": "DR Legs", "h1": "H1", "berkeley_humanoid": "Berkeley Humanoid"}
_STANDING |= {"g1": "G1", "t1": "T1"}
STATEMENTS: list[tuple[str, Callable[[], str]]] = [
    (
        "exactness.md",
        lambda: f"| gears, ratio {ratios(CHEETAH)[0]:.0f} to {ratios(CHEETAH)[-1]:.0f} (Mini Cheetah) |",
    ),
    ("exactness.md", lambda: f"| Mini Cheetah (gears of {ratios(CHEETAH)[0]:g} and {ratios(CHEETAH)[-1]:g}) |"),
    (
        "exactness.md",
        lambda: f"| belts, ratio {ratios(HUMANOID)[0]:g} to {ratios(HUMANOID)[-1]:g} (MIT Humanoid) |",
    ),
    ("exactness.md", lambda: f"(gears of {ratios(HUMANOID)[0]:g} to {ratios(HUMANOID)[-1]:g}, belts) |"),
    ("exactness.md", lambda: f"| differentials, ratio {the(set(ratios(TELLO)))} (Tello) |"),
    ("exactness.md", lambda: f"| Tello (gears of {the(set(ratios(TELLO)))}, differentials) |"),
    ("exactness.md", lambda: f"| ANYmal C (gears of {the(set(ratios(ANYMAL)))}) | {level_row(ANYMAL)} |"),
    (
        "exactness.md",
        lambda: f"| JVRC-1 (gears of {the(set(ratios(JVRC)))}, light rotors) | {level_row(JVRC)} |",
    ),
    (
        "exactness.md",
        lambda: f"| Unitree G1 (ratios of {ratios(G1)[0]:.0f} to {ratios(G1)[-1]:.0f}, cranks and rods",
    ),
    ("explanation/transmission.md", lambda: "as on Mini Cheetah, `coupled` and" if not belts(CHEETAH) else "belts"),
    (
        "how-to/faq.md",
        lambda: "Belts and differentials (MIT Humanoid, Tello)" if belts(HUMANOID) and belts(TELLO) else "none",
    ),
    (
        "reference/robot_files.md",
        lambda: f"{' '.join(n for n in ce_gym.robots() if robot(n).elastic)} has such values".replace(
            "mini_cheetah", "Mini Cheetah"
        ),
    ),
    ("how-to/faq.md", lambda: f'`kept_inertia: ["{"".join(kept(CHEETAH))}"]`'),
    (
        "explanation/how_it_works.md",
        lambda: (
            f"{sum(not is_axisymmetric(rotor) for rotor in robot(JVRC).rotors())} of the "
            f"{sum(1 for _ in robot(JVRC).rotors())} rotors of JVRC-1 are of this kind"
        ),
    ),
    ("reference/environments.md", lambda: f"(the {_kinds(undriven(JVRC))} of JVRC-1)"),
    ("reference/robots.md", lambda: f"The {WORDS[len(floating())]} robots of the package that tasks can have"),
    ("reference/robots.md", lambda: f"a screw with a lead of {2000 * math.pi / ratios('spot')[-1]:.0f} mm"),
    (
        "reference/robots.md",
        lambda: (
            f"at the knee ({robot('cassie').body('left_shin').joint.stiffness:.0f} N m/rad) and the heel "
            f"({robot('cassie').body('left_heel_spring').joint.stiffness:.0f} N m/rad)"
        ),
    ),
    ("reference/robots.md", lambda: f"{WORDS[len(robot('dr_legs').motors) // 2]} motors for a leg"),
    (
        "reference/robots.md",
        lambda: (
            f"H1 has {the(gains('h1', 'hip_roll', 'hip_pitch', 'knee'))} N m/rad at hips and knees "
            f"({the(gains('h1', 'hip_yaw'))} at the hips' yaw) and {the(gains('h1', 'ankle'))} at the ankles"
        ),
    ),
    (
        "reference/robots.md",
        lambda: (
            "The Berkeley Humanoid has "
            f"{min(gains('berkeley_humanoid', 'hr', 'haa', 'hfe', 'kfe')):g} to "
            f"{max(gains('berkeley_humanoid', 'hr', 'haa', 'hfe', 'kfe')):g}, and "
            f"{the(gains('berkeley_humanoid', 'ffe'))} and {the(gains('berkeley_humanoid', 'faa'))} at the feet"
        ),
    ),
    ("reference/robots.md", lambda: f"{_titles(_STANDING, True)} | stands"),
    ("reference/robots.md", lambda: f"| {_titles(_STANDING, False)} | falls"),
]


def _kinds(joints: list[str]) -> str:
    """Return which parts of a body joints belong to: wrists, neck."""
    parts = dict.fromkeys(re.sub("^(left|right)-", "", joint).split("-")[0] for joint in joints)
    return " and ".join(f"the {part}" if part == "neck" else f"{part}s" for part in parts)


def _titles(robots: dict[str, str], stand: bool) -> str:
    return ", ".join(title for name, title in robots.items() if holds(name) == stand)


@pytest.mark.parametrize(("page", "statement"), STATEMENTS, ids=range(len(STATEMENTS)))
def test_a_statement_is_what_the_file_says(page: str, statement: Callable[[], str]):
    text = " ".join((ROOT / "docs" / page).read_text(encoding="utf-8").split())
    sentence = " ".join(statement().split())
    assert sentence in text, f"{page} does not say: {sentence}"


def test_most_of_what_the_knee_motor_accelerates_is_rotors():
    """Three quarters, says transmission.md."""
    legs = model(HUMANOID)
    share = legs.mass_matrix(legs.standing_q), model(HUMANOID, "none").mass_matrix(legs.standing_q)
    knee = legs.nv - len(legs.joint_links) + legs.joint_links.index("left_knee_link")
    assert 1 - share[1][knee, knee] / share[0][knee, knee] == pytest.approx(0.75, abs=0.03)
