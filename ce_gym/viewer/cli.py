"""The commands `python -m ce_gym view`, `play`, `live` and `watch`."""

from __future__ import annotations

import argparse
import signal
import webbrowser
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ce_gym.console import add_force_argument, examples, has_display, path
from ce_gym.files import PAGE, check_output
from ce_gym.model.assets import robots
from ce_gym.model.mechanism import ELASTIC, LEVELS
from ce_gym.policies import WHERE, add_env_arguments, find_policy, locate_policy, policy_name
from ce_gym.viewer.errors import ViewerError

if TYPE_CHECKING:
    from ce_gym.viewer.rollouts.rollout import Rollout

ROBOT_FILES = (".urdf", ".xml", ".yaml", ".yml")
"""Suffixes of robot files, see `load_robot`."""


def add_view_command(subparsers: Any) -> None:
    """Add `view` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "view",
        help="show a robot file, recorded rollouts or policies in a browser",
        description="Show recorded rollouts or policies: write one self-contained HTML file (default) or a video, or "
        "serve\nthe page on this machine until Ctrl-C. Of a robot file, serve a page with sliders of the joints, and "
        "overlays\nof contacts, frames, inertias, collision shapes and centre of mass.",
        epilog=examples(
            "view my_robot.urdf",
            "view walk.npz",
            "view exact.npz armature.npz --overlay",
            "view walk.npz --plot 'torque of FL_knee' reward",
        ),
    )
    parser.add_argument(
        "rollouts",
        nargs="+",
        type=path,
        metavar="FILE",
        help=f"a recorded rollout (.npz); a policy: {WHERE}; or one robot: a file (.urdf, .xml or .yaml) or a name",
    )
    parser.add_argument("--overlay", action="store_true", help="draw all in one place, all but the first as ghosts")
    add_env_arguments(parser)
    _add_page_arguments(parser, "beside the first rollout, here for policies", open_browser=None)
    parser.set_defaults(run=view)


def add_play_command(subparsers: Any) -> None:
    """Add `play` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "play",
        help="simulate a trained policy, record it and show it in a browser",
        description="Simulate a trained policy with a list of commands, and show it: several transmission levels as "
        "ghosts\nof the first, from the same seed, or many robots in a square.",
        epilog=examples(
            "play mini_cheetah_velocity",
            "play mit_humanoid_velocity --transmission exact none",
            "play mini_cheetah_velocity --video walk.gif --size 400 300",
            "play demo --robots 16 --command 5 0.8 0 0 --command 5 0.5 0 1",
        ),
    )
    parser.add_argument("policy", type=path, metavar="POLICY", help=WHERE)
    parser.add_argument(
        "--transmission",
        nargs="+",
        choices=(*LEVELS, ELASTIC),
        metavar="LEVEL",
        default=[],
        help=f"{', '.join(LEVELS)} or {ELASTIC} (default: as trained); all but the first become ghosts",
    )
    parser.add_argument(
        "--robots", type=_at_least_one, default=1, metavar="N", help="number of robots; each has its own seed"
    )
    parser.add_argument(
        "--command",
        nargs=4,
        type=float,
        action="append",
        metavar=("SECONDS", "FORWARD", "LEFT", "TURN"),
        help="command [m/s, m/s, rad/s] and its duration; may be repeated (default: a short show)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the first robot (default 0)")
    add_env_arguments(parser)
    parser.add_argument("--save", type=path, metavar="FOLDER", help="also write the rollouts as .npz files there")
    _add_page_arguments(parser, "here, named after the policy")
    parser.set_defaults(run=play)


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
    parser.add_argument(
        "--folder", type=path, default=Path(), metavar="FOLDER", help="where recordings are written (default: here)"
    )
    _add_open_argument(parser, default=True)
    parser.set_defaults(run=live)


def add_watch_command(subparsers: Any) -> None:
    """Add `watch` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "watch",
        help="show how training goes: learning curves, reward terms, the present policy",
        description="Show training runs in a browser on this machine, during and after training, until Ctrl-C: "
        "learning\ncurves, and a robot under the newest policy. `train --page` shows its own run.",
        epilog=examples(
            "watch runs/mini_cheetah_velocity",
            "watch runs/one runs/other",
            "watch runs/my_robot --env my_module:ce_gym/MyRobotVelocity-v0",
        ),
    )
    parser.add_argument(
        "folders", nargs="+", type=path, metavar="FOLDER", help="folder of a training run, or of several runs"
    )
    add_env_arguments(parser)
    _add_open_argument(parser, default=True)
    parser.add_argument(
        "--until-eof", action="store_true", help="end with the standard input, and wait for runs that begin later"
    )
    parser.set_defaults(run=watch)


def _at_least_one(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number, at least 1")
    return int(text)


def _add_page_arguments(parser: argparse.ArgumentParser, default: str, *, open_browser: bool | None = False) -> None:
    """Add the arguments for the target and the look of a page; `open_browser` is the default of `--open`."""
    target = parser.add_mutually_exclusive_group()
    target.add_argument("--html", type=path, metavar="FILE", help=f"HTML file to write (default: {default})")
    target.add_argument("--live", action="store_true", help="serve the page on this machine's loopback until Ctrl-C")
    target.add_argument("--video", type=path, metavar="FILE", help="a video of one robot: FILE.mp4, .webm or .gif")
    parser.add_argument(
        "--size",
        type=_at_least_one,
        nargs=2,
        default=(640, 480),
        metavar=("WIDTH", "HEIGHT"),
        help="of the video [pixels] (default 640 480)",
    )
    parser.add_argument("--plot", nargs="+", default=[], metavar="SIGNAL", help="signals to plot first")
    parser.add_argument("--title", help="heading of the page (default: the robot's name)")
    add_force_argument(parser)
    _add_open_argument(parser, default=open_browser)


def _add_open_argument(parser: argparse.ArgumentParser, *, default: bool | None) -> None:
    parser.add_argument(
        "--open", action=argparse.BooleanOptionalAction, default=default, help="open a browser, if there is a display"
    )


def view(args: argparse.Namespace) -> int:
    """Run `view`; return its exit code."""
    if any(map(_is_robot, args.rollouts)):
        return _view_robot(args)
    from ce_gym.viewer.rollouts.driving import walk
    from ce_gym.viewer.rollouts.rollout import Rollout

    policies = [find_policy(file) for file in args.rollouts]
    page = args.html or (_page_of(policies[0]) if policies[0] else args.rollouts[0].with_suffix(".html"))
    _check_target(args, page, len(args.rollouts))
    rollouts = [
        walk(policy, env=args.env, **dict(args.env_args))[0] if policy else Rollout.load(file)
        for policy, file in zip(policies, args.rollouts, strict=True)
    ]
    return _present(rollouts, args, page, overlay=args.overlay)


def _is_robot(file: Path) -> bool:
    """Return whether a robot is meant: a file by its suffix, or the name of a robot of the package."""
    return file.suffix.lower() in ROBOT_FILES or (str(file) in robots() and find_policy(file) is None)


def _view_robot(args: argparse.Namespace) -> int:
    """Serve the page of a robot file; return the exit code."""
    from ce_gym.model import load_robot
    from ce_gym.viewer.page.html import meshcat_code
    from ce_gym.viewer.preparing import Preparing
    from ce_gym.viewer.robot_page import RobotPage
    from ce_gym.viewer.stream import serve

    robot = next(filter(_is_robot, args.rollouts))
    if len(args.rollouts) > 1:
        raise ViewerError(f"{robot}: {len(args.rollouts)} files; expected a robot alone, show other files separately")
    for option in ("html", "video", "overlay", "plot", "env", "env_args", "title"):
        if getattr(args, option):
            name = option.replace("_", "-").removesuffix("s")
            raise ViewerError(f"{robot}: --{name} is for rollouts and policies; expected a robot without it")
    meshcat_code()
    page = Preparing(robot.stem, lambda: RobotPage(load_robot(str(robot))))
    serve(page, "view", open_browser=args.open is not False)
    return 0


def play(args: argparse.Namespace) -> int:
    """Run `play`; return its exit code."""
    from ce_gym.viewer.rollouts.driving import SHOW, walk

    file = locate_policy(args.policy)
    page = args.html or _page_of(file)
    _check_target(args, page, args.robots * max(len(args.transmission), 1))
    if args.robots > 1 and len(args.transmission) > 1:
        raise ViewerError(f"--robots {args.robots}: expected 1, or one level of --transmission")
    script = [(time, (x, y, turn)) for time, x, y, turn in args.command] if args.command else SHOW
    options = {**dict(args.env_args), "robots": args.robots, "seed": args.seed, "env": args.env}
    levels = [{"transmission": level, "label": level} for level in args.transmission] or [{}]
    rollouts = [rollout for level in levels for rollout in walk(file, script, **options, **level)]
    if args.robots > 1:
        rollouts = [replace(rollout, label=f"seed {args.seed + index}") for index, rollout in enumerate(rollouts)]
    if args.save:
        args.save.mkdir(parents=True, exist_ok=True)
        for index, rollout in enumerate(rollouts):
            number = f"_{args.seed + index}" if args.robots > 1 else ""
            print(rollout.save(args.save / f"{policy_name(file)}_{rollout.transmission}{number}.npz"))
    return _present(rollouts, args, page, overlay=len(levels) > 1)


def live(args: argparse.Namespace) -> int:
    """Run `live`; return its exit code."""
    from ce_gym.viewer.live.runner import Runner
    from ce_gym.viewer.live.setup import named
    from ce_gym.viewer.page.html import meshcat_code
    from ce_gym.viewer.preparing import Preparing
    from ce_gym.viewer.stream import serve

    meshcat_code()  # a missing meshcat is reported before the compilation
    options = {name: getattr(args, name) for name in ("transmission", "ghost", "terrain")}
    setup = named(args.name, args.env or "", kwargs=dict(args.env_args), **options)
    serve(Preparing(args.name, lambda: Runner(setup, args.folder)), "live", open_browser=args.open)
    return 0


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


def _check_target(args: argparse.Namespace, page: Path, robots: int) -> None:
    """Check the requested output before the simulation.

    Raises:
        OSError: The page may not be replaced.
        ViewerError: A package is missing, or a video would show several robots.
    """
    from ce_gym.viewer.page.html import meshcat_code

    if not args.video:
        meshcat_code()
        if not args.live:
            check_output(page, PAGE)
        return
    from ce_gym.viewer.video import check_video

    check_video(args.video, tuple(args.size))
    if robots > 1:
        raise ViewerError(f"--video with {robots} robots: expected one, on one level of --transmission")


def _page_of(policy: Path) -> Path:
    return Path(f"{policy_name(policy)}.html")


def _present(rollouts: Sequence[Rollout], args: argparse.Namespace, page: Path, *, overlay: bool) -> int:
    """Write or serve the page of rollouts, or write a video; return the exit code."""
    from ce_gym.viewer import show, write_html, write_video

    if args.video:
        print(write_video(rollouts[0], args.video, size=tuple(args.size)))
        return 0
    options: dict[str, Any] = {"title": args.title, "spacing": 0.0 if overlay else None, "plot": args.plot}
    may_open = args.open and has_display()
    if args.live:
        show(rollouts, open_browser=may_open, **options)
        return 0
    print(write_html(rollouts, page, **options))
    if may_open:
        webbrowser.open(page.resolve().as_uri(), new=2)
    return 0
