"""A scene report in words: `scene_report(env_id)`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ce_gym.diagnostics.scene import Item, SceneReport, report_scene
from ce_gym.diagnostics.scene_timing import BATCH, ROUNDS, SceneTimes, time_scene
from ce_gym.model.table import Cell, table_text


def scene_report(env_id: str, timing: bool = True, **arguments: Any) -> str:
    """Return what is compiled into an environment, what has been left out and what both cost, as plain text.

    Args:
        env_id: Id of a registered environment.
        timing: Whether to compile and time every line, which takes some minutes the first time; without, the report
            has instructions only.
        **arguments: What `gymnasium.make` would be given besides, such as `motors="limited"`.

    Raises:
        ValueError: If the id is not one of this package's, or an argument is wrong.
    """
    report = report_scene(env_id, **arguments)
    return as_text(report, time_scene(report) if timing else None)


def as_text(report: SceneReport, times: SceneTimes | None = None) -> str:
    """Return a report as plain text."""
    task, model = report.program.task, report.program.model
    n, ms = task.n_substeps, f"{1e3 * task.dt:g} ms"
    figures = dict(times.added) if times else {}
    if times:
        figures |= {("", "sub-step"): times.sub_step, ("", f"{n} sub-steps"): n * times.sub_step}
        figures["", "environment step"] = times.env_step
    one = Item("", "sub-step", report.sub_step, None)
    all_ = Item("", f"{n} sub-steps", n * report.sub_step, None)
    whole = Item("", "environment step", report.env_step, None)
    first, *groups = report.groups
    terms = {group.name: [i for i in report.once if i.group == group.name != i.name] for group in groups}

    def table(items: Iterable[Item]) -> str:
        rows: list[tuple[Cell, ...]] = []
        for item in items:
            indent = "  " if item in terms.get(item.group, ()) else ""
            row: tuple[Cell, ...] = (indent + item.name, item.instructions)
            rows.append((*row, _ns(figures.get((item.group, item.name)))) if times else row)
        return table_text(("", "instructions", *(("ns",) if times else ())), rows)

    timed = (
        f"ns: one robot, one core, double precision; {BATCH} robots, kernels in turn, medians of {ROUNDS} rounds.",
        "A line is a difference of two kernels, and each can be slower by a fifth in one process than in the next:",
        "small times are noise. Sub-steps are those of robots settling onto their feet, with all iterations. The",
        "environment step is timed by itself, under random actions, with its random numbers and the Python call.",
    )
    return "\n".join(
        [
            f"{report.name}: {model.robot.name}, transmission {model.transmission}, {n} sub-steps of {ms} in a step",
            "Instructions are scalar operations of the traced functions, for one robot.",
            *(timed if times else ()),
            "A line costs what it adds to those above it: what it shares with them is counted there.",
            "",
            "Compiled in: a sub-step",
            table([*report.layers, one]),
            "",
            "Compiled in: an environment step",
            table([first, all_, *(item for group in groups for item in (group, *terms[group.name])), whole]),
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
