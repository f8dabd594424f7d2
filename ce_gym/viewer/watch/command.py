"""`python -m ce_gym watch`: the page of a training run."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path
from typing import Any

from ce_gym.console import examples
from ce_gym.policies import add_env_arguments


def add_watch_command(subparsers: Any) -> None:
    """Add `watch` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "watch",
        help="show how training goes: learning curves, reward terms, the present policy",
        description="Show training runs in a browser on this machine, during and after training, until Ctrl-C: "
        "learning\ncurves, and a robot under the newest policy. `--page` of the training scripts shows their own run.",
        epilog=examples(
            "watch runs/mini_cheetah_velocity-fast",
            "watch runs/one runs/other",
            "watch runs/my_robot --env my_module:ce_gym/MyRobotVelocity-v0",
        ),
    )
    parser.add_argument(
        "folders", nargs="+", type=Path, metavar="FOLDER", help="folder of a training run, or of several runs"
    )
    add_env_arguments(parser)
    parser.add_argument(
        "--open", action=argparse.BooleanOptionalAction, default=True, help="open a browser, if there is a display"
    )
    parser.add_argument(
        "--until-eof", action="store_true", help="end with the standard input, and wait for runs that begin later"
    )
    parser.set_defaults(run=watch)


def watch(args: argparse.Namespace) -> int:
    """Run `watch`; return its exit code."""
    if args.until_eof:  # Ctrl-C is for the training script, which then closes the input
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    from ce_gym.viewer.page.html import meshcat_code
    from ce_gym.viewer.stream import serve
    from ce_gym.viewer.watch.watcher import Watcher

    meshcat_code()
    watcher = Watcher(args.folders, args.env or "", dict(args.env_args), patient=args.until_eof)
    serve(watcher, "watch", open_browser=args.open, until_eof=args.until_eof)
    return 0
