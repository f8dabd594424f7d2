"""Evaluate policies at every transmission level, after training at one level.

The policies are arguments, or are trained first: each level with several seeds. Means over the policies of one level
have 95 % confidence intervals. Uses public names of ce_gym only, and no name of a robot or task.

    python train/transfer.py runs/mini_cheetah_velocity
    python train/transfer.py --env ce_gym/MiniCheetahVelocity-v0 --train --seeds 0 1 2
"""

from __future__ import annotations

import interruption  # noqa: F401
import single_blas  # noqa: F401

# isort: split

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from console import SEED, THREADS, Parser, Table, markdown, print_result, run
from episodes import COLUMNS, Predicts
from evaluate import add_arguments, env_kwargs, evaluate, load
from settings import Settings, config_file, load_env_args, load_settings

from ce_gym import LEVELS, usable_cores
from ce_gym.policies import WHERE, PolicyError, add_env_arguments, load_policy, locate_policy

SHOWN = (*COLUMNS, ("reward", "reward", ".2f"))
"""Columns of the table: title, key in the results, format."""

STUDENT = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120,
    2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
"""97.5 % quantiles of Student's t distribution for 1, 2, ... 30 degrees of freedom; the last is used for more."""

Results = dict[str, dict[str, float]]
"""Results of `evaluate` for one policy, by level."""


def transfer(model: Predicts, record: dict[str, Any], *, episodes: int = 256, seed: int | None = None) -> Results:
    """Evaluate a policy at every level with the same seeds (see `evaluate`), and return the results by level."""
    return {
        level: evaluate(model, record["env"], episodes=episodes, seed=seed, **env_kwargs(record, level))
        for level in LEVELS
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
    for trained in LEVELS:
        group = [entry["results"] for entry in evaluations if entry["transmission"] == trained]
        if group:
            summaries[trained] = {
                level: {key: interval(results[level][key] for results in group) for _, key, _ in SHOWN}
                for level in LEVELS
            }
    return summaries


def table(summaries: dict[str, Any]) -> str:
    """Return a Markdown table with one line per pair of levels; a star marks the training level."""
    several = max(cell["falls"]["n"] for row in summaries.values() for cell in row.values()) > 1
    rows: Table = [["trained at", "evaluated at", *(title for title, _, _ in SHOWN)]]
    for trained, row in summaries.items():
        for level, cell in row.items():
            name = level + (" *" if level == trained else "")
            rows.append([trained, name, *(shown(cell[key], form) for _, key, form in SHOWN)])
    counts = ", ".join(f"{trained} {next(iter(row.values()))['falls']['n']}" for trained, row in summaries.items())
    note = "`*`: trained at this level; errors are mean absolute, over every step"
    if several:
        note += f"; mean over seeds with its 95 % confidence interval (seeds: {counts})"
    return f"{markdown(rows)}\n\n{note}"


def shown(figure: dict[str, Any], form: str) -> str:
    """Return a mean as text, with its interval if there is one."""
    return f"{figure['mean']:{form}}" + ("" if figure["ci95"] is None else f" ± {figure['ci95']:{form}}")


def train_missing(args: argparse.Namespace) -> list[Path]:
    """Train all levels and seeds that the folder lacks, and return all policies.

    Raises:
        ValueError: If the folder has a policy with other settings, or settings are wrong.
        KeyboardInterrupt: After Ctrl-C. Finished and interrupted runs are kept, and the next call continues.
    """
    from job import Job
    from ppo import train

    path = config_file(args.env)
    settings = load_settings(path, [f"steps={args.steps}"] if args.steps else [])
    folder = args.runs or Path("runs") / "transfer" / path.stem
    env_args, policies = {**load_env_args(path), **dict(args.env_args)}, []
    for level in args.levels:
        for seed in args.seeds:
            out, kwargs = folder / level / f"seed_{seed}", {**env_args, "transmission": level}
            policy, resume = out / "policy.zip", None
            if policy.exists():
                record = checked_record(policy, args.env, kwargs, seed, settings)
                resume = None if record["finished"] else policy
            if not policy.exists() or resume:
                print(f"training on {level}, seed {seed}, {settings.steps:,} steps -> {out}", file=sys.stderr)
                done = train(Job(args.env, settings, out, kwargs, seed, args.threads, resume=resume, tensorboard=False))
                if done.interrupted:
                    raise KeyboardInterrupt
            policies.append(policy)
    return policies


def checked_record(policy: Path, env: str, kwargs: dict[str, Any], seed: int, settings: Settings) -> dict[str, Any]:
    """Return the record of an existing policy after checking how the policy was trained.

    Raises:
        PolicyError: If it was trained with another environment, seed or settings.
    """
    record = load_policy(policy).record
    requested = {"env": env, "transmission": kwargs["transmission"], "seed": seed, "env_kwargs": kwargs}
    requested["settings"] = json.loads(json.dumps(settings.as_dict()))
    for key, value in requested.items():
        if record[key] != value:
            if isinstance(value, dict):
                trained = record[key]
                name = next(n for n in {**value, **trained} if trained.get(n, value) != value.get(n, trained))
                raise PolicyError(
                    f"{policy}: trained with {name} = {trained.get(name)}, requested {value.get(name)}; "
                    "expected the same: give another --runs folder"
                )
            raise PolicyError(
                f"{policy}: trained with {key} = {record[key]!r}, requested {value!r}; give another --runs folder"
            )
    return record


def evaluate_policies(
    policies: Iterable[Path],
    episodes: int,
    seed: int | None,
    env: str | None = None,
    env_args: Iterable[tuple[str, Any]] = (),
) -> dict[str, Any]:
    """Evaluate policies of one task at every level; see `evaluate.load` for the arguments.

    Returns:
        env; episodes; policies: file, transmission, seed, steps and results of each; summary, see `summary`.

    Raises:
        PolicyError: If the policies are for different robots or tasks.
    """
    evaluations, tasks = [], set()
    for path in policies:
        model = load(path, env, env_args=env_args)
        record = model.record
        tasks.add(_task(record))
        if len(tasks) > 1:
            raise PolicyError(f"{path}: is for {record['env']}; expected the robot and task of the others")
        print(f"evaluating {path}", file=sys.stderr)
        entry = {"policy": str(path), "env": record["env"], "transmission": record["transmission"]}
        entry |= {key: record.get(key) for key in ("seed", "steps")}
        evaluations.append(entry | {"results": transfer(model, record, episodes=episodes, seed=seed)})
    return {
        "env": evaluations[0]["env"], "episodes": episodes, "policies": evaluations, "summary": summary(evaluations),
    }  # fmt: skip


def _task(record: dict[str, Any]) -> tuple[Any, ...]:
    """Return robot and task of a policy. Ids are not compared, because ids of one task may name different levels."""
    return tuple(record["policy_spec"].get(key, record["env"]) for key in ("robot", "task"))


def write_report(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write `transfer.json`, `transfer.md` and the picture `transfer.png` into a folder."""
    from pictures import draw_transfer

    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"transfer.{kind}" for kind in ("json", "md", "png")]
    files[0].write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    heading = f"# Transfer between transmission levels: {result['env']}\n\n![Errors and falls](transfer.png)\n\n"
    note = f"\n\n{result['episodes']} episodes for each policy and level.\n"
    files[1].write_text(heading + table(result["summary"]) + note, encoding="utf-8")
    draw_transfer(result, files[2])
    return files


def parser() -> argparse.ArgumentParser:
    """Return the command line of this file."""
    result = Parser(
        description="Evaluate policies at every transmission level; with --train, train at every level first.",
        epilog="Policies that exist in the folder are not trained again, so that a second call only evaluates.",
    )
    result.add_argument(
        "policies", nargs="*", metavar="POLICY", help=f"{WHERE}; policies of several seeds are combined"
    )
    add_env_arguments(result)
    add_arguments(result, episodes=256)
    result.add_argument("--out", type=Path, metavar="FOLDER", help="write transfer.json, .md and .png there")
    how = result.add_argument_group("training")
    how.add_argument(
        "--train", action="store_true", help="train missing policies of --levels and --seeds, then evaluate"
    )
    how.add_argument("--levels", nargs="+", choices=LEVELS, default=LEVELS, metavar="LEVEL", help="default: all")
    how.add_argument("--seeds", type=SEED, nargs="+", default=[0, 1, 2], metavar="N", help="default: 0 1 2")
    how.add_argument("--steps", metavar="N", help="environment steps of each (default: as in the settings file)")
    how.add_argument("--threads", type=THREADS, default=0, metavar="N", help="default: all CPUs")
    how.add_argument(
        "--runs", type=Path, metavar="FOLDER", help="where runs are kept (default: runs/transfer/<settings file>)"
    )
    return result


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    arguments = parser()
    args = arguments.parse_args(argv)
    if args.train == bool(args.policies):
        arguments.error("expected either policies to evaluate, or --train and --env")
    if args.train and not args.env:
        arguments.error("--env: missing; expected the environment to train in")
    return run("transfer.py", lambda: _work(args))


def _work(args: argparse.Namespace) -> int:
    """Train if `--train` is given, evaluate, and write the report."""
    args.threads = args.threads or usable_cores()
    try:
        policies = train_missing(args) if args.train else [locate_policy(path) for path in args.policies]
    except KeyboardInterrupt:
        print("transfer.py: interrupted; the same command continues", file=sys.stderr)
        return 130
    result = evaluate_policies(policies, args.episodes, args.seed, args.env, args.env_args)
    out = args.out or (policies[0].parents[2] if args.train else None)
    files = write_report(result, out) if out else []
    print_result(result, "\n".join([table(result["summary"]), *map(str, files)]), args.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
