"""Digests of results of models, simulators and environments, to compare bits between versions and machines.

`--out` writes a record. `--against` compares with a record and reports the size of differences. A record has a row for
each robot, level, precision and variation. A row has a hash of the bytes, the sum and some numbers of each array.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.digests.cases import KINDS, Case, cases
from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.console import progress
from ce_gym.model import robots

SAMPLES = 16
"""Numbers of each array that a record contains."""
Rows = dict[str, dict[str, Any]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--quick", action="store_true", help="exact level, one environment, few variations: 2 minutes")
    parser.add_argument("--robots", nargs="+", default=robots(), choices=robots(), metavar="NAME", help="which robots")
    parser.add_argument("--only", nargs="+", default=list(KINDS), choices=KINDS, help="which kinds of rows")
    parser.add_argument("--out", type=_new_file, metavar="FILE", help="write the record to a JSON file")
    parser.add_argument(
        "--against", type=_record, metavar="FILE", help="compare with a record; exit code 1 if a row differs"
    )


def run(arguments: argparse.Namespace) -> Report:
    """Record, write and compare."""
    chosen = cases(arguments.robots, arguments.only, arguments.quick)
    rows = {case.key: row(case) for case in progress(chosen, "digests")}
    report = Report("digests")
    if arguments.out:
        record = {"machine": report.machine, "rows": rows}
        arguments.out.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    if arguments.against:
        compare(arguments.against, rows, report)
    else:
        short = tuple((key, combined(arrays)) for key, arrays in rows.items())
        report.tables.append(Table("Digests", ("what", "digest"), short))
    return report


def row(case: Case) -> dict[str, Any]:
    """Return the row of a case: digest, sum and samples of each array by name."""
    return {name: fingerprint(array) for name, array in case.arrays().items()}


def fingerprint(array: NDArray) -> dict[str, Any]:
    """Return the digest of an array's type, shape and bytes, the sum of its numbers, and samples."""
    plain = np.ascontiguousarray(array)
    text = f"{plain.dtype.name} {plain.shape} ".encode()
    numbers = plain.astype(float).ravel()
    places = np.linspace(0, max(numbers.size - 1, 0), min(SAMPLES, numbers.size)).astype(int)
    return {
        "digest": hashlib.sha256(text + plain.tobytes()).hexdigest()[:16],
        "sum": math.fsum(numbers[np.isfinite(numbers)]),
        "samples": numbers[places].tolist(),
    }


def combined(arrays: Mapping[str, Any]) -> str:
    """Return one digest for all arrays of a row."""
    return hashlib.sha256("".join(part["digest"] for part in arrays.values()).encode()).hexdigest()[:16]


def compare(record: Rows, rows: Rows, report: Report) -> None:
    """Add the differences from a record, and the requirement of equality, to the report."""
    common = [key for key in rows if key in record]
    different = [line for key in common for line in differences(key, record[key], rows[key])]
    if different:
        columns = ("what", "array", "largest difference of samples", "difference of sums")
        report.tables.append(Table("Differences", columns, tuple(different)))
    changed = len({line[0] for line in different})
    claim = "every row has the bits of the record"
    report.requirements.append(Requirement(claim, f"{changed} of {len(common)} differ", bool(common) and not changed))
    if missing := [key for key in rows if key not in record]:
        report.remarks.append(f"Not in the record: {', '.join(missing)}")
    report.failed = changed > 0 or not common


def differences(key: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, str, float, float]]:
    """Yield a line for each array that differs: row, array, largest difference of samples and sums."""
    nothing = {"digest": "", "sum": math.nan, "samples": []}
    for name in sorted({*old, *new}):
        one, other = old.get(name, nothing), new.get(name, nothing)
        if one["digest"] != other["digest"]:
            same_length = len(one["samples"]) == len(other["samples"]) > 0
            apart = np.abs(np.subtract(one["samples"], other["samples"])).max() if same_length else math.nan
            yield key, name, float(apart), abs(one["sum"] - other["sum"])


def _new_file(text: str) -> Path:
    path = Path(text)
    if not path.parent.is_dir() or path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r}: expected a file in a folder that exists")
    return path


def _record(text: str) -> Rows:
    try:
        rows = json.loads(Path(text).read_text(encoding="utf-8"))["rows"]
        return {key: {name: _part(part) for name, part in parts.items()} for key, parts in rows.items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        raise argparse.ArgumentTypeError(f"{text!r}: expected a JSON file written by --out") from None


def _part(part: Mapping[str, Any]) -> dict[str, Any]:
    return {"digest": str(part["digest"]), "sum": float(part["sum"]), "samples": [float(x) for x in part["samples"]]}
