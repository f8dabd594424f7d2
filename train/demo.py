"""The whole chain in one command: train a robot, judge it, and show it in a browser.

A policy that an earlier run finished is used again, one that was interrupted is trained on; `--fresh` starts anew.
Uses public names of ce_gym only.

    python train/demo.py
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from evaluate import load_learner, report
from ppo import Job, Trained, available_threads, train
from record import record
from settings import config_file, load_settings
from transfer import summary, table, transfer

from ce_gym.viewer import write_html

ENV = "ce_gym/MiniCheetahVelocity-v0"


def obtain_policy(args: argparse.Namespace) -> Path:
    """Train a policy, or take the one in the output folder, and say which."""
    policy = args.out / "policy.zip"
    resume = None
    if policy.exists() and not args.fresh:
        _, record = load_learner(policy)
        if record["finished"] and record["env"] == args.env:
            print(f"Using the policy trained earlier: {policy}, {record['steps']:,} steps. --fresh trains a new one.")
            return policy
        resume = policy if record["env"] == args.env else None
    overrides = [f"steps={args.steps}"] if args.steps else []
    settings = load_settings(config_file(args.env), overrides)
    job = Job(
        args.env, settings, args.out, env_kwargs={}, seed=args.seed, threads=args.threads, resume=resume,
        seconds=60.0 * args.minutes,
    )  # fmt: skip
    begin = f"Going on with {policy}" if resume else "Training from nothing"
    print(
        f"{begin}: {args.env}, {settings.steps:,} steps or {args.minutes:g} minutes. Ctrl-C stops and keeps the policy."
    )
    return _announce(train(job))


def _announce(trained: Trained) -> Path:
    """Say how training went."""
    seconds, steps = trained.record["training_seconds"], trained.record["steps"]
    how = "Interrupted" if trained.interrupted else "Trained"
    print(f"{how}: {steps:,} steps, {seconds:.0f} s. Policy: {trained.policy}")
    return trained.policy


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = argparse.ArgumentParser(description="Train a robot on exact transmissions, judge it, and show it.")
    parser.add_argument("--env", default=ENV, metavar="ID", help=f"environment id (default {ENV})")
    parser.add_argument("--fresh", action="store_true", help="train anew even if there is a policy from an earlier run")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default 0)")
    parser.add_argument("--steps", metavar="N", help="environment steps (default: as in the settings file)")
    parser.add_argument("--minutes", type=float, default=4.0, metavar="M", help="longest time to train (default 4)")
    parser.add_argument("--threads", type=int, default=available_threads(), metavar="N", help="default: all processors")
    parser.add_argument("--episodes", type=int, default=256, metavar="N", help="episodes to judge it by (default 256)")
    parser.add_argument("--out", type=Path, default=Path("demo"), metavar="FOLDER", help="default: demo")
    args = parser.parse_args(argv)
    try:
        show(obtain_policy(args), args.episodes, args.out)
    except ValueError as error:
        print(f"demo.py: {error}", file=sys.stderr)
        return 2
    return 0


def show(policy: Path, episodes: int, out: Path) -> None:
    """Print how good a policy is, on every transmission level, and write its rollout; the last line is the page."""
    model, about = load_learner(policy)
    results = transfer(model, about, episodes=episodes)
    entry = {"transmission": about["transmission"], "results": results}
    print(f"\nJudged on {about['transmission']} transmissions:\n{report(results[about['transmission']])}")
    print(f"\nThe same policy on every transmission level:\n{table(summary([entry]))}")
    rollout = record(model, about["env"], label=f"{about['transmission']}, seed {about['seed']}", **about["env_kwargs"])
    page = out / f"{rollout.robot}.html"
    rollout.save(page.with_suffix(".npz"))
    write_html([rollout], page)
    print(f"\nRecorded {rollout.duration:.1f} s. Open this page in a browser:\n{page.resolve()}")


if __name__ == "__main__":
    raise SystemExit(main())
