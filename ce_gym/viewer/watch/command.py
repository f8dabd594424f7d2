"""`python -m ce_gym watch`: the page of a training run."""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import threading
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ce_gym.policies import add_env_arguments
from ce_gym.viewer.console import examples, has_display

_HERE = Path(__file__).parent


def add_watch_command(subparsers: Any) -> None:
    """Add `watch` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "watch",
        help="show how training goes: learning curves, reward terms, the present policy",
        description="Show training runs in a browser on this machine, while they train or afterwards, until Ctrl-C: "
        "their\nfigures over the steps, and the newest policy walking. `--page` of the training scripts does this for "
        "their own run.",
        epilog=examples(
            "watch runs/mini_cheetah_velocity-fast",
            "watch runs/one runs/other",
            "watch runs/my_robot --env my_module:ce_gym/MyRobotVelocity-v0",
        ),
    )
    parser.add_argument(
        "folders", nargs="+", type=Path, metavar="FOLDER", help="of a training run; or one that has such folders"
    )
    add_env_arguments(parser)
    parser.add_argument(
        "--open", action=argparse.BooleanOptionalAction, default=True, help="open a browser, if there is one"
    )
    parser.add_argument(
        "--until-eof", action="store_true", help="end with the standard input, and wait for runs that begin later"
    )
    parser.set_defaults(run=watch)


def watch(args: argparse.Namespace) -> int:
    """Run `watch`; return its exit code."""
    if args.until_eof:  # whoever started this ends it; a Ctrl-C is not meant for it
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    from ce_gym.viewer.page.html import meshcat_code
    from ce_gym.viewer.watch.watcher import Watcher

    meshcat_code()  # fails at once if meshcat is missing
    watcher = Watcher(args.folders, args.env or "", dict(args.env_args), patient=args.until_eof)
    with contextlib.suppress(KeyboardInterrupt), serving(watcher) as url:
        print(f"watch at {url}" + ("" if args.until_eof else " (Ctrl-C to stop)"), flush=True)
        if args.open and has_display():
            webbrowser.open(url, new=2)
        if args.until_eof:
            sys.stdin.buffer.read()
        else:
            threading.Event().wait()
    return 0


@contextlib.contextmanager
def serving(watcher: Any) -> Iterator[str]:
    """Run a watcher and serve its page; yield the address."""
    from ce_gym.viewer.server import PageServer

    page = watch_page(watcher.name)
    with contextlib.closing(watcher), contextlib.closing(PageServer(page, watcher.feed.events)) as server:
        watcher.start()
        yield server.url


def watch_page(title: str) -> str:
    """Return the page of training runs.

    Raises:
        ViewerError: meshcat is not installed.
    """
    from ce_gym.viewer.page.html import filled, plots_code, source

    return filled(
        _HERE / "watch.html",
        title,
        plotstyle=source("plots.css"),
        plots=plots_code(),
        watch=(_HERE / "watch.js").read_text(encoding="utf-8"),
    )
