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
import sys
import time
from dataclasses import replace
from pathlib import Path

from console import THREADS, Parser, above_zero, run
from effort import effort
from evaluate import evaluate
from job import Job
from settings import config_file, load_env_args, load_settings
from study_file import RUN, Study, Trial, read_rows, read_study, write_rows
from study_tables import show
from transfer import checked_record

from ce_gym.policies import Policy, load_policy

DIGITS = 6


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
