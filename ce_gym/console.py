"""Command lines: a parser with errors of one line, types of arguments, results as text and JSON, a progress bar."""

from __future__ import annotations

import argparse
import io
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from ce_gym.files import check_output, json_kind, write_file

T = TypeVar("T")

Table = list[list[str]]
"""Rows of cells; the first row is the heading."""


class InputError(ValueError):
    """A value of a user cannot be used; the message is one line."""


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


def add_command(
    subparsers: Any, work: Callable[[argparse.Namespace], int], text: str, description: str, *lines: str
) -> Any:
    """Add a subcommand and return its parser.

    Args:
        subparsers: Subcommands of an argument parser.
        work: Function of the command, which has its name.
        text: Help in the list of commands.
        description: Help of the command.
        *lines: Example commands.
    """
    name = work.__name__
    parser = subparsers.add_parser(name, help=text, description=description, epilog=examples(*lines))
    parser.set_defaults(run=work)
    return parser


def has_display() -> bool:
    """Return whether a browser could open a window here."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def progress(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Iterate over items with a progress bar on stderr, if that is a terminal and tqdm is installed.

    Args:
        items: The items.
        label: Text before the bar.
        total: Largest number of items; None takes their length.
    """
    try:
        from tqdm import tqdm
    except ImportError:
        return iter(items)
    return iter(tqdm(items, label, total, leave=False, disable=None, dynamic_ncols=True))


def file_error(error: OSError) -> str:
    """Return file and reason of an error."""
    return f"{error.filename}: {error.strerror}" if error.filename else error.strerror or str(error)


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return a function that reads a whole number within limits, such as 6 or 6e6, from the command line."""

    def read(text: str) -> int:
        try:
            number = float(text)
        except ValueError:
            number = float("nan")
        if not (low <= number <= high and number.is_integer()):
            raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number from {low} to {high}")
        return int(number)

    return read


def above_zero(text: str) -> float:
    """Read a number above 0, or inf, from the command line."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not number > 0:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a number above 0")
    return number


SEED = whole(0, 2**31 - 1)
"""Type of `--seed`."""

WEIGHTS_SEED = whole(0, 2**32 - 1)
"""Type of `--seed` in evaluations, which may use all 32 bits."""

THREADS = whole(1, 1024)
"""Type of `--threads`."""

EPISODES = whole(1, 1_000_000)
"""Type of `--episodes`."""

STEPS = whole(1, 10**12)
"""Type of `--steps`."""

NUM_ENVS = whole(1, 2**20)
"""Type of `--num-envs`."""


def add_threads_argument(parser: Any) -> None:
    """Add `--threads`; None stands for all cores."""
    parser.add_argument("--threads", type=THREADS, metavar="N", help="processor threads (default: all cores)")


def path(text: str) -> Path:
    """Read the name of a file or folder from the command line."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"{text!r}; expected a name")
    return Path(text)


def add_force_argument(parser: Any) -> None:
    """Add `--force`, see `ce_gym.files`."""
    text = "replace files of other kinds, and finished runs; never a file that the command reads"
    parser.add_argument("--force", action="store_true", help=text)


def add_json_argument(parser: Any) -> None:
    """Add `--json`, the argument of `print_result`."""
    text = "write the result to FILE as JSON as well; without FILE, print JSON and nothing else"
    parser.add_argument("--json", type=lambda name: str(path(name)), nargs="?", const="-", metavar="FILE", help=text)


def check_json(json_file: str | None) -> None:
    """Check the file of `--json` before the result is computed.

    Raises:
        OSError: If the file may not be replaced.
    """
    if json_file not in (None, "-"):
        check_output(Path(str(json_file)), json_kind('{\n  "'))


def print_result(result: Any, text: str, json_file: str | None) -> None:
    """Print a result as text or JSON, and write it to the file of `--json`.

    Args:
        result: Plain data.
        text: The result as text.
        json_file: Value of `--json`: None, a file, or "-" for JSON instead of text.

    Raises:
        OSError: If the file cannot be written or replaced.
    """
    data = json.dumps(result, indent=2)
    print(data if json_file == "-" else text)
    if json_file not in (None, "-"):
        write_file(str(json_file), data + "\n", json_kind(data))


def markdown(table: Table) -> str:
    """Return a table as Markdown with aligned columns."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    heading, *rows = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in table
    ]
    return "\n".join([heading, "|" + "|".join("-" * (width + 2) for width in widths) + "|", *rows])
