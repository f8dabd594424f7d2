"""The commands `python -m ce_gym evaluate`, `transfer`, `sim2sim` and `card`."""

from __future__ import annotations

import argparse
from typing import Any

from ce_gym.console import (
    EPISODES,
    WEIGHTS_SEED,
    above_zero,
    add_command,
    add_force_argument,
    add_json_argument,
    add_threads_argument,
    check_json,
    path,
    print_result,
    whole,
)
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.model.mechanism import ELASTIC, LEVELS
from ce_gym.policies import WHERE, add_env_arguments


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
    from ce_gym.learn.evaluation.crossing import cross
    from ce_gym.learn.evaluation.effort import effort
    from ce_gym.learn.evaluation.episodes import command_ranges
    from ce_gym.learn.evaluation.evaluation import evaluate as evaluate_policy
    from ce_gym.learn.evaluation.evaluation import load, report
    from ce_gym.learn.evaluation.pushes import push_envelope
    from ce_gym.learn.evaluation.suites import evaluate_suites

    check_json(args.json)
    policy = load(args.policy, args.env, args.transmission, args.env_args, args.threads)
    for section in ("suites", "crossing", "pushes"):
        if getattr(args, section):
            command_ranges(policy, f"--{section}")
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
        "Evaluate policies at every transmission level. Means over several seeds have 95 % confidence intervals.",
        "transfer mini_cheetah_velocity",
        "transfer runs/tello_velocity --out report",
    )
    text = f"{WHERE}; or a folder with several runs, such as `train` makes with --seeds"
    parser.add_argument("policies", nargs="+", metavar="POLICY", help=text)
    _add_common(parser, episodes=256)
    parser.add_argument("--out", type=path, metavar="FOLDER", help="write transfer.json, .md and .png there")


@in_one_line
def transfer(args: argparse.Namespace) -> int:
    """Evaluate, and write the report."""
    from ce_gym.learn.evaluation.transfer import evaluate_policies, table, write_report
    from ce_gym.learn.study import policies_in

    check_json(args.json)
    policies = [policy for place in args.policies for policy in policies_in(place)]
    result = evaluate_policies(policies, args.episodes, args.seed, args.env, args.env_args, args.threads)
    files = write_report(result, args.out) if args.out else []
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
    from ce_gym.learn.evaluation.evaluation import load
    from ce_gym.learn.evaluation.sim2sim import compare, comparison_table

    check_json(args.json)
    policy = load(args.policy, args.env, env_args=args.env_args, threads=args.threads)
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
    where.add_argument("--out", type=path, metavar="FOLDER", help="default: the folder of the run")
    where.add_argument("--ship", action="store_true", help="write to assets/policies/<robot>_<task>_<level>")
    parser.add_argument("--task", metavar="NAME", help="in the policy's name, such as stairs (default: the task's)")
    _add_episodes_argument(parser, 2048)
    parser.add_argument(
        "--sim2sim-episodes", type=whole(0, 100_000), default=50, metavar="N", help="in MuJoCo; 0: none (default 50)"
    )
    text = "levels of the evaluation, in addition to the training level (default: all)"
    parser.add_argument("--levels", nargs="*", choices=LEVELS, default=LEVELS, metavar="LEVEL", help=text)
    _add_environment(parser)
    _add_output(parser)


@in_one_line
def card(args: argparse.Namespace) -> int:
    """Evaluate, and write the files of a card."""
    from ce_gym.learn.evaluation.card import write_card

    check_json(args.json)
    file, result = write_card(
        args.policy,
        args.out,
        args.ship,
        args.task,
        args.episodes,
        args.sim2sim_episodes,
        args.levels,
        args.env,
        args.env_args,
        args.threads,
    )
    print_result(result, str(file), args.json)
    return 0


def _add_common(parser: argparse.ArgumentParser, episodes: int) -> None:
    """Add the arguments of evaluations: environment, number of episodes, seed, output as JSON."""
    _add_environment(parser)
    _add_episodes_argument(parser, episodes)
    text = "seed of the first episode (default: the first 32 bits of the SHA-256 of the policy's weights)"
    parser.add_argument("--seed", type=WEIGHTS_SEED, metavar="N", help=text)
    _add_output(parser)


def _add_environment(parser: argparse.ArgumentParser) -> None:
    add_env_arguments(parser)
    add_threads_argument(parser)


def _add_output(parser: argparse.ArgumentParser) -> None:
    add_json_argument(parser)
    add_force_argument(parser)


def _add_episodes_argument(parser: argparse.ArgumentParser, episodes: int) -> None:
    text = f"episodes, in parallel (default {episodes})"
    parser.add_argument("--episodes", type=EPISODES, default=episodes, metavar="N", help=text)
