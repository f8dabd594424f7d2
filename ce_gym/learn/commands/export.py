"""The command `python -m ce_gym export`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ce_gym.console import add_command, add_force_argument, path
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.policies import (
    WHERE,
    add_env_arguments,
    export_policy,
    locate_policy,
    observation_in_words,
    shelf,
)


def add_export_command(subparsers: Any) -> None:
    """Add `export` to the subcommands of an argument parser."""
    parser = add_command(
        subparsers,
        export,
        "write a policy as ONNX, TorchScript, C or numpy, for a robot's computer",
        "Write a trained policy as ONNX (.onnx), TorchScript (.pt), a header for C (.h) or numpy arrays (.npz), and "
        "its specification beside it as JSON. Print the meaning of its observation.",
        "export runs/mini_cheetah_velocity",
        "export tello_velocity --out walk.onnx walk.h",
    )
    parser.add_argument("policy", metavar="POLICY", help=WHERE)
    text = (
        "files, with the suffix of their format (default: exported.onnx beside the policy; <name>.onnx here if shipped)"
    )
    parser.add_argument("--out", type=path, nargs="+", metavar="FILE", help=text)
    add_env_arguments(parser)
    add_force_argument(parser)


@in_one_line
def export(args: argparse.Namespace) -> int:
    """Write the files, and print their names and the meaning of an observation."""
    policy = locate_policy(args.policy)
    shipped = policy.is_relative_to(shelf())
    outs = args.out or [Path(f"{args.policy}.onnx") if shipped else policy.with_name("exported.onnx")]
    for out in outs:
        spec = export_policy(policy, out, args.env, dict(args.env_args))
        print(f"{out}\n{out.with_suffix('.json')}")
        if out is outs[-1] and "observation" in spec:
            print("Observation:", *observation_in_words(spec), sep="\n")
    return 0
