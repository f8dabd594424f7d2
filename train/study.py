"""Train tasks on several arms with several seeds, and judge each policy in the same ways: one row for each run.

A study is a file in `studies/`, which says what is trained and how it is judged. Runs that have no row yet are made,
seed by seed, every task and arm of a seed before the next one, so that what is there is balanced; stopped by Ctrl-C or
when the time is over, the same command goes on. Uses public names of ce_gym only, and no name of a robot or
task.

    python train/study.py train/studies/policies.yaml docs/data/exactness/policies.csv --minutes 60
    python train/study.py train/studies/policies.yaml docs/data/exactness/policies.csv --tables
"""

from __future__ import annotations

import interruption  # noqa: F401
import single_blas  # noqa: F401

# isort: split

import argparse
import csv
import io
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from console import THREADS, Parser, above_zero, run
from effort import effort
from evaluate import evaluate
from job import Job
from run_folder import write_whole
from settings import config_file, load_env_args, load_settings
from transfer import checked_record

from ce_gym.policies import Policy, load_policy, parse_yaml

Row = dict[str, str]

RUN = ("task", "arm", "seed", "steps", "processor [s]")
"""Columns that say what a run was, time since it was last gone on with; those of figures follow, `where: figure`."""

DIGITS = 6


@dataclass(frozen=True)
class Trial:
    """A task of a study: the environment, how long to train, what decides, of which more is better, and is reported."""

    env: str
    steps: float
    decides: str
    metrics: list[str]
    motors: list[str]
    seconds: float

    @property
    def figures(self) -> list[str]:
        """Names of all that is reported, the one that decides first."""
        return list(dict.fromkeys([self.decides, *self.metrics, "falls", "reward", *self.motors]))


@dataclass(frozen=True)
class Arm:
    """A way to train: arguments of the environment, those for training only, and its turn: 0 is made before 1."""

    env_args: dict[str, Any]
    training: dict[str, Any]
    turn: int


@dataclass(frozen=True)
class Judged:
    """A way to judge: arguments of the environment that replace those of training, episodes, robots for motors.

    What `decides` is what arms lose against the first one in the ways of judging that say so.
    """

    env_args: dict[str, Any]
    episodes: int
    robots: int
    decides: bool


@dataclass(frozen=True)
class Study:
    """What is trained, and how it is judged; see the files in `studies/`."""

    seeds: list[int]
    tasks: dict[str, Trial]
    arms: dict[str, Arm]
    judged: dict[str, Judged]

    @property
    def columns(self) -> list[str]:
        """Of the table of all runs."""
        figures = dict.fromkeys(name for task in self.tasks.values() for name in task.figures)
        return [*RUN, *(f"{where}: {name}" for where in self.judged for name in figures)]

    def runs(self) -> Iterator[tuple[str, str, int]]:
        """Task, arm and seed of all runs, in the order in which they are made."""
        keys = ((task, arm, seed) for seed in self.seeds for task in self.tasks for arm in self.arms)
        return iter(sorted(keys, key=lambda key: self.arms[key[1]].turn))


def read_study(file: Path) -> Study:
    """Read a study.

    Raises:
        ValueError: If a key is missing or unknown.
    """
    data = parse_yaml(file.read_text(encoding="utf-8"))
    parts = {"tasks": Trial, "arms": Arm, "judged": Judged}
    for name, kind in parts.items():
        data[name] = {key: _made(kind, value, f"{file}: {name}: {key}") for key, value in data[name].items()}
    return _made(Study, data, str(file))


def _made(kind: Any, data: Mapping[str, Any], source: str) -> Any:
    expected = {field.name for field in fields(kind)}
    if wrong := expected.symmetric_difference(data):
        raise ValueError(f"{source}: {min(wrong)}: expected {', '.join(sorted(expected))} and nothing else")
    return kind(**data)


def read_rows(file: Path, study: Study) -> list[Row]:
    """Return the rows of runs that are done; none if there is no such file.

    Raises:
        ValueError: If they are of another study.
    """
    if not file.exists():
        return []
    with file.open(newline="", encoding="utf-8") as lines:
        reader = csv.DictReader(lines)
        rows = list(reader)
    if reader.fieldnames != study.columns:
        raise ValueError(f"{file}: has other columns than the study; expected {', '.join(study.columns)[:200]} ...")
    return rows


def write_rows(file: Path, study: Study, rows: list[Row]) -> None:
    """Write all rows, or none.

    Raises:
        OSError: If they cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, study.columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole({file: text.getvalue().encode()})


def train_one(study: Study, key: tuple[str, str, int], runs: Path, threads: int, seconds: float) -> Policy | None:
    """Train what one run lacks, and return its policy; None if that was interrupted.

    Raises:
        ValueError: If the folder has a policy that was trained in another way, or settings are wrong.
    """
    from fast_ppo import train

    (name, arm_name, seed), out = key, runs.joinpath(*map(str, key))
    task, arm = study.tasks[name], study.arms[arm_name]
    path = config_file(task.env)
    settings = load_settings(path, [f"steps={task.steps}"])
    settings = replace(settings, training={**settings.training, **arm.training})
    kwargs, policy, resume = {**load_env_args(path), **arm.env_args}, out / "policy.npz", None
    if policy.exists():
        if checked_record(policy, task.env, kwargs, seed, settings)["steps"] >= settings.steps:
            return load_policy(policy)
        resume = policy
    done = train(Job(task.env, settings, out, kwargs, seed, threads, resume=resume, seconds=seconds, tensorboard=False))
    return load_policy(policy) if done.record["steps"] >= settings.steps else None


def judge_one(study: Study, task: Trial, policy: Policy) -> dict[str, float | None]:
    """Return all figures of a policy, by column; None for one that does not exist, as the cost of no way."""
    found: dict[str, float | None] = {}
    for where, way in study.judged.items():
        kwargs = {**policy.record["env_kwargs"], **way.env_args, "num_threads": 1}
        result = evaluate(policy, task.env, episodes=way.episodes, metrics=task.metrics, **kwargs)
        seed = result["seed"]
        motors = effort(policy, episodes=way.robots, seconds=task.seconds, seed=seed, **kwargs)
        figures = {name: result.get(f"metrics/{name}", result.get(name, motors.get(name))) for name in task.figures}
        found |= {f"{where}: {name}": x for name, x in figures.items()}
    return found


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(description="Train the runs of a study that are missing, judge each, and add its row to a table.")
    parser.add_argument("study", type=Path, metavar="STUDY", help="file that says what is trained")
    parser.add_argument(
        "table", type=Path, metavar="CSV", help="rows of runs that are done; written whole or not at all"
    )
    parser.add_argument("--tables", action="store_true", help="train nothing; show what the rows say")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="with --tables: draw it, too")
    text = "stop after so long; the run at hand is gone on with next time"
    parser.add_argument("--minutes", type=above_zero, default=float("inf"), metavar="M", help=text)
    parser.add_argument("--threads", type=THREADS, default=1, metavar="N", help="default 1")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="where runs are kept (default: runs/<study>)")
    args = parser.parse_args(argv)
    return run("study.py", lambda: _work(args))


def _work(args: argparse.Namespace) -> int:
    """Show what is there, or go on with it; return the exit code."""
    study = read_study(args.study)
    rows = read_rows(args.table, study)
    if args.tables:
        from study_tables import show

        print(show(study, rows, args.picture))
        return 0
    end, runs = time.monotonic() + 60 * args.minutes, args.runs or Path("runs") / args.study.stem
    done = {(row["task"], row["arm"], int(row["seed"])) for row in rows}
    for key in (key for key in study.runs() if key not in done):
        left = end - time.monotonic()
        policy = train_one(study, key, runs, args.threads, left) if left > 0 else None
        if policy is None:
            print(f"study.py: stopped with {len(rows)} runs done; the same command goes on", file=sys.stderr)
            return 130
        found = judge_one(study, study.tasks[key[0]], policy)
        said = {name: f"{x:.{DIGITS}g}" for name, x in found.items() if x is not None}
        about = (*key, policy.record["steps"], policy.record["processor_seconds"])
        rows.append(dict(zip(RUN, map(str, about), strict=True)) | said)
        write_rows(args.table, study, rows)
        print(f"{', '.join(map(str, key))}: {said}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
