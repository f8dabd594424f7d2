"""Train on one transmission level, judge on all: what is lost where the gears differ from those of training?

Judges policies that are given, or trains what is missing, every level with several seeds, and judges that. Policies of
one level are samples of one way to train: means over them come with their 95 % confidence intervals. Uses public names
of ce_gym only, and no name of a robot or task.

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
from typing import TYPE_CHECKING, Any

import numpy as np
from console import SEED, THREADS, Parser, Table, markdown, print_result, run
from evaluate import add_arguments, env_kwargs, evaluate, load
from settings import Settings, config_file, load_env_args, load_settings

from ce_gym import LEVELS, usable_cores
from ce_gym.policies import WHERE, Policy, PolicyError, add_env_arguments, load_policy, locate_policy

if TYPE_CHECKING:
    from stable_baselines3 import PPO

"""Transmission levels, from what is kept in full to what is ignored."""

COLUMNS = (
    ("forward [m/s]", "forward_error", ".3f"),
    ("lateral [m/s]", "lateral_error", ".3f"),
    ("yaw [rad/s]", "yaw_rate_error", ".3f"),
    ("velocity [m/s]", "velocity_error", ".3f"),
    ("falls", "falls", ".1%"),
    ("length [s]", "episode_length", ".1f"),
    ("reward", "reward", ".2f"),
)
"""What tables show: title, name in the results, format."""

STUDENT = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120,
    2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
"""97.5 % quantiles of Student's t distribution for 1, 2, ... 30 degrees of freedom; the last serves for more."""

Results = dict[str, dict[str, float]]
"""Figures of one policy by the level it was judged on."""


def transfer(model: PPO | Policy, record: dict[str, Any], *, episodes: int = 256, seed: int | None = None) -> Results:
    """Evaluate a policy on every level, with the same seeds (see `evaluate`), and return the result by level."""
    return {
        level: evaluate(model, record["env"], episodes=episodes, seed=seed, **env_kwargs(record, level))
        for level in LEVELS
    }


def interval(values: Iterable[float]) -> dict[str, float | int | None]:
    """Return the mean of samples, half the width of its 95 % confidence interval (Student's t), and their number.

    A single sample has no interval: None.
    """
    x = np.array(list(values), float)
    if len(x) < 2:
        return {"mean": float(x.mean()), "ci95": None, "n": len(x)}
    t = STUDENT[min(len(x) - 1, len(STUDENT)) - 1]
    return {"mean": float(x.mean()), "ci95": float(t * x.std(ddof=1) / np.sqrt(len(x))), "n": len(x)}


def summary(judged: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """Put policies that were trained on one level together.

    Args:
        judged: One entry per policy, with `transmission` and `results`.

    Returns:
        `interval` of every figure, by the level of training, the level of judgement and the name of the figure.
    """
    found: dict[str, Any] = {}
    for trained in LEVELS:
        group = [entry["results"] for entry in judged if entry["transmission"] == trained]
        if group:
            found[trained] = {
                level: {key: interval(results[level][key] for results in group) for _, key, _ in COLUMNS}
                for level in LEVELS
            }
    return found


def table(found: dict[str, Any]) -> str:
    """One line per pair of levels, as Markdown; a star marks the level of training."""
    several = max(cell["falls"]["n"] for row in found.values() for cell in row.values()) > 1
    rows: Table = [["trained on", "judged on", *(title for title, _, _ in COLUMNS)]]
    for trained, row in found.items():
        for level, cell in row.items():
            name = level + (" *" if level == trained else "")
            rows.append([trained, name, *(shown(cell[key], form) for _, key, form in COLUMNS)])
    counts = ", ".join(f"{trained} {next(iter(row.values()))['falls']['n']}" for trained, row in found.items())
    note = "`*`: trained on this level; errors are mean absolute, over every step"
    if several:
        note += f"; mean over seeds with its 95 % confidence interval (seeds: {counts})"
    return f"{markdown(rows)}\n\n{note}"


def shown(figure: dict[str, Any], form: str) -> str:
    """A mean with its interval, if it has one."""
    return f"{figure['mean']:{form}}" + ("" if figure["ci95"] is None else f" ± {figure['ci95']:{form}}")


def train_missing(args: argparse.Namespace) -> list[Path]:
    """Train every level and seed that the folder does not have yet, and return all policies.

    Raises:
        ValueError: If the folder has a policy that was trained in another way, or settings are wrong.
        KeyboardInterrupt: After Ctrl-C; what is trained so far is kept and gone on from next time.
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
    """Return the record of a policy trained earlier, if it is the one asked for.

    Raises:
        PolicyError: If it was trained in another way.
    """
    record = load_policy(policy).record
    asked = {"env": env, "transmission": kwargs["transmission"], "seed": seed, "env_kwargs": kwargs}
    asked["settings"] = json.loads(json.dumps(settings.as_dict()))
    for key, value in asked.items():
        if record[key] != value:
            if isinstance(value, dict):
                found = record[key]
                name = next(name for name in {**value, **found} if found.get(name, value) != value.get(name, found))
                raise PolicyError(
                    f"{policy}: trained with {name} = {found.get(name)}, asked for {value.get(name)}; "
                    "expected the same: give another --runs folder"
                )
            raise PolicyError(
                f"{policy}: trained with {key} = {record[key]!r}, asked for {value!r}; give another --runs folder"
            )
    return record


def judge(
    policies: Iterable[Path],
    episodes: int,
    seed: int | None,
    env: str | None = None,
    env_args: Iterable[tuple[str, Any]] = (),
) -> dict[str, Any]:
    """Judge policies of one task on every level, in the environment `env` or that of their records; see `load`.

    Returns:
        env; episodes; policies: file, transmission, seed, steps and results of each; summary, see `summary`.

    Raises:
        PolicyError: If they are for different environments.
    """
    judged, names = [], {}
    for path in policies:
        model = load(path, env, env_args=env_args)
        record = model.record
        names[_task(record)] = path
        if len(names) > 1:
            raise PolicyError(f"{path}: is for {record['env']}; expected the robot and task of the others")
        print(f"judging {path}", file=sys.stderr)
        entry = {"policy": str(path), "env": record["env"], "transmission": record["transmission"]}
        entry |= {key: record.get(key) for key in ("seed", "steps")}
        judged.append(entry | {"results": transfer(model, record, episodes=episodes, seed=seed)})
    return {"env": judged[0]["env"], "episodes": episodes, "policies": judged, "summary": summary(judged)}


def _task(record: dict[str, Any]) -> tuple[Any, ...]:
    """What policies that are compared have in common; ids of one task may name different levels."""
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
    """The command line of this file."""
    result = Parser(
        description="Judge policies on every transmission level; with --train, train on every level first.",
        epilog="Policies that lie in the folder already are used again, so that a second call only judges.",
    )
    result.add_argument("policies", nargs="*", metavar="POLICY", help=f"{WHERE}; several seeds are put together")
    add_env_arguments(result)
    add_arguments(result, episodes=256)
    result.add_argument("--out", type=Path, metavar="FOLDER", help="write transfer.json, .md and .png there")
    how = result.add_argument_group("training")
    how.add_argument("--train", action="store_true", help="train what is missing of --levels and --seeds, then judge")
    how.add_argument("--levels", nargs="+", choices=LEVELS, default=LEVELS, metavar="LEVEL", help="default: all four")
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
        arguments.error("expected either policies to judge, or --train and --env")
    if args.train and not args.env:
        arguments.error("--env: missing; expected the environment to train in")
    return run("transfer.py", lambda: _work(args))


def _work(args: argparse.Namespace) -> int:
    """Train if asked to, judge, and write."""
    args.threads = args.threads or usable_cores()
    try:
        policies = train_missing(args) if args.train else [locate_policy(path) for path in args.policies]
    except KeyboardInterrupt:
        print("transfer.py: interrupted; the same command goes on", file=sys.stderr)
        return 130
    result = judge(policies, args.episodes, args.seed, args.env, args.env_args)
    out = args.out or (policies[0].parents[2] if args.train else None)
    files = write_report(result, out) if out else []
    print_result(result, "\n".join([table(result["summary"]), *map(str, files)]), args.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
