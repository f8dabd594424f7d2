"""The command `python -m ce_gym train`."""

from __future__ import annotations

import argparse
import contextlib
from typing import Any

from ce_gym.console import (
    EPISODES,
    NUM_ENVS,
    SEED,
    STEPS,
    above_zero,
    add_command,
    add_force_argument,
    add_threads_argument,
    path,
)
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.learn.runs.folder import check_unused
from ce_gym.learn.runs.job import Job
from ce_gym.learn.runs.logs import LOGS, default_logs
from ce_gym.learn.study import study_jobs, unfinished
from ce_gym.learn.training import ALGORITHMS, run_job
from ce_gym.model.mechanism import ELASTIC, LEVELS
from ce_gym.policies import add_env_arg, load_policy, registered


def add_train_command(subparsers: Any) -> None:
    """Add `train` to the subcommands of an argument parser."""
    parser = add_command(
        subparsers,
        train,
        "train a policy",
        "Train a policy, evaluate it and print its path. Ctrl-C, SIGTERM and SIGHUP save the policy and stop; "
        "--resume continues.\nSettings not named here are in the settings file; --set KEY=VALUE changes any of them.\n"
        "Several levels or seeds are trained one after the other, in subfolders LEVEL/seed_N. Finished policies are "
        "kept.",
        "train ce_gym/MiniCheetahVelocity-v0",
        "train ce_gym/TelloVelocity-v0 --transmission exact armature --seeds 0 1 2 --set hidden=[128,128]",
        "train --resume runs/mini_cheetah_velocity --steps 20e6",
    )
    what = parser.add_argument_group("what to train")
    what.add_argument("env", nargs="?", default="", metavar="ENV", help="id, such as ce_gym/MiniCheetahVelocity-v0")
    text = "ppo (default); shac: gradients through physics; distill: imitation of a teacher; sb3: Stable-Baselines3"
    what.add_argument("--algo", choices=ALGORITHMS, default="", help=text)
    levels = (*LEVELS, ELASTIC)
    text = f"one or several of {', '.join(levels)}"
    what.add_argument("--transmission", nargs="+", choices=levels, default=[], metavar="LEVEL", help=text)
    text = "observation blocks that only the critic sees, such as base_height"
    what.add_argument("--critic", nargs="+", metavar="BLOCK", help=text)
    add_env_arg(what)
    text = (
        "policy from which to continue, with its settings unless --config is given; --steps includes its steps; no "
        "code in the file is run"
    )
    what.add_argument("--resume", type=path, metavar="POLICY", help=text)
    seeds = what.add_mutually_exclusive_group()
    seeds.add_argument("--seed", type=SEED, default=0, metavar="N", help="random seed (default 0)")
    seeds.add_argument("--seeds", type=SEED, nargs="+", metavar="N", help="several seeds")
    how = parser.add_argument_group("how")
    text = "settings file, or the name of one such as mini_cheetah_stairs (default: that of the environment)"
    how.add_argument("--config", type=path, metavar="FILE", help=text)
    text = "settings, such as gamma=0.98"
    how.add_argument("--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help=text)
    how.add_argument("--steps", type=STEPS, metavar="N", help="environment steps in all, such as 6e6")
    how.add_argument("--num-envs", type=NUM_ENVS, metavar="N", help="environments stepped in parallel")
    text = "longest training time [s]"
    how.add_argument("--seconds", type=above_zero, default=float("inf"), metavar="T", help=text)
    add_threads_argument(how)
    where = parser.add_argument_group("output")
    text = "default: the folder of --resume, or a new one, runs/<name of the settings file>"
    where.add_argument("--out", type=path, metavar="FOLDER", help=text)
    add_force_argument(where)
    text = f"also write curves for {', '.join(LOGS)} (default: tensorboard if it is installed)"
    where.add_argument("--logs", nargs="*", choices=LOGS, metavar="PACKAGE", help=text)
    where.add_argument("--page", action="store_true", help="show curves and the current policy in a browser")
    text = "episodes of the evaluation, in parallel (default 256)"
    where.add_argument("--episodes", type=EPISODES, default=256, metavar="N", help=text)


@in_one_line
def train(args: argparse.Namespace) -> int:
    """Make all training runs, evaluate each policy, print its path, and return the exit code."""
    from ce_gym.learn.evaluation.evaluation import evaluate, report
    from ce_gym.viewer.watch.process import TrainingPage

    jobs = make_jobs(args)
    registered(jobs[0].env_id)  # an unknown environment is an error before any output
    if len(jobs) == 1:
        check_unused(jobs[0].out, jobs[0].resume)
    with TrainingPage([job.out for job in jobs], jobs[0].env_id) if args.page else contextlib.nullcontext():
        for job in jobs:
            remaining = unfinished(job) if len(jobs) > 1 else job
            if remaining is None:
                print(f"finished earlier: {job.out}", flush=True)
                continue
            print(f"training {job.env_id}, seed {job.seed}, {job.settings.steps:,} steps -> {job.out}", flush=True)
            trained = run_job(remaining)
            print(f"saved {trained.policy} after {trained.record['steps']:,} steps", flush=True)
            if trained.interrupted:
                command = (
                    f"python -m ce_gym train --resume {trained.policy} --out {job.out}"
                    if len(jobs) == 1
                    else "the same command"
                )
                print(f"interrupted; continue with: {command}")
                return 130
            result = evaluate(load_policy(trained.policy), job.env_id, episodes=args.episodes, **job.env_kwargs)
            print(report(result), flush=True)
    return 0


def make_jobs(args: argparse.Namespace) -> list[Job]:
    """Return the training runs of a command line, one per level and seed."""
    numbers = {"steps": args.steps, "num_envs": args.num_envs}
    return study_jobs(
        args.env,
        args.algo,
        levels=args.transmission,
        seeds=args.seeds or [args.seed],
        env_kwargs=({"obs_mode": "dict", "critic": args.critic} if args.critic else {}) | dict(args.env_args),
        settings=[*args.set, *(f"{name}={number}" for name, number in numbers.items() if number)],
        out=args.out,
        config=args.config,
        resume=args.resume,
        threads=args.threads,
        seconds=args.seconds,
        logs=default_logs() if args.logs is None else args.logs,
    )
