"""The command `python -m ce_gym export`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ce_gym.console import examples
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.policies import WHERE, PolicyError, read_actor


def add_export_command(subparsers: Any) -> None:
    """Add `export` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "export",
        help="write a policy as ONNX, for a robot's computer",
        description="Write a trained policy as ONNX, and its specification beside it as JSON.",
        epilog=examples("export runs/mini_cheetah_velocity", "export tello_velocity walk.onnx"),
    )
    parser.add_argument("policy", type=Path, metavar="POLICY", help=WHERE)
    parser.add_argument(
        "out", type=Path, nargs="?", metavar="FILE", help="ONNX file to write (default: exported.onnx beside it)"
    )
    parser.set_defaults(run=export)


@in_one_line
def export(args: argparse.Namespace) -> int:
    """Write the two files."""
    from ce_gym.learn.export import to_onnx, write

    out = args.out or args.policy.parent / "exported.onnx"
    if out.suffix != ".onnx" or out.with_suffix(".json") == args.policy.with_suffix(".json"):
        raise PolicyError(f"{out}: expected a name that ends in .onnx and is not the policy's own")
    actor, record = read_actor(args.policy)
    write(to_onnx(actor, record), record, out)
    print(f"{out}\n{out.with_suffix('.json')}")
    return 0
