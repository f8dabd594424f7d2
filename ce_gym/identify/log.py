"""Logs of commands and encoder readings, from CSV files.

    time, command:HR_hip_rotor, angle:HR_hip_rotor, speed:HR_hip_rotor, ...

`time` [s] is evenly spaced. `command:NAME` holds until the next row. `angle:NAME` [rad or m] and `speed:NAME` are
readings at the time of the row. `torque:NAME` is ignored. NAME is a joint, or the link that it moves, or a rotor.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.files import LOG, written
from ce_gym.model.errors import RobotError, file_error, printable
from ce_gym.model.formats.text_file import read_text

Array = NDArray[np.float64]
KINDS = ("command", "angle", "speed", "torque")
LARGEST_LOG = 2**30
"""Largest log [bytes]."""
SHORTEST_STEP, LONGEST_STEP = 1e-5, 0.1
"""Bounds of the time between rows [s]."""
USUAL = (1e-4, 0.1)
"""Time between rows by which the unit of other times is guessed [s]."""
UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "minutes": 60.0}
"""Other units of time [s]."""
JITTER = 0.1
"""Largest deviation of the time between rows from its median, relative to the median."""


class LogError(RobotError):
    """An unusable log; the message is one line with file, column and row."""


@dataclass(frozen=True)
class Log:
    """Commands and measurements, evenly spaced in time.

    Attributes:
        dt: Time from row to row [s].
        commanded: Joint or rotor of each command.
        commands: Commands, shape (T, n_commands) [rad, m, N m or N].
        measured: Pairs ("angle" or "speed", joint or rotor), one for each measurement.
        values: Measurements, shape (T, n_measured) [rad, m, rad/s or m/s].
        source: Name of the file, for messages.
    """

    dt: float
    commanded: tuple[str, ...]
    commands: Array
    measured: tuple[tuple[str, str], ...]
    values: Array
    source: str = "log"

    def of_links(self, links: Mapping[str, str]) -> Log:
        """Return the log with links as names; `links` has the link that each joint moves, by the joint's name."""
        commanded = tuple(links.get(name, name) for name in self.commanded)
        measured = tuple((kind, links.get(name, name)) for kind, name in self.measured)
        return replace(self, commanded=commanded, measured=measured)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the log to a CSV file; return its path."""
        names = [f"command:{name}" for name in self.commanded] + [f"{kind}:{name}" for kind, name in self.measured]
        rows = np.column_stack([np.arange(len(self.values)) * self.dt, self.commands, self.values])
        header = ",".join(["time", *names])
        with written(path, LOG) as file:
            np.savetxt(file, rows, fmt="%.9g", delimiter=",", header=header, comments="")
        return Path(path)


def read_log(path: str | os.PathLike[str]) -> Log:
    """Read a log.

    Args:
        path: A CSV file.

    Raises:
        LogError: The file is missing, or a column or a row is wrong.
    """
    file = str(path)
    try:
        lines = read_text(Path(path), "a CSV file", LARGEST_LOG).splitlines()
    except RobotError as error:
        raise LogError(str(error)) from None
    rows = csv.reader(lines)
    try:
        header = [cell.strip().lstrip("\ufeff") for cell in next(rows, [])]
    except csv.Error as error:
        raise file_error(file, f"row 1: {error}", "names of columns, separated by commas", LogError) from None
    kinds = _kinds(file, header)
    table = _numbers(file, header, rows)
    dt = _spacing(file, table[:, kinds.index(("time", ""))])
    commands = [i for i, (kind, _) in enumerate(kinds) if kind == "command"]
    measured = [i for i, (kind, _) in enumerate(kinds) if kind in ("angle", "speed")]
    names = tuple(kinds[i][1] for i in commands)
    return Log(dt, names, table[:, commands], tuple(kinds[i] for i in measured), table[:, measured], file)


def _kinds(file: str, header: list[str]) -> list[tuple[str, str]]:
    """Return kind and name of each column."""
    kinds = []
    for i, column in enumerate(header):
        kind, colon, name = column.partition(":")
        if column != "time" and not (colon and name and kind in KINDS):
            expected = "time, or command:, angle:, speed: or torque: and the name of a joint or rotor"
            raise file_error(file, f"column {i + 1} is {column[:60]!r}", expected, LogError)
        if column in header[:i]:
            raise file_error(file, f"column {i + 1} is {printable(column)} again", "each column once", LogError)
        kinds.append((kind, name))
    present = {kind for kind, _ in kinds}
    for kind, column in (("time", "time"), ("command", "command:NAME"), ("angle", "angle:NAME")):
        if kind not in present:
            expected = "a header such as time,command:NAME,angle:NAME"
            raise file_error(file, f"no column {column}", expected, LogError)
    return kinds


def _numbers(file: str, header: list[str], rows: csv.reader) -> Array:  # type: ignore[valid-type]
    """Return the rows below the header as numbers."""
    table = []
    try:
        for row in filter(None, rows):
            if len(row) != len(header):
                raise file_error(file, f"row {rows.line_num} has {len(row)} cells", f"{len(header)}", LogError)
            table.append([_number(file, rows.line_num, *pair) for pair in zip(header, row, strict=True)])
    except csv.Error as error:
        problem = f"row {rows.line_num}: {error}"
        raise file_error(file, problem, "commas between numbers", LogError) from None
    if len(table) < 100:
        raise file_error(file, f"{len(table)} rows", "at least 100", LogError)
    return np.array(table)


def _number(file: str, row: int, column: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        problem = f"row {row}, column {printable(column)} is {cell[:40]!r}"
        raise file_error(file, problem, "a finite number", LogError)
    return number


def _spacing(file: str, time: Array) -> float:
    steps = np.diff(time)
    dt = float(np.median(steps))
    wrong = np.flatnonzero(np.abs(steps - dt) > JITTER * abs(dt)) if dt > 0 else np.flatnonzero(steps <= 0)
    if wrong.size:
        k = int(wrong[0])
        expected = f"evenly spaced rows, {dt:.6g} s apart" if dt > 0 else "increasing times"
        raise file_error(file, f"row {k + 3}, column time is {time[k + 1]:.9g}", expected, LogError)
    if not SHORTEST_STEP <= dt <= LONGEST_STEP:
        guess = next((f", not in {unit}" for unit, one in UNITS.items() if USUAL[0] <= dt * one <= USUAL[1]), "")
        expected = f"time in seconds{guess}, rows {SHORTEST_STEP:g} to {LONGEST_STEP:g} s apart"
        raise file_error(file, f"column time has rows {dt:.6g} apart", expected, LogError)
    return float((time[-1] - time[0]) / len(steps))
