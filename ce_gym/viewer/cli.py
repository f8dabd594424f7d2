"""`python -m ce_gym view`: its arguments, and what it does with them. Knows the viewer's public functions."""

from __future__ import annotations

import argparse
import os
import sys
import webbrowser
from pathlib import Path
from typing import Any


def add_view_command(subparsers: Any) -> None:
    """Add `view` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "view",
        help="show recorded rollouts and policies, as one HTML file or live",
        description="Show recorded rollouts, or what policies do: write one self-contained HTML file (default), or "
        "serve a page live.",
    )
    parser.add_argument(
        "rollouts", nargs="+", type=Path, metavar="ROLLOUT",
        help="rollout file (.npz); a policy.npz or its folder; the name of a shipped policy; several side by side",
    )  # fmt: skip
    target = parser.add_mutually_exclusive_group()
    target.add_argument(
        "--html",
        type=Path,
        metavar="FILE",
        help="HTML file to write (default: beside the first rollout, here for policies)",
    )
    target.add_argument("--live", action="store_true", help="serve the page on this machine's loopback until Ctrl-C")
    parser.add_argument("--overlay", action="store_true", help="draw all in one place, all but the first as ghosts")
    parser.add_argument("--title", help="heading of the page (default: the robot's name)")
    parser.add_argument(
        "--open", action=argparse.BooleanOptionalAction, default=False, help="open a browser, if there is a display"
    )
    parser.set_defaults(run=view)


def view(args: argparse.Namespace) -> int:
    """Run the command; return its exit code."""
    from ce_gym.viewer import Rollout, show, write_html
    from ce_gym.viewer.walk import policy_file, walk

    policies = [policy_file(path) for path in args.rollouts]
    rollouts = [walk(p) if p else Rollout.load(path) for p, path in zip(policies, args.rollouts, strict=True)]
    first = Path(f"{policies[0].parent.resolve().name}.npz") if policies[0] else args.rollouts[0]
    options = {"title": args.title, "spacing": 0.0 if args.overlay else None}
    may_open = args.open and has_display()
    if args.live:
        show(rollouts, open_browser=may_open, **options)
        return 0
    path = write_html(rollouts, args.html or first.with_suffix(".html"), **options)
    print(path)
    if may_open:
        webbrowser.open(path.resolve().as_uri(), new=2)
    return 0


def has_display() -> bool:
    """Return whether a browser could open a window here."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
