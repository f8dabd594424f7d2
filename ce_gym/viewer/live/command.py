"""`python -m ce_gym live`: drive, push and throw a robot in a browser."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ce_gym.console import examples
from ce_gym.policies import WHERE, add_env_arguments


def add_live_command(subparsers: Any) -> None:
    """Add `live` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "live",
        help="drive, push and throw a robot in a browser",
        description="Simulate a robot in a browser on this machine, in real time, until Ctrl-C: drive it by keys, "
        "stick or\ngamepad, pull it with the mouse, change ground, friction, load, transmission level and policy while "
        "it runs.",
        epilog=examples(
            "live mini_cheetah_velocity",
            "live mit_humanoid_velocity --ghost armature",
            "live my_module:ce_gym/MyRobotVelocity-v0 --env-arg terrain=stairs",
        ),
    )
    parser.add_argument("name", metavar="NAME", help=f"{WHERE}; or the id of an environment, whose pose is held")
    add_env_arguments(parser)
    parser.add_argument("--transmission", metavar="LEVEL", default="", help="first level (default: as trained)")
    parser.add_argument("--ghost", metavar="LEVEL", default="", help="level of a ghost (default: no ghost)")
    parser.add_argument("--terrain", metavar="KIND", default="", help="first ground (default: as trained)")
    parser.add_argument("--folder", type=Path, default=Path(), help="where recordings are written (default: here)")
    parser.add_argument(
        "--open", action=argparse.BooleanOptionalAction, default=True, help="open a browser, if there is a display"
    )
    parser.set_defaults(run=live)


def live(args: argparse.Namespace) -> int:
    """Run `live`; return its exit code."""
    from ce_gym.viewer.live.runner import Runner
    from ce_gym.viewer.live.setup import named
    from ce_gym.viewer.page.html import meshcat_code
    from ce_gym.viewer.stream import serve

    meshcat_code()  # a missing meshcat is reported before the compilation
    options = {name: getattr(args, name) for name in ("transmission", "ghost", "terrain")}
    setup = named(args.name, args.env or "", kwargs=dict(args.env_args), **options)
    serve(Runner(setup, args.folder), "live", open_browser=args.open)
    return 0
