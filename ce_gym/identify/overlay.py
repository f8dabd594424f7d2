"""What was identified as text, and as a robot file that lays it over the one it was found for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ce_gym.identify.found import Identified
from ce_gym.model.errors import RobotError
from ce_gym.model.formats.reading import read_yaml
from ce_gym.model.table import table_text

COLUMNS = "figure", "estimate", "95 % interval", "unit"
SAID = {
    "delay": "commands reach the motors after {value:.6g} s, identified",
    "encoder_zero": "the encoder of {of} reads {value:.4g} too much beside that of its rotor, identified",
}
"""What is no figure of a robot's file, and a note in it."""


def report(found: Identified) -> str:
    """Return a table of the figures with 95 % intervals, errors, and what the data cannot tell."""
    return "\n".join([table_text(COLUMNS, rows_of(found)), "", *remarks(found)])


def rows_of(found: Identified) -> list[tuple[str, str, str, str]]:
    """Return a row of the table for each figure."""
    intervals = ["held"] * len(found.figures)
    for i in found.sought:
        intervals[i] = "{:.5g} .. {:.5g}".format(*found.intervals[i])
    return [
        (figure.name, f"{value:.5g}", interval, figure.unit)
        for figure, value, interval in zip(found.figures, found.values, intervals, strict=True)
    ]


def remarks(found: Identified) -> list[str]:
    """Return lines on errors and on what the data cannot tell."""
    error, before = (1e3 * np.sqrt((e**2).mean()) for e in (found.held_out, found.held_out_before))
    return [
        f"held-out error {error:.3g} (before: {before:.3g}), thousandths of the units of what was measured; "
        f"what is left of the fitted part is {1e3 * np.sqrt((found.noise**2).mean()):.3g}",
        f"correlation in time of what is left makes intervals {np.sqrt(found.correlation):.2f} times as long",
        *found.cannot_tell,
        f"{found.processor_time:.1f} s of processor time",
    ]


def check_base(robot: str) -> None:
    """Refuse a robot that no file can be laid over.

    Args:
        robot: Name of a robot of the package, or a path.

    Raises:
        RobotError: It is not described by a YAML file, or that has identified figures of its own.
    """
    path = Path(robot)
    if not path.suffix and ":" not in robot:
        return
    if path.suffix not in (".yaml", ".yml"):
        expected = "a robot of the package or a YAML file, such as one with `urdf: FILE` alone"
        raise RobotError(f"identify: ROBOT {robot}: expected {expected}: what is found is laid over it")
    if path.is_file() and "identified" in read_yaml(path):
        raise RobotError(f"{robot}: identified: expected a robot file without: what is found is laid over one")


def overlay(found: Identified, robot: str) -> str:
    """Return the text of a robot file.

    Args:
        found: What was identified.
        robot: Name of a robot of the package, or path of a YAML file as the new file will see it.
    """
    lines = [
        f"# Identified from {Path(found.log.source).name}; estimate and standard deviation.",
        f"robot: {json.dumps(robot)}",
    ]
    figures = [(found.figures[i], found.values[i], found.std[i]) for i in found.sought]
    notes = [SAID[f.kind].format(of=f.of, value=value) for f, value, _ in figures if f.kind in SAID]
    notes += list(found.cannot_tell)
    if notes:
        lines += ["notes:", *(f'  - "{note}"' for note in notes)]
    written = [each for each in figures if each[0].kind not in SAID]
    kinds = dict.fromkeys(figure.kind for figure, _, _ in written)
    lines.append("identified:" if kinds else "identified: {}")
    for kind in kinds:
        lines.append(f"  {kind}:")
        for figure, value, std in written:
            if figure.kind == kind:
                lines.append(f'    "{figure.of}": {value:.8g}  # +- {std:.2g} {figure.unit}')
    return "\n".join(lines) + "\n"
