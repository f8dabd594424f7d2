"""The report on levels in words: `python -m ce_gym inspect ROBOT --levels`."""

from __future__ import annotations

from ce_gym.diagnostics.levels import LevelReport, Range, report_levels
from ce_gym.dynamics.model import Model
from ce_gym.model.table import table_text

LIMIT = 0.05
"""Error from which a level counts as not enough; docs/exactness.md."""
COLUMNS = ("level", "joint torque, worst", "joint frequency, worst", "base turn [deg/rad]", "mass at a foot, worst")


def levels_report(model: Model, poses: int = 200) -> str:
    """Return what each simplified level gets wrong of a robot, from its mass matrices in random poses, as plain text.

    Args:
        model: Any model of the robot; its level does not matter.
        poses: Number of random poses.
    """
    return as_text(report_levels(model, poses))


def as_text(report: LevelReport) -> str:
    """Return a report as plain text."""
    if not report.rows:
        return f"{report.robot} has no rotors: all transmission levels are the same."
    rows = [
        (row.level, _percents(row.torque), _percents(row.frequency), _degrees(row.turn), _percents(row.mass))
        for row in report.rows
    ]
    return "\n".join(
        [
            f"What simplified levels get wrong of {report.robot}, in {report.poses} poses: percentiles 5 to 95",
            table_text(COLUMNS, rows),
            f"  Reaction of rotors on what carries them: {_percents(report.carried)} of the inertias that it ties;",
            f"  reflected inertia between joints: {_percents(report.shared)}.",
            f"  Is armature enough (below {LIMIT:.0%} of a torque in any direction)? {verdict(report)}",
        ]
    )


def verdict(report: LevelReport) -> str:
    """Return whether armature is enough for the torques of this robot, by the rule of the studies."""
    if report.unknown:
        names = ", ".join(report.unknown[:3]) + (" and more" if len(report.unknown) > 3 else "")
        return f"Unknown: the robot's file does not say the gear ratio of {names}."
    torque = next(row.torque for row in report.rows if row.level == "armature")
    if torque.high < LIMIT:
        return "Yes."
    return "No." if torque.low > LIMIT else "In some poses."


def _percents(x: Range | None) -> str:
    return "" if x is None else f"{100 * x.low:.2g} to {100 * x.high:.2g} %"


def _degrees(x: Range | None) -> str:
    return "" if x is None else f"{57.29578 * x.low:.2g} to {57.29578 * x.high:.2g}"
