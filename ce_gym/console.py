"""Command lines: a parser with errors of one line, and a progress bar."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Collection, Iterator
from typing import Any, NoReturn, TypeVar

T = TypeVar("T")


class Parser(argparse.ArgumentParser):
    """An argument parser that keeps the line breaks of its texts and reports an error in one line."""

    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **options)

    def error(self, message: str) -> NoReturn:
        """Print one line and leave with exit code 2."""
        print(f"ce_gym: {message}; {self.prog} --help shows what can be given", file=sys.stderr)
        sys.exit(2)


def print_anything() -> None:
    """Replace characters that the output's encoding lacks by question marks, for example in files on Windows."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def examples(*lines: str) -> str:
    """Return an epilog with example commands."""
    return "\n".join(["examples:", *(f"  python -m ce_gym {line}" for line in lines)])


def has_display() -> bool:
    """Return whether a browser could open a window here."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def progress(items: Collection[T], label: str) -> Iterator[T]:
    """Iterate over items with a progress bar on stderr, if that is a terminal and tqdm is installed."""
    try:
        from tqdm import tqdm
    except ImportError:
        return iter(items)
    return iter(tqdm(items, label, leave=False, disable=None, dynamic_ncols=True))
