"""What the rows of a study say: interquartile means of arms, how far they are from the first arm, and from themselves.

Intervals are 95 % bootstrap intervals, see `bootstrap`: of each arm over its seeds, of differences with both arms
resampled. What a policy loses from one way of judging to another is compared run by run.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from bootstrap import Array, difference, interquartile_mean, interval, of_one
from console import Table, markdown
from study_file import Row, Study

LEAST, GAP = 5, 0.05
"""Seeds of every arm below which there is no answer, and the share of the first arm's figure that is a gap."""

Interval = tuple[float, float, float]


def samples(rows: list[Row], task: str, arm: str, column: str) -> Array:
    """Return a figure of the runs of an arm, by seed; none that has none."""
    mine = sorted((row for row in rows if (row["task"], row["arm"]) == (task, arm)), key=lambda row: int(row["seed"]))
    return np.array([float(row[column]) for row in mine if row[column]])


def loss(exact: Array, other: Array) -> Interval:
    """Return what an arm loses against the first one, as a share of that one's interquartile mean; more is better."""
    scale = float(interquartile_mean(exact)) or np.nan
    found, low, high = interval(difference, [exact, other])
    return found / scale, low / scale, high / scale


def answer(losses: list[Interval], seeds: int) -> str:
    """Return whether there is a gap, by the losses in all ways of judging that decide: yes, no, not known."""
    if seeds < LEAST:
        return f"open: {seeds} of at least {LEAST} seeds"
    if all(low > GAP for _, low, _ in losses):
        return "yes"
    return "no" if all(high < GAP for _, _, high in losses) else "not known"


def shown(figure: Interval, form: str = ".3g") -> str:
    """A figure with its interval, if it has one."""
    found, low, high = figure
    return f"{found:{form}}" + ("" if np.isnan(low) else f" [{low:{form}}, {high:{form}}]")


def means(study: Study, rows: list[Row], task: str) -> Table:
    """One line for each arm and way of judging: interquartile means of all figures."""
    figures = study.tasks[task].figures
    table: Table = [["trained on", "judged on", "seeds", *(name.replace("_", " ") for name in figures)]]
    for arm in study.arms:
        for where in study.judged:
            found = [samples(rows, task, arm, f"{where}: {name}") for name in figures]
            if len(found[0]):
                cells = [shown(interval(of_one, [x])) if len(x) else "" for x in found]
                table.append([arm, where, str(len(found[0])), *cells])
    return table


def losses(study: Study, rows: list[Row]) -> Table:
    """One line for each task and arm: what it loses against the first arm, and what its own policies lose."""
    first, (judged, own, *others) = next(iter(study.arms)), study.judged
    across = [judged, *others]
    deciding = [i for i, where in enumerate(across) if study.judged[where].decides]
    titles = [f"lost against {first}, on {where}" for where in across]
    table: Table = [["task", "trained on", "figure", *titles, f"lost from {own} to {judged}", "a gap"]]
    for task, trial in study.tasks.items():
        name = trial.figures[0]
        for arm in study.arms:
            found = [[samples(rows, task, one, f"{where}: {name}") for where in across] for one in (first, arm)]
            if arm == first or not min(len(x) for x in (*found[0], *found[1])):
                continue
            lost = [loss(*pair) for pair in zip(*found, strict=True)]
            change = interval(of_one, [samples(rows, task, arm, f"{own}: {name}") - found[1][0]])
            seeds = min(len(found[0][0]), len(found[1][0]))
            said = [shown(one, ".2%") for one in lost]
            verdict = answer([lost[i] for i in deciding], seeds)
            table.append([task, arm, name.replace("_", " "), *said, shown(change), verdict])
    return table


def points(study: Study, rows: list[Row]) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return the figures that decide, by task and figure, arm and way of judging, for a picture."""
    return {
        f"{task}: {trial.figures[0].replace('_', ' ')}": {
            arm: {w: samples(rows, task, arm, f"{w}: {trial.figures[0]}").tolist() for w in study.judged}
            for arm in study.arms
            if len(samples(rows, task, arm, "steps"))
        }
        for task, trial in study.tasks.items()
    }


def show(study: Study, rows: list[Row], picture: Path | None = None) -> str:
    """Return all tables as Markdown, and draw the figures that decide."""
    if picture:
        from pictures import draw_study

        draw_study(points(study, rows), picture)
    every = sum(1 for _ in study.runs())
    parts = [f"{len(rows)} of {every} runs; interquartile means over seeds [95 % bootstrap interval]"]
    parts += [f"{task}:\n\n{markdown(means(study, rows, task))}" for task in study.tasks]
    return "\n\n".join([*parts, f"Losses:\n\n{markdown(losses(study, rows))}"])
