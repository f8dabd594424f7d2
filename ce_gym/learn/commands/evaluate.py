"""The commands `python -m ce_gym evaluate`, `transfer`, `sim2sim` and `card`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ce_gym.console import (
    EPISODES,
    SEED,
    THREADS,
    WEIGHTS_SEED,
    above_zero,
    add_json_argument,
    examples,
    print_result,
    whole,
)
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.model.mechanism import LEVELS
from ce_gym.policies import WHERE, add_env_arguments, locate_policy

SEED_HELP = "seed of the first episode (default: the first 32 bits of the SHA-256 of the policy's weights)"


def add_evaluate_command(subparsers: Any) -> None:
    """Add `evaluate` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "evaluate",
        help="errors, falls, motors and largest pushes of a policy",
        description="Evaluate a policy: velocity errors, falls, torques and powers of the motors, largest push without "
        "a fall.\nTorques and powers are measured at every sub-step, as fractions of the motors' limits.",
        epilog=examples(
            "evaluate mini_cheetah_velocity", "evaluate policy.onnx --suites --pushes --crossing --json result.json"
        ),
    )
    parser.add_argument("policy", help=WHERE)
    parser.add_argument(
        "--transmission", metavar="LEVEL", help="exact, coupled, armature, none or elastic (default: as trained)"
    )
    parser.add_argument(
        "--pushes", action="store_true", help="also push the robots, from all directions and at several speeds"
    )
    parser.add_argument(
        "--suites",
        action="store_true",
        help="also evaluate jumping commands, standing, turning in place, walking backwards, and pushes",
    )
    parser.add_argument(
        "--crossing",
        action="store_true",
        help="also count the robots that walk 8 m straight ahead without a fall, by terrain level",
    )
    add_env_arguments(parser)
    _add_common(parser, episodes=2048)
    parser.set_defaults(run=evaluate)


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
    parser = subparsers.add_parser(
        "transfer",
        help="a policy on every transmission level",
        description="Evaluate policies at every transmission level. With --train, policies of every level and seed are "
        "trained\nfirst, unless they are in the folder already. Means over seeds have 95 % confidence intervals.",
        epilog=examples(
            "transfer mini_cheetah_velocity", "transfer --train --env ce_gym/TelloVelocity-v0 --seeds 0 1 2"
        ),
    )
    parser.add_argument(
        "policies", nargs="*", metavar="POLICY", help=f"{WHERE}; policies of several seeds are combined"
    )
    add_env_arguments(parser)
    _add_common(parser, episodes=256)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write transfer.json, .md and .png there")
    how = parser.add_argument_group("training")
    how.add_argument("--train", action="store_true", help="train missing policies of --levels and --seeds")
    how.add_argument("--levels", nargs="+", choices=LEVELS, default=LEVELS, metavar="LEVEL", help="default: all")
    how.add_argument("--seeds", type=SEED, nargs="+", default=[0, 1, 2], metavar="N", help="default: 0 1 2")
    how.add_argument("--steps", metavar="N", help="environment steps of each (default: as in the settings file)")
    how.add_argument("--threads", type=THREADS, metavar="N", help="default: all cores")
    how.add_argument(
        "--runs", type=Path, metavar="FOLDER", help="where runs are kept (default: runs/transfer/<settings file>)"
    )
    parser.set_defaults(run=transfer, complain=parser.error)


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
        overrides = [f"steps={args.steps}"] if args.steps else []
        study = Study(args.env, args.levels, args.seeds, overrides, dict(args.env_args), args.runs)
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
    parser = subparsers.add_parser(
        "sim2sim",
        help="a policy in MuJoCo",
        description="Evaluate a policy in MuJoCo and in ce_gym. Exit code 0 if the policy passes in all simulations of "
        "MuJoCo, 1 if not,\n2 after a wrong argument.",
        epilog=examples("sim2sim mini_cheetah_velocity", "sim2sim runs/tello_velocity --seconds 20 --every 5"),
    )
    parser.add_argument("policy", help=WHERE)
    parser.add_argument("--seconds", type=above_zero, default=10.0, metavar="T", help="duration [s] (default 10)")
    parser.add_argument(
        "--every",
        type=above_zero,
        default=float("inf"),
        metavar="T",
        help="new commands every T seconds (default: one for the whole time)",
    )
    add_env_arguments(parser)
    _add_common(parser, episodes=50)
    parser.set_defaults(run=sim2sim)


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
    parser = subparsers.add_parser(
        "card",
        help="evaluate a trained policy completely, and write its card",
        description="Evaluate the policy of a training run and write card.md, curve.png and policy.npz.",
        epilog=examples("card runs/mini_cheetah_velocity", "card runs/stairs --task stairs --out shelf/stairs"),
    )
    parser.add_argument("policy", metavar="RUN", help="folder of a training run, or the policy in it")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--out", type=Path, metavar="FOLDER", help="where to write (default: the run's folder)")
    where.add_argument("--ship", action="store_true", help="write to assets/policies/<robot>_<task>_<level>")
    parser.add_argument("--task", metavar="NAME", help="in the policy's name, such as stairs (default: the task's)")
    parser.add_argument(
        "--episodes", type=EPISODES, default=2048, metavar="N", help="episodes at each level (default 2048)"
    )
    parser.add_argument(
        "--robots", type=whole(0, 100_000), default=50, metavar="N", help="in MuJoCo; 0 skips MuJoCo (default 50)"
    )
    parser.add_argument(
        "--levels",
        nargs="*",
        choices=LEVELS,
        default=LEVELS,
        metavar="LEVEL",
        help="levels of the evaluation, in addition to the training level (default: all)",
    )
    add_env_arguments(parser)
    add_json_argument(parser)
    parser.set_defaults(run=card)


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
    """Add the arguments of evaluations: number of episodes, seed, output as JSON."""
    parser.add_argument(
        "--episodes", type=EPISODES, default=episodes, metavar="N", help=f"episodes, in parallel (default {episodes})"
    )
    parser.add_argument("--seed", type=WEIGHTS_SEED, metavar="N", help=SEED_HELP)
    add_json_argument(parser)
