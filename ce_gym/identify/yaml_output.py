"""The result of an identification as text, and as a YAML file on top of the original robot file."""

from __future__ import annotations

import json
from itertools import groupby
from pathlib import Path

import numpy as np

from ce_gym.identify.result import Identified
from ce_gym.model.errors import file_error
from ce_gym.model.formats.reading import read_yaml
from ce_gym.model.table import table_text

COLUMNS = "parameter", "estimate", "95 % interval", "unit"
NOTES = {
    "delay": "commands reach the motors after {value:.6g} s, identified",
    "encoder_zero": "the encoder of {element} reads {value:.4g} too much relative to its rotor's encoder, identified",
}
"""Notes on the parameters that a robot file does not have."""


def report(result: Identified) -> str:
    """Return a table of the estimates with 95 % intervals, validation errors and warnings, as plain text."""
    return "\n".join([table_text(COLUMNS, table_rows(result)), "", *remarks(result)])


def table_rows(result: Identified) -> list[tuple[str, str, str, str]]:
    """Return a row of the table for each parameter."""
    intervals = ["held"] * len(result.parameters)
    for i in result.estimated:
        intervals[i] = "{:.5g} .. {:.5g}".format(*result.intervals[i])
    return [
        (parameter.name, f"{value:.5g}", interval, parameter.unit)
        for parameter, value, interval in zip(result.parameters, result.values, intervals, strict=True)
    ]


def remarks(result: Identified) -> list[str]:
    """Return lines on validation errors and correlation, and all warnings."""
    after, before, residual = (
        1e3 * np.sqrt((e**2).mean()) for e in (result.held_out, result.held_out_before, result.noise)
    )
    return [
        f"held-out error {after:.3g} (before: {before:.3g}), in thousandths of the units of the measurements; "
        f"residual of the fitted part {residual:.3g}",
        f"correlation of residuals in time makes intervals {np.sqrt(result.correlation):.2f} times as long",
        *result.warnings,
        f"{result.processor_time:.1f} s of processor time",
    ]


def check_base(robot: str) -> None:
    """Check that a robot file can refer to a robot.

    Args:
        robot: Name of a robot of the package, or a path.

    Raises:
        RobotError: The robot has no YAML file, or its YAML file has identified parameters already.
    """
    path = Path(robot)
    if not path.suffix and ":" not in robot:
        return
    if path.suffix not in (".yaml", ".yml"):
        expected = "a robot of the package or a YAML file, such as one with only `urdf: FILE`"
        raise file_error("identify", f"ROBOT {robot}", expected)
    if path.is_file() and "identified" in read_yaml(path):
        raise file_error(robot, "identified", "a robot file without identified parameters")


def to_yaml(result: Identified, robot: str) -> str:
    """Return the text of a robot file with the estimates, on top of the original robot.

    Args:
        result: The result of the identification.
        robot: Name of a robot of the package, or path of its YAML file relative to the new file.
    """
    lines = [
        f"# Identified from {Path(result.log.source).name}; estimate and standard deviation.",
        f"robot: {json.dumps(robot)}",
    ]
    estimates = [(result.parameters[i], result.values[i], result.std[i]) for i in result.estimated]
    notes = [NOTES[p.kind].format(element=p.element, value=value) for p, value, _ in estimates if p.kind in NOTES]
    notes += list(result.warnings)
    if notes:
        lines += ["notes:", *(f'  - "{note}"' for note in notes)]
    entries = [estimate for estimate in estimates if estimate[0].kind not in NOTES]
    lines.append("identified:" if entries else "identified: {}")
    for kind, of_kind in groupby(entries, lambda entry: entry[0].kind):
        lines.append(f"  {kind}:")
        lines += [f'    "{p.element}": {value:.8g}  # +- {std:.2g} {p.unit}' for p, value, std in of_kind]
    return "\n".join(lines) + "\n"
