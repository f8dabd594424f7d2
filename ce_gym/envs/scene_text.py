"""A scene report in words: `scene_report(env_id)`. Knows reports and times, not how they are worked out."""

from __future__ import annotations

from collections.abc import Iterable

from ce_gym.envs.scene_report import Item, SceneReport, report_scene
from ce_gym.envs.scene_timing import BATCH, ROUNDS, SceneTimes, time_scene
from ce_gym.model.table import Cell, table_text


def scene_report(env_id: str, timing: bool = True) -> str:
    """Return what is compiled into an environment, what has been left out and what both cost, as plain text.

    Args:
        env_id: Id of a registered environment.
        timing: Whether to compile and time every line, which takes some minutes the first time; without, the report
            has instructions only.

    Raises:
        ValueError: If the id is not one of this package's.
    """
    report = report_scene(env_id)
    return as_text(report, time_scene(report) if timing else None)


def as_text(report: SceneReport, times: SceneTimes | None = None) -> str:
    """Return a report as plain text."""
    task, model = report.program.task, report.program.model
    n, ms = task.n_substeps, f"{1e3 * task.dt:g} ms"
    sub_steps = Item("", f"{n} sub-steps", n * report.sub_step, report.layers[-1].compiled)
    whole = Item("", "environment step", report.env_step, report.layers[-1].compiled)
    totals = {sub_steps: n * times.sub_step, whole: times.env_step} if times else {}
    terms: list[Item] = []
    for group in report.groups[1:]:
        terms += [group, *(item for item in report.once if item.group == group.name != item.name)]
    columns = ("", "instructions", *(("ns",) if times else ()))

    def table(items: Iterable[Item]) -> str:
        rows: list[tuple[Cell, ...]] = []
        for item in items:
            indent = "  " if item in terms and item.group != item.name else ""
            row: tuple[Cell, ...] = (indent + item.name, item.instructions)
            if times:
                row += (_ns(totals.get(item, times.added.get((item.group, item.name)))),)
            rows.append(row)
        return table_text(columns, rows)

    total = Item("", "sub-step", report.sub_step, report.layers[-1].compiled)
    if times:
        totals[total] = times.sub_step
    remarks = ["Instructions are scalar operations of the traced functions, for one robot."]
    if times:
        remarks += [
            f"ns: one robot, one core, double precision; {BATCH} robots, kernels in turn, medians of {ROUNDS} rounds.",
            "A line is a difference of two kernels, good to a few per cent of the whole. Sub-steps are those of robots",
            "settling onto their feet, second attempts included. The environment step is timed by itself, under random",
            "actions; it contains random numbers and the Python call besides its lines.",
        ]
    remarks.append("A line costs what it adds to those above it: what it shares with them is counted there.")
    return "\n".join(
        [
            f"{report.name}: {model.robot.name}, transmission {model.transmission}, {n} sub-steps of {ms} in a step",
            *remarks,
            "",
            "Compiled in: a sub-step",
            table([*report.layers, total]),
            "",
            "Compiled in: an environment step",
            table([report.groups[0], sub_steps, *terms, whole]),
            "",
            "Done for a tile of robots only if one of them needs it",
            table(report.sometimes),
            "",
            "Left out: what each would add to a sub-step",
            table(report.left_out),
            "",
            "Left out: what each would add to an environment step",
            table_text(("", "", "instructions"), [(i.group, i.name, i.instructions) for i in report.terms_left_out]),
        ]
    )


def _ns(value: float | None) -> Cell:
    return None if value is None else f"{value:.1f}"
