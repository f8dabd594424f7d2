"""What was identified as text, and as a robot file that lays it over the one it was found for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ce_gym.identify.found import Identified
from ce_gym.model.errors import RobotError
from ce_gym.model.formats.reading import read_yaml
from ce_gym.model.table import table_text


def report(found: Identified) -> str:
    """Return a table of the figures with 95 % intervals, errors, and what the data cannot tell."""
    rows = [
        (figure.name, f"{value:.5g}", "held" if figure.name in found.held else f"{low:.5g} .. {high:.5g}", figure.unit)
        for figure, value, (low, high) in zip(found.figures, found.values, found.intervals, strict=True)
    ]
    error, before = (1e3 * np.sqrt((e**2).mean()) for e in (found.held_out, found.held_out_before))
    lines = [
        table_text(("figure", "estimate", "95 % interval", "unit"), rows),
        "",
        f"held-out error {error:.3g} (before: {before:.3g}), thousandths of the units of what was measured; "
        f"what is left of the fitted part is {1e3 * np.sqrt((found.noise**2).mean()):.3g}",
        f"correlation in time of what is left makes intervals {np.sqrt(found.correlation):.2f} times as long",
        *found.cannot_tell,
        f"{found.processor_time:.1f} s of processor time",
    ]
    return "\n".join(lines)


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
    delay = [(f, v) for f, v in zip(found.figures, found.values, strict=True) if f.kind == "delay"]
    notes = [f"commands reach the motors after {v:.6g} s, identified" for _, v in delay]
    notes += list(found.cannot_tell)
    if notes:
        lines += ["notes:", *(f'  - "{note}"' for note in notes)]
    written = [
        (figure, value, std)
        for figure, value, std in zip(found.figures, found.values, found.std, strict=True)
        if figure.kind != "delay" and figure.name not in found.held
    ]
    kinds = dict.fromkeys(figure.kind for figure, _, _ in written)
    lines.append("identified:" if kinds else "identified: {}")
    for kind in kinds:
        lines.append(f"  {kind}:")
        for figure, value, std in written:
            if figure.kind == kind:
                lines.append(f'    "{figure.of}": {value:.8g}  # +- {std:.2g} {figure.unit}')
    return "\n".join(lines) + "\n"
