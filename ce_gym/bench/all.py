"""Run the benchmarks one after the other and write the report of each as `<name>.json` to a folder.

Each benchmark runs in its own process. A benchmark whose package or GPU is missing is skipped with the reason, and its
old file stays. The documentation takes its numbers from `docs/results`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from ce_gym.bench.measure.report import Report, Table, read_report
from ce_gym.console import progress

ROUNDS = ("--rounds", "3")
QUICK: dict[str, tuple[str, ...]] = {
    "instructions": (),
    "tracking": (),
    "speed": ("--quick",),
    "beside": ("--robots", "mini_cheetah", "tello", *ROUNDS),
    "growth": ("--joints", "2", "5", "10", "20", "--robots", "1", "64", "4096", *ROUNDS),
    "throughput": ROUNDS,
    "derivatives": ROUNDS,
    "stability": ("--quick",),
    "accuracy": ("--quick",),
}
"""The benchmarks, with the arguments of a short run."""
NOT_INSTALLED = 2
"""Exit status of a benchmark for which a package is missing."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, default=Path("docs/results"), metavar="FOLDER", help="where files go")
    parser.add_argument("--quick", action="store_true", help="short runs: about ten minutes instead of two hours")
    parser.add_argument("--only", nargs="+", choices=QUICK, default=list(QUICK), metavar="NAME", help=", ".join(QUICK))


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmarks and return a table of their outcomes."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in progress(arguments.only, "benchmarks"):
        start = time.perf_counter()
        outcome = run_one([name, *(QUICK[name] if arguments.quick else ())], arguments.out / f"{name}.json")
        rows.append((name, round((time.perf_counter() - start) / 60.0, 1), outcome))
    return Report("all", [Table("Benchmarks", ("benchmark", "minutes", "outcome"), tuple(rows))])


def run_one(command: list[str], file: Path) -> str:
    """Run one benchmark in a new process; return the number of met requirements, or the reason of a failure."""
    line = [sys.executable, "-m", "ce_gym.bench", *command, "--json", str(file)]
    finished = subprocess.run(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    if finished.returncode > 1 or not file.exists():
        reason = (finished.stderr.strip().splitlines() or ["no error message"])[-1]
        return f"{'skipped' if finished.returncode == NOT_INSTALLED else 'failed'}: {reason}"
    requirements = [r.met for r in read_report(file).requirements if r.met is not None]
    return f"{sum(requirements)} of {len(requirements)} requirements met"
