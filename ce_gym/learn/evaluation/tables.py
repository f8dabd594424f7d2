"""Results of evaluations as Markdown tables, for reports and cards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ce_gym.console import Table, markdown
from ce_gym.learn.evaluation.pushes import SAFE, WAIT
from ce_gym.learn.evaluation.suites import SUITES

COLUMNS = {
    "forward_error": ("forward [m/s]", ".3f"),
    "lateral_error": ("sideways [m/s]", ".3f"),
    "yaw_rate_error": ("yaw rate [rad/s]", ".3f"),
    "velocity_error": ("velocity [m/s]", ".3f"),
    "falls": ("falls", ".1%"),
    "episode_length": ("length [s]", ".1f"),
    "reward": ("reward", ".2f"),
    "episodes": ("episodes", ""),
    "crossed": ("crossed", ".1%"),
    "fell": ("fell", ".1%"),
    "verdict": ("verdict", ""),
}
"""Title and format of results, by key; other results are shown under their key with three decimals."""

DIRECTIONS = {
    0: "forward", 45: "forward left", 90: "left", 135: "back left", 180: "back", 225: "back right", 270: "right",
    315: "forward right",
}  # fmt: skip
"""Names of directions [deg]."""


def table(heading: str, results: Mapping[Any, Mapping[str, Any]], *keys: str) -> str:
    """Return results as a Markdown table.

    Args:
        heading: Title of the first column, which has the names of the results.
        results: Results by key, by name.
        keys: Keys of the results to show, one column each.
    """
    columns = [(key, *COLUMNS.get(key, (key, ".3f"))) for key in keys]
    rows: Table = [[heading, *(title for _, title, _ in columns)]]
    for name, result in results.items():
        rows.append([str(name), *(format(result[key], form) for key, _, form in columns)])
    return markdown(rows)


def two_columns(name: str, value: str, entries: Mapping[str, Any]) -> str:
    """Return entries by name as a Markdown table; `name` and `value` are its headings."""
    return markdown([[name, value], *([key, str(entry)] for key, entry in entries.items())])


def metrics(result: Mapping[str, Any]) -> dict[str, float]:
    """Return the metrics of the task, by name with spaces."""
    values = {key: x for key, x in result.items() if key.startswith("metrics/")}
    return {key.removeprefix("metrics/").replace("_", " "): x for key, x in values.items()}


def level_table(levels: list[dict[str, Any]]) -> str:
    """Return a Markdown table with one line per terrain level."""
    return table("level", {row["level"]: row for row in levels}, "forward_error", "velocity_error", "falls", "episodes")


def crossing_table(result: Mapping[str, Any]) -> str:
    """Return a Markdown table with one line per terrain level and one line for all levels."""
    rows = {**{row["level"]: row for row in result.get("levels", ())}, "all": result}
    walk = f"{result['distance']:g} m straight ahead at {result['speed']:g} m/s"
    return f"{table('level', rows, 'crossed', 'fell', 'episodes')}\n\nCrossed: walked {walk} without a fall."


def suite_table(suites: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a Markdown table with one line per suite."""
    rows = {f"{name}: {SUITES[name].about}": result for name, result in suites.items()}
    return table("suite", rows, "forward_error", "lateral_error", "yaw_rate_error", "falls")


def motor_table(effort: Mapping[str, Any]) -> str:
    """Return a Markdown table of powers and torques; lines of unknown results are left out."""
    rows = {"mean speed": f"{effort['speed']:.2f} m/s", "power": f"{effort['power']:.0f} W"}
    if effort["cost_of_transport"] is not None:
        rows["cost of transport"] = f"{effort['cost_of_transport']:.2f}"
        rows["the same, braking recovered"] = f"{effort['cost_of_transport_net']:.2f}"
    for name in ("torque", "power"):
        if effort[f"mean_{name}"] is not None:
            peak, motor = effort[f"peak_{name}"], effort[f"peak_{name}_at"]
            rows[f"mean {name} of a motor"] = f"{effort[f'mean_{name}']:.0%} of its limit"
            rows[f"peak {name}"] = f"{peak:.0%} of its limit (`{motor}`)"
    return f"{two_columns('', '', rows)}\n\nMechanical, at the rotors, measured at every sub-step."


def push_table(pushes: Mapping[str, Any]) -> str:
    """Return a Markdown table with one line per direction: the fraction that stays on its feet, by push."""
    rows: Table = [["pushed towards", *(f"{speed:g} m/s" for speed in pushes["speeds"]), "survives"]]
    for angle, shares, largest in zip(pushes["directions"], pushes["survived"], pushes["envelope"], strict=True):
        name = DIRECTIONS.get(round(angle), f"{angle:.0f} deg")
        limit = "nothing" if largest is None else f"{largest:g} m/s"
        rows.append([name, *(f"{share:.0%}" for share in shares), limit])
    walking = f"{pushes['command'][0]:g} m/s forward"
    note = f"Share on its feet {WAIT:g} s after a sudden change of velocity, at {walking}."
    best = f"`survives`: the largest push up to which at least {SAFE:.0%} stay on their feet."
    return f"{markdown(rows)}\n\n{note} {best}"


SECTIONS = (
    ("On every level of the ground", "levels", level_table),
    ("Across the ground", "crossing", crossing_table),
    ("With special commands", "suites", suite_table),
    ("Motors", "effort", motor_table),
    ("Pushes", "pushes", push_table),
)
"""Sections of reports and cards: title, key in the results, function that formats the result."""


def sections(result: Mapping[str, Any]) -> list[str]:
    """Return results as Markdown sections; results that were not measured have none."""
    return [f"## {title}\n\n{formatted(result[key])}" for title, key, formatted in SECTIONS if result.get(key)]
