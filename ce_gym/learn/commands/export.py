"""The command `python -m ce_gym export`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ce_gym.console import add_command
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.policies import WHERE, PolicyError, locate_policy, shelf


def add_export_command(subparsers: Any) -> None:
    """Add `export` to the subcommands of an argument parser."""
    parser = add_command(
        subparsers,
        export,
        "write a policy as ONNX, for a robot's computer",
        "Write a trained policy as ONNX, and its specification beside it as JSON.",
        "export runs/mini_cheetah_velocity",
        "export tello_velocity --out walk.onnx",
    )
    parser.add_argument("policy", metavar="POLICY", help=WHERE)
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="default: exported.onnx beside the policy; <name>.onnx here if shipped"
    )


@in_one_line
def export(args: argparse.Namespace) -> int:
    """Write the two files."""
    from ce_gym.policies.onnx_writer import export_policy

    policy = locate_policy(args.policy)
    shipped = policy.is_relative_to(shelf())
    out = args.out or (Path(f"{args.policy}.onnx") if shipped else policy.with_name("exported.onnx"))
    if out.suffix != ".onnx" or out.with_suffix(".json") == policy.with_suffix(".json"):
        raise PolicyError(f"{out}: expected a name that ends in .onnx and is not the policy's own")
    export_policy(policy, out)
    print(f"{out}\n{out.with_suffix('.json')}")
    return 0
