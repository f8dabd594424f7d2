"""Command lines of the training programs: results as text and JSON, errors in one line."""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import gymnasium

EXTRAS = {"mujoco": "mjcf", "meshcat": "viewer", "onnx": "export", "numba": "fast"}
"""Extra of ce_gym that installs an optional package."""

UNKNOWN_ARGUMENT = "unexpected keyword argument"
"""Message of Python about a wrong name in `--env-arg`, if an environment does not check names."""

Table = list[list[str]]
"""Rows of cells; the first row is the heading."""


def run(program: str, work: Callable[[], int]) -> int:
    """Run a program and return its exit code: 2 after a wrong input, which prints one line, and 130 after Ctrl-C."""
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: print(f"{program}: warning: {message}", file=sys.stderr)
            return work()
    except ModuleNotFoundError as error:
        return report_missing(program, error)
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"{program}: {file_error(error)}", file=sys.stderr)
        return 2
    except MemoryError as error:
        print(f"{program}: not enough memory: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except (ValueError, TypeError, gymnasium.error.Error) as error:
        if isinstance(error, TypeError) and UNKNOWN_ARGUMENT not in str(error):
            raise
        print(f"{program}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def report_missing(program: str, error: ModuleNotFoundError) -> int:
    """Print in one line which package a program needs and how to install it; return the exit code.

    Raises:
        ModuleNotFoundError: If the missing module belongs to ce_gym.
    """
    if error.name is None:  # Gymnasium's error about the module of an id
        print(f"{program}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    package = error.name.split(".")[0]
    if package == "ce_gym":
        raise error
    how = f"ce_gym[{EXTRAS[package]}]" if package in EXTRAS else package
    print(f'{program}: needs {package}, which is not installed: pip install "{how}"', file=sys.stderr)
    return 2


def file_error(error: OSError) -> str:
    """Return file and reason of an error."""
    return f"{error.filename}: {error.strerror}" if error.filename else error.strerror or str(error)


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line."""

    def error(self, message: str) -> NoReturn:
        """Print one line and leave with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; --help shows what can be given\n")


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return a function that reads a whole number within limits from the command line."""

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = low - 1
        if not low <= number <= high:
            raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number from {low} to {high}")
        return number

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

THREADS = whole(1, 1024)
"""Type of `--threads`."""

EPISODES = whole(1, 1_000_000)
"""Type of `--episodes`."""


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--json`, the argument of `print_result`."""
    text = "write the result to FILE as JSON as well; without FILE, print JSON and nothing else"
    parser.add_argument("--json", nargs="?", const="-", metavar="FILE", help=text)


def print_result(result: Any, text: str, json_file: str | None) -> None:
    """Print a result as text or JSON, and write it to the file of `--json`.

    Args:
        result: Plain data.
        text: The result as text.
        json_file: Value of `--json`: None, a file, or "-" for JSON instead of text.

    Raises:
        OSError: If the file cannot be written.
    """
    data = json.dumps(result, indent=2)
    print(data if json_file == "-" else text)
    if json_file not in (None, "-"):
        Path(str(json_file)).write_text(data + "\n", encoding="utf-8")


def markdown(table: Table) -> str:
    """Return a table as Markdown with aligned columns."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    heading, *rows = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in table
    ]
    return "\n".join([heading, "|" + "|".join("-" * (width + 2) for width in widths) + "|", *rows])
