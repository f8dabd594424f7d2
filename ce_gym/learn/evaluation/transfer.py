"""Evaluate policies at every transmission level, after training at one level.

The policies are arguments, or are trained first: each level with several seeds. Means over the policies of one level
have 95 % confidence intervals.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.console import Table, markdown
from ce_gym.files import CARD, json_kind, write_file
from ce_gym.learn.evaluation.episodes import ERRORS, Predicts
from ce_gym.learn.evaluation.evaluation import evaluate, load
from ce_gym.learn.evaluation.pictures import draw_transfer
from ce_gym.learn.evaluation.tables import COLUMNS
from ce_gym.model.mechanism import ELASTIC, LEVELS
from ce_gym.policies import PolicyError

SHOWN = (*ERRORS, "falls", "episode_length", "reward")
"""Keys of the results in the table."""

STUDENT = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120,
    2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
"""97.5 % quantiles of Student's t distribution for 1, 2, ... 30 degrees of freedom; the last is used for more."""

Results = dict[str, dict[str, float]]
"""Results of `evaluate` for one policy, by level."""


def transfer(
    model: Predicts,
    record: dict[str, Any],
    *,
    episodes: int = 256,
    seed: int | None = None,
    levels: Iterable[str] = LEVELS,
) -> Results:
    """Evaluate a policy at its training level and other levels with the same seeds, and return the results by level."""
    env_id, kwargs = record["env"], record["env_kwargs"]
    return {
        level: evaluate(model, env_id, episodes=episodes, seed=seed, **{**kwargs, "transmission": level})
        for level in dict.fromkeys((*levels, record["transmission"]))
    }


def interval(values: Iterable[float]) -> dict[str, float | int | None]:
    """Return mean, half the width of its 95 % confidence interval (Student's t), and number of samples.

    A single sample has no interval; its half width is `None`.
    """
    x = np.array(list(values), float)
    if len(x) < 2:
        return {"mean": float(x.mean()), "ci95": None, "n": len(x)}
    t = STUDENT[min(len(x) - 1, len(STUDENT)) - 1]
    return {"mean": float(x.mean()), "ci95": float(t * x.std(ddof=1) / np.sqrt(len(x))), "n": len(x)}


def summary(evaluations: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """Combine policies that were trained at one level.

    Args:
        evaluations: One entry per policy, with `transmission` and `results`.

    Returns:
        `interval` of every result, by training level, evaluation level and key of the result.
    """
    summaries: dict[str, Any] = {}
    for trained in sorted({entry["transmission"] for entry in evaluations}, key=(*LEVELS, ELASTIC).index):
        group = [entry["results"] for entry in evaluations if entry["transmission"] == trained]
        summaries[trained] = {
            level: {key: interval(results[level][key] for results in group) for key in SHOWN} for level in group[0]
        }
    return summaries


def table(summaries: dict[str, Any]) -> str:
    """Return a Markdown table with one line per pair of levels; a star marks the training level."""
    seeds = {trained: next(iter(row.values()))["falls"]["n"] for trained, row in summaries.items()}
    rows: Table = [["trained at", "evaluated at", *(COLUMNS[key][0] for key in SHOWN)]]
    for trained, row in summaries.items():
        for level, cells in row.items():
            name = level + (" *" if level == trained else "")
            rows.append([trained, name, *(_cell(cells[key], COLUMNS[key][1]) for key in SHOWN)])
    note = "`*`: trained at this level; errors are mean absolute, over every step"
    if max(seeds.values()) > 1:
        counts = ", ".join(f"{trained} {count}" for trained, count in seeds.items())
        note += f"; mean over seeds with its 95 % confidence interval (seeds: {counts})"
    return f"{markdown(rows)}\n\n{note}"


def _cell(figure: dict[str, Any], form: str) -> str:
    return f"{figure['mean']:{form}}" + ("" if figure["ci95"] is None else f" ± {figure['ci95']:{form}}")


def evaluate_policies(
    policies: Iterable[Path],
    episodes: int,
    seed: int | None,
    env: str | None = None,
    env_args: Iterable[tuple[str, Any]] = (),
    threads: int | None = None,
) -> dict[str, Any]:
    """Evaluate policies of one task at every level; see `evaluate.load` for the arguments.

    Returns:
        env; episodes; policies: file, transmission, seed, steps and results of each; summary, see `summary`.

    Raises:
        PolicyError: If the policies are for different robots or tasks.
    """
    models = {str(path): load(path, env, env_args=env_args, threads=threads) for path in policies}
    levels = (*LEVELS, *(model.record["transmission"] for model in models.values()))
    evaluations, tasks = [], set()
    for path, model in models.items():
        record = model.record
        # Ids are not compared, because ids of one task may name different levels.
        tasks.add(tuple(record["policy_spec"].get(key, record["env"]) for key in ("robot", "task")))
        if len(tasks) > 1:
            raise PolicyError(f"{path}: is for {record['env']}; expected the robot and task of the others")
        print(f"evaluating {path}", file=sys.stderr)
        entry = {"policy": path, "env": record["env"], "transmission": record["transmission"]}
        entry |= {key: record.get(key) for key in ("seed", "steps")}
        results = transfer(model, record, episodes=episodes, seed=seed, levels=levels)
        evaluations.append(entry | {"results": results})
    task = {"env": evaluations[0]["env"], "episodes": episodes}
    return {**task, "policies": evaluations, "summary": summary(evaluations)}


def write_report(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write `transfer.json`, `transfer.md` and the picture `transfer.png` into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"transfer.{kind}" for kind in ("json", "md", "png")]
    text = json.dumps(result, indent=2) + "\n"
    write_file(files[0], text, json_kind(text))
    heading = f"# Transfer between transmission levels: {result['env']}\n\n![Errors and falls](transfer.png)\n\n"
    note = f"\n\n{result['episodes']} episodes for each policy and level.\n"
    write_file(files[1], heading + table(result["summary"]) + note, CARD)
    draw_transfer(result, files[2])
    return files
