"""The command `python -m ce_gym.bench`: lists the benchmarks, or runs one and prints its report.

A benchmark is a module of this package or of a subpackage, or the module `benchmark` of a subpackage. It has the
functions `add_arguments(parser)` and `run(arguments) -> Report`, and the first line of its docstring is its entry in
the list. Only the selected benchmark is imported.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from ce_gym.console import Parser, print_anything
from ce_gym.model import RobotError, load_robot
from ce_gym.model.errors import listed_names

BENCHMARKS = (
    "speed", "beside", "instructions", "throughput", "tracking", "stability", "accuracy", "derivatives",
    "dynamics", "growth", "cube", "go2_log", "gpu", "digests", "all",
)  # fmt: skip


HERE = Path(__file__).parent


def benchmark_file(name: str) -> Path:
    """Return the file of a benchmark."""
    candidates = (HERE / f"{name}.py", HERE / name / "benchmark.py", *HERE.glob(f"*/{name}.py"))
    return next(path for path in candidates if path.exists())


def summary(name: str) -> str:
    """Return the first docstring line of a benchmark, without importing it."""
    source = benchmark_file(name).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").splitlines()[0]


def load(name: str) -> ModuleType:
    """Import a benchmark."""
    return importlib.import_module(
        ".".join(("ce_gym.bench", *benchmark_file(name).relative_to(HERE).with_suffix("").parts))
    )


def listing() -> str:
    """Return one line for each benchmark."""
    width = max(len(name) for name in BENCHMARKS)
    lines = [f"  {name:<{width}}  {summary(name)}" for name in BENCHMARKS]
    return "\n".join(["Usage: python -m ce_gym.bench NAME [--help] [--json FILE]", "", *lines])


def _check_robots(arguments: argparse.Namespace) -> None:
    """Check the names of robots before the measurement.

    Raises:
        RobotError: If there is no such robot.
    """
    for option in ("robot", "robots"):
        names = getattr(arguments, option, None) or ()
        for name in [names] if isinstance(names, str) else names:
            if isinstance(name, str):  # some benchmarks take numbers of robots
                load_robot(name)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    print_anything()
    argv = sys.argv[1:] if argv is None else list(argv)
    if not argv or argv[0] in ("-h", "--help"):
        print(listing())
        return 0
    name, *rest = argv
    if name not in BENCHMARKS:
        print(f"ce_gym.bench: no benchmark {name!r}; expected one of {listed_names(name, BENCHMARKS)}", file=sys.stderr)
        return 2
    json_option = Parser(add_help=False)
    json_option.add_argument("--json", metavar="FILE", help="also write the report to a JSON file")
    parser = Parser(prog=f"python -m ce_gym.bench {name}", description=summary(name), parents=[json_option])
    try:
        benchmark = load(name)
        benchmark.add_arguments(parser)
        arguments = parser.parse_args(rest)
        _check_robots(arguments)
        report = benchmark.run(arguments)
    except RobotError as error:
        print(f"ce_gym.bench: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        if str(error.name).startswith("ce_gym"):
            raise
        missing = f"{name} needs {error.name}, which is not installed"
        print(f'ce_gym.bench: {missing}: pip install "ce_gym[bench]"', file=sys.stderr)
        return 2
    words = json_option.parse_known_args(rest)[1]
    report.command = shlex.join(["python", "-m", "ce_gym.bench", name, *words])
    print(report.as_text())
    if arguments.json:
        Path(arguments.json).write_text(report.as_json(), encoding="utf-8")
    return int(report.failed)


if __name__ == "__main__":
    sys.exit(main())
