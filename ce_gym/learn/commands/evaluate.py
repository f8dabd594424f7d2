"""The commands `python -m ce_gym evaluate`, `transfer`, `sim2sim` and `card`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ce_gym.console import (
    EPISODES,
    SEED,
    STEPS,
    WEIGHTS_SEED,
    above_zero,
    add_command,
    add_json_argument,
    add_threads_argument,
    print_result,
    whole,
)  # fmt: skip
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.model.mechanism import ELASTIC, LEVELS
from ce_gym.policies import WHERE, add_env_arguments, locate_policy


def add_evaluate_command(subparsers: Any) -> None:
    """Add `evaluate` to the subcommands of an argument parser."""
    parser = add_command(
        subparsers,
        evaluate,
        "errors, falls, motors and largest pushes of a policy",
        "Evaluate a policy: velocity errors, falls, torques and powers of the motors, largest push without a fall.\n"
        "Torques and powers are measured at every sub-step, as fractions of the motors' limits.",
        "evaluate mini_cheetah_velocity",
        "evaluate policy.onnx --suites --pushes --crossing --json result.json",
    )
    parser.add_argument("policy", metavar="POLICY", help=WHERE)
    levels = (*LEVELS, ELASTIC)
    parser.add_argument(
        "--transmission", choices=levels, metavar="LEVEL", help=f"one of {', '.join(levels)} (default: as trained)"
    )
    sections = {
        "pushes": "also push the robots, from all directions and at several speeds",
        "suites": "also evaluate jumping commands, standing, turning in place, walking backwards, and pushes",
        "crossing": "also count the robots that walk 8 m straight ahead without a fall, by terrain level",
    }
    for name, text in sections.items():
        parser.add_argument(f"--{name}", action="store_true", help=text)
    _add_common(parser, episodes=2048)


@in_one_line
def evaluate(args: argparse.Namespace) -> int:
    """Evaluate, and print the results."""
    from ce_gym.learn.evaluate.crossing import cross
    from ce_gym.learn.evaluate.effort import effort
    from ce_gym.learn.evaluate.evaluation import evaluate as evaluate_policy
    from ce_gym.learn.evaluate.evaluation import load, report
    from ce_gym.learn.evaluate.pushes import push_envelope
    from ce_gym.learn.evaluate.suites import evaluate_suites

    policy = load(args.policy, args.env, args.transmission, args.env_args)
    kwargs = policy.record["env_kwargs"]
    result = evaluate_policy(policy, policy.record["env"], episodes=args.episodes, seed=args.seed, **kwargs)
    seed = result["seed"]
    if motors := effort(policy, episodes=min(args.episodes, 32), seed=seed, **kwargs):
        result["effort"] = motors
    if args.suites:
        result["suites"] = evaluate_suites(policy, args.episodes, seed, **kwargs)
    if args.crossing:
        result["crossing"] = cross(policy, args.episodes, seed, **kwargs)
    if args.pushes:
        result["pushes"] = push_envelope(policy, seed=seed, **kwargs)
    print_result(result, report(result), args.json)
    return 0


def add_transfer_command(subparsers: Any) -> None:
    """Add `transfer` to the subcommands of an argument parser."""
    parser = add_command(
        subparsers,
        transfer,
        "a policy on every transmission level",
        "Evaluate policies at every transmission level. With --train, policies of every level and seed are trained\n"
        "first, unless they are in the folder already. Means over seeds have 95 % confidence intervals.",
        "transfer mini_cheetah_velocity",
        "transfer --train --env ce_gym/TelloVelocity-v0 --seeds 0 1 2",
    )
    parser.add_argument(
        "policies", nargs="*", metavar="POLICY", help=f"{WHERE}; policies of several seeds are combined"
    )
    _add_common(parser, episodes=256)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write transfer.json, .md and .png there")
    how = parser.add_argument_group("training")
    how.add_argument("--train", action="store_true", help="train missing policies of --levels and --seeds")
    _add_levels_argument(how, "+", "default: all")
    how.add_argument("--seeds", type=SEED, nargs="+", default=[0, 1, 2], metavar="N", help="default: 0 1 2")
    how.add_argument("--steps", type=STEPS, metavar="N", help="environment steps of each (default: settings file)")
    add_threads_argument(how)
    how.add_argument(
        "--runs", type=Path, metavar="FOLDER", help="where runs are kept (default: runs/transfer/<settings file>)"
    )
    parser.set_defaults(complain=parser.error)


@in_one_line
def transfer(args: argparse.Namespace) -> int:
    """Train if `--train` is given, evaluate, and write the report."""
    from ce_gym.learn.evaluate.transfer import evaluate_policies, table, write_report
    from ce_gym.learn.study import Study, train_missing

    if args.train == bool(args.policies):
        args.complain("expected either policies to evaluate, or --train and --env")
    if args.train and not args.env:
        args.complain("--env: missing; expected the environment to train in")
    if args.train:
        settings = {"steps": args.steps} if args.steps else {}
        study = Study(args.env, args.levels, args.seeds, settings, dict(args.env_args), args.runs)
        policies = train_missing(study, args.threads)
    else:
        policies = [locate_policy(path) for path in args.policies]
    result = evaluate_policies(policies, args.episodes, args.seed, args.env, args.env_args)
    out = args.out or (policies[0].parents[2] if args.train else None)
    files = write_report(result, out) if out else []
    print_result(result, "\n".join([table(result["summary"]), *map(str, files)]), args.json)
    return 0


def add_sim2sim_command(subparsers: Any) -> None:
    """Add `sim2sim` to the subcommands of an argument parser."""
    parser = add_command(
        subparsers,
        sim2sim,
        "a policy in MuJoCo",
        "Evaluate a policy in MuJoCo and in ce_gym. Exit code 0 if the policy passes in all simulations of MuJoCo, "
        "1 if not,\n2 after a wrong argument.",
        "sim2sim mini_cheetah_velocity",
        "sim2sim runs/tello_velocity --seconds 20 --every 5",
    )
    parser.add_argument("policy", metavar="POLICY", help=WHERE)
    parser.add_argument("--seconds", type=above_zero, default=10.0, metavar="T", help="duration [s] (default 10)")
    text = "new commands every T seconds (default: one for the whole time)"
    parser.add_argument("--every", type=above_zero, default=float("inf"), metavar="T", help=text)
    _add_common(parser, episodes=50)


@in_one_line
def sim2sim(args: argparse.Namespace) -> int:
    """Compare, print, and return 0 if the policy passed."""
    from ce_gym.learn.evaluate.evaluation import load
    from ce_gym.learn.evaluate.sim2sim import compare, comparison_table

    policy = load(args.policy, args.env, env_args=args.env_args)
    result = compare(policy, episodes=args.episodes, seconds=args.seconds, every=args.every, seed=args.seed)
    print_result(result, comparison_table(result), args.json)
    return 0 if result["passed"] else 1


def add_card_command(subparsers: Any) -> None:
    """Add `card` to the subcommands of an argument parser."""
    parser = add_command(
        subparsers,
        card,
        "evaluate a trained policy completely, and write its card",
        "Evaluate the policy of a training run and write card.md, curve.png and policy.npz.",
        "card runs/mini_cheetah_velocity",
        "card runs/stairs --task stairs --out shelf/stairs",
    )
    parser.add_argument("policy", metavar="RUN", help="folder of a training run, or the policy in it")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--out", type=Path, metavar="FOLDER", help="default: the folder of the run")
    where.add_argument("--ship", action="store_true", help="write to assets/policies/<robot>_<task>_<level>")
    parser.add_argument("--task", metavar="NAME", help="in the policy's name, such as stairs (default: the task's)")
    _add_episodes_argument(parser, 2048)
    parser.add_argument(
        "--robots", type=whole(0, 100_000), default=50, metavar="N", help="in MuJoCo; 0 skips MuJoCo (default 50)"
    )
    _add_levels_argument(parser, "*", "of the evaluation, in addition to the training level (default: all)")
    add_env_arguments(parser)
    add_json_argument(parser)


@in_one_line
def card(args: argparse.Namespace) -> int:
    """Evaluate, and write the files of a card."""
    from ce_gym.learn.evaluate.card import write_card

    file, result = write_card(
        args.policy, args.out, args.ship, args.task, args.episodes, args.robots, args.levels, args.env, args.env_args
    )
    print_result(result, str(file), args.json)
    return 0


def _add_common(parser: argparse.ArgumentParser, episodes: int) -> None:
    """Add the arguments of evaluations: environment, number of episodes, seed, output as JSON."""
    add_env_arguments(parser)
    _add_episodes_argument(parser, episodes)
    text = "seed of the first episode (default: the first 32 bits of the SHA-256 of the policy's weights)"
    parser.add_argument("--seed", type=WEIGHTS_SEED, metavar="N", help=text)
    add_json_argument(parser)


def _add_episodes_argument(parser: argparse.ArgumentParser, episodes: int) -> None:
    text = f"episodes, in parallel (default {episodes})"
    parser.add_argument("--episodes", type=EPISODES, default=episodes, metavar="N", help=text)


def _add_levels_argument(parser: Any, count: str, text: str) -> None:
    parser.add_argument("--levels", nargs=count, choices=LEVELS, default=LEVELS, metavar="LEVEL", help=text)
