"""The command `python -m ce_gym train`."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import Any

from ce_gym.console import EPISODES, NUM_ENVS, SEED, STEPS, above_zero, add_command, add_threads_argument
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.learn.runs.job import Job
from ce_gym.learn.runs.logs import LOGS, default_logs
from ce_gym.learn.training import ALGORITHMS, make_job, run_job
from ce_gym.model.mechanism import ELASTIC, LEVELS
from ce_gym.policies import add_env_arg, load_policy


def add_train_command(subparsers: Any) -> None:
    """Add `train` to the subcommands of an argument parser."""
    parser = add_command(
        subparsers,
        train,
        "train a policy",
        "Train a policy, evaluate it and print its path. Ctrl-C and SIGTERM save the policy and stop; --resume "
        "continues.\nSettings not named here are in the settings file; --set KEY=VALUE changes any of them.",
        "train ce_gym/MiniCheetahVelocity-v0",
        "train ce_gym/TelloVelocity-v0 --transmission armature --seeds 0 1 2 --set steps=20e6 hidden=[128,128]",
        "train --resume runs/mini_cheetah_velocity --steps 20e6",
    )
    what = parser.add_argument_group("what to train")
    what.add_argument("env", nargs="?", default="", metavar="ENV", help="id, such as ce_gym/MiniCheetahVelocity-v0")
    what.add_argument(
        "--algo",
        choices=ALGORITHMS,
        default="",
        help="ppo (default); shac: gradients through physics; distill: imitation of a teacher; sb3: PPO of "
        "Stable-Baselines3",
    )
    add_environment_arguments(what)
    what.add_argument(
        "--resume",
        type=Path,
        metavar="POLICY",
        help="policy from which to continue, with its settings unless --config is given; --steps includes its steps; "
        "no code in the file is run",
    )
    what.add_argument("--seed", type=SEED, default=0, metavar="N", help="random seed (default 0)")
    what.add_argument("--seeds", type=SEED, nargs="+", metavar="N", help="several seeds, one run after the other")
    how = parser.add_argument_group("how")
    how.add_argument("--config", type=Path, metavar="FILE", help="settings file (default: that of the environment)")
    how.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help="settings, such as gamma=0.98"
    )
    how.add_argument("--steps", type=STEPS, metavar="N", help="environment steps in all, such as 6e6")
    how.add_argument("--num-envs", type=NUM_ENVS, metavar="N", help="environments stepped in parallel")
    how.add_argument(
        "--minutes", type=above_zero, default=float("inf"), metavar="M", help="longest training time [min]"
    )
    add_threads_argument(how)
    where = parser.add_argument_group("output")
    where.add_argument("--out", type=Path, metavar="FOLDER", help="default: runs/<name of the settings file>")
    where.add_argument(
        "--log",
        nargs="*",
        choices=LOGS,
        metavar="PACKAGE",
        help=f"also write curves for {', '.join(LOGS)} (default: tensorboard if it is installed)",
    )
    where.add_argument("--page", action="store_true", help="show curves and the current policy in a browser")
    where.add_argument(
        "--episodes", type=EPISODES, default=256, metavar="N", help="episodes of the evaluation (default 256)"
    )


def add_environment_arguments(parser: Any) -> None:
    """Add `--transmission`, `--critic` and `--env-arg`, see `env_kwargs_of`."""
    levels = (*LEVELS, ELASTIC)
    parser.add_argument("--transmission", choices=levels, metavar="LEVEL", help=f"one of {', '.join(levels)}")
    parser.add_argument(
        "--critic", nargs="+", metavar="BLOCK", help="observation blocks that only the critic sees, such as base_height"
    )
    add_env_arg(parser)


def env_kwargs_of(args: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of the environment in a command line."""
    kwargs = {"transmission": args.transmission} if args.transmission else {}
    kwargs |= {"obs_mode": "dict", "critic": args.critic} if args.critic else {}
    return kwargs | dict(args.env_args)


@in_one_line
def train(args: argparse.Namespace) -> int:
    """Train every seed, evaluate each policy, print its path, and return the exit code."""
    from ce_gym.learn.evaluate.evaluation import evaluate, report
    from ce_gym.learn.runs.page import TrainingPage

    jobs = make_jobs(args)
    with TrainingPage([job.out for job in jobs], jobs[0].env_id) if args.page else contextlib.nullcontext():
        for job in jobs:
            print(f"training {job.env_id}, seed {job.seed}, {job.settings.steps:,} steps -> {job.out}", flush=True)
            trained = run_job(job)
            print(f"saved {trained.policy} after {trained.record['steps']:,} steps", flush=True)
            if trained.interrupted:
                print(f"interrupted; continue with: python -m ce_gym train --resume {trained.policy} --out {job.out}")
                return 130
            result = evaluate(load_policy(trained.policy), job.env_id, episodes=args.episodes, **job.env_kwargs)
            print(report(result), flush=True)
    return 0


def make_jobs(args: argparse.Namespace) -> list[Job]:
    """Return the training runs of a command line, one per seed."""
    numbers = {"steps": args.steps, "num_envs": args.num_envs}
    options = {
        "settings": [*args.set, *(f"{name}={number}" for name, number in numbers.items() if number)],
        "config": args.config,
        "env_kwargs": env_kwargs_of(args),
        "resume": args.resume,
        "threads": args.threads,
        "seconds": 60.0 * args.minutes,
        "logs": default_logs() if args.log is None else args.log,
    }
    jobs = [make_job(args.env, args.algo, out=args.out, seed=seed, **options) for seed in args.seeds or [args.seed]]
    return [job.replace(out=job.out / f"seed_{job.seed}") for job in jobs] if len(jobs) > 1 else jobs
