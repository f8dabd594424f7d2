"""How long learning takes: one row of a CSV file for each robot, learner, number of threads and seed.

Trains, then judges the checkpoints by their mean action: a row has the time after which the first of them followed
forward commands to within each of `TARGETS`. Rows that the file has already are not made again, so that an interrupted
table is gone on with by the same command. Uses public names of ce_gym only, and no name of a robot or task.

    python train/table.py --env ce_gym/MiniCheetahVelocity-v0 --learners fast_ppo ppo --threads 1 2 --out table.csv
"""

from __future__ import annotations

import argparse
import csv
import importlib
import itertools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from console import EPISODES, SEED, THREADS, Parser, Table, markdown, run
from evaluate import evaluate
from job import Job
from settings import Settings, config_file, load_env_args, load_settings
from transfer import interval, shown

from ce_gym.policies import load_policy

LEARNERS = {
    **{name: name for name in ("fast_ppo", "ppo", "shac")},
    **{name: f"others.{name}" for name in ("plain_sb3", "plain_sbx", "plain_rsl_rl", "clean_ppo")},
}
"""Modules that have `train(job)`; their own `Settings` if they have others than PPO. What others need is in them."""

TARGETS = (0.1, 0.06)
"""Forward errors whose times are wanted [m/s]."""

KEY = ("env", "learner", "threads", "seed")
"""What tells a row from another."""

FIGURES = ("wall", "processor", "forward_error", "falls", "physics", "policy", "learning")
REACHED = tuple(f"{kind}_to_{target:g}" for target in TARGETS for kind in ("wall", "processor"))
COLUMNS = (*KEY, "steps", *FIGURES, *REACHED, "load")


def row_of(key: Mapping[str, Any], folder: Path, overrides: Sequence[str] = (), episodes: int = 256) -> dict[str, Any]:
    """Train, judge, and return a row.

    Args:
        key: Values of `KEY`.
        folder: Where the run goes.
        overrides: Of settings, `KEY=VALUE`.
        episodes: By which each checkpoint is judged.

    Returns:
        Times [s], of the wall and of all threads together; the policy's forward error [m/s] and falls; shares of the
        time; times until a checkpoint came within each of `TARGETS`, empty if none did; the machine's load at the end.
    """
    module = importlib.import_module(LEARNERS[key["learner"]])
    kind = getattr(module, "Settings", Settings)
    path = config_file(key["env"], kind.folder)
    settings, kwargs = load_settings(path, overrides, kind), load_env_args(path)
    trained = module.train(Job(key["env"], settings, folder, kwargs, key["seed"], key["threads"], tensorboard=False))
    if trained.interrupted:
        raise KeyboardInterrupt
    judged = [judge(policy, key["env"], episodes, kwargs) for policy in (*checkpoints(trained.policy), trained.policy)]
    last = judged[-1]
    found = {name: last[name] for name in (*FIGURES, "steps")} | {"load": load()}
    return {**key, **found, **times(judged)}


def load() -> float:
    """Return how many programs wanted a core, the mean of the last minute; NaN on Windows, which does not count."""
    average = getattr(os, "getloadavg", None)
    return round(average()[0], 1) if average else float("nan")


def checkpoints(policy: Path) -> list[Path]:
    """The checkpoints of the run that ended with a policy, the first one first."""
    records = (policy.parent / "checkpoints").glob("*.json")
    in_order = sorted(records, key=lambda path: int(path.stem.split("_")[-1]))
    return [path.with_suffix(policy.suffix) for path in in_order]


def judge(policy: Path, env: str, episodes: int, kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Figures of a policy, and what its record says of the time that it took."""
    loaded = load_policy(policy)
    found, record = evaluate(loaded, env, episodes=episodes, **kwargs), loaded.record
    measured = {"forward_error": round(found["forward_error"], 4), "falls": round(found["falls"], 4)}
    spent = {"wall": record["training_seconds"], "processor": record["processor_seconds"], "steps": record["steps"]}
    return measured | spent | record["shares"]


def times(judged: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """When each of `TARGETS` was reached, by the first policy that did; empty where none did."""
    result: dict[str, Any] = {}
    for target in TARGETS:
        first: Mapping[str, Any] = next((found for found in judged if found["forward_error"] <= target), {})
        result |= {f"{kind}_to_{target:g}": first.get(kind, "") for kind in ("wall", "processor")}
    return result


def read_rows(file: Path) -> list[dict[str, str]]:
    """Rows of a table as text; none if there is no such file.

    Raises:
        ValueError: If it is something else.
    """
    if not file.exists():
        return []
    with file.open(newline="", encoding="utf-8") as lines:
        reader = csv.DictReader(lines)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(f"{file}: expected the columns {', '.join(COLUMNS)}")
        return list(reader)


def add_row(file: Path, row: Mapping[str, Any]) -> None:
    """Write one more row."""
    new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as lines:
        writer = csv.DictWriter(lines, COLUMNS)
        if new:
            writer.writeheader()
        writer.writerow(row)


def summary(rows: Sequence[Mapping[str, str]]) -> str:
    """Means over seeds with their 95 % confidence intervals, as Markdown; only of what every seed reached."""
    forms = {"forward_error": ".3f", "falls": ".1%", "physics": ".0%", "policy": ".0%", "learning": ".0%"}
    names = (*REACHED, *FIGURES)
    table: Table = [["robot", "learner", "threads", "seeds", *names]]
    for key in dict.fromkeys(tuple(row[name] for name in KEY[:3]) for row in rows):
        group = [row for row in rows if tuple(row[name] for name in KEY[:3]) == key]
        cells = {name: [row[name] for row in group] for name in names}
        figures = [
            shown(interval(map(float, cell)), forms.get(name, ".1f")) if all(cell) else ""
            for name, cell in cells.items()
        ]
        table.append([*key, str(len(group)), *figures])
    return markdown(table)


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(description="Measure how long learning takes; rows go to a CSV file, as they come.")
    parser.add_argument("--env", nargs="+", required=True, metavar="ID", help="environment ids")
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=["fast_ppo"], help="default: fast_ppo")
    parser.add_argument("--threads", type=THREADS, nargs="+", default=[2], metavar="N", help="default: 2")
    parser.add_argument("--seeds", type=SEED, nargs="+", default=[0, 1, 2, 3, 4], metavar="N", help="default: 0 to 4")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings to change, in every run")
    parser.add_argument("--episodes", type=EPISODES, default=256, metavar="N", help="by which a checkpoint is judged")
    parser.add_argument("--runs", type=Path, default=Path("runs") / "table", metavar="FOLDER", help="of the runs")
    parser.add_argument("--out", type=Path, default=Path("table.csv"), metavar="FILE", help="default: table.csv")
    args = parser.parse_args(argv)
    return run("table.py", lambda: _work(args))


def _work(args: argparse.Namespace) -> int:
    """Make the rows that are missing, and print what all of them come to."""
    wanted: list[dict[str, Any]] = [
        dict(zip(KEY, values, strict=True))
        for values in itertools.product(args.env, args.learners, args.threads, args.seeds)
    ]
    have = [[row[name] for name in KEY] for row in read_rows(args.out)]
    for key in wanted:
        if [str(value) for value in key.values()] not in have:
            folder = args.runs.joinpath(*(str(value).split("/")[-1] for value in key.values()))
            add_row(args.out, row_of(key, folder, args.set, args.episodes))
    print(summary(read_rows(args.out)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
