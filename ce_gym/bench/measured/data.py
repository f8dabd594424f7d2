"""Measurements in `docs/data/measured`, checked against their checksums."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.errors import RobotError

FOLDER = Path(__file__).parents[3] / "docs" / "data" / "measured"
CHECKSUMS = {
    "cube_tosses.npz": "388026a2abc48b161005fd00ac2c0312ff28bb293b6e4a015d30bb188aec62a2",
    "go2_joint_log.npz": "d580ffb8ce2d9ed42dc3eb4111b1479c7a7e7f799c1527ac506be795152c0ff8",
}
"""SHA-256 of each file."""
RESAMPLES = 2000
"""Number of bootstrap samples."""


def load(name: str, folder: Path = FOLDER) -> dict[str, NDArray]:
    """Return the arrays of a file of measurements.

    Raises:
        RobotError: The file is missing or differs from the published one.
    """
    file = folder / name
    if not file.exists():
        raise RobotError(f"{file} is missing; expected a checkout of the repository")
    checksum = hashlib.sha256(file.read_bytes()).hexdigest()
    if checksum != CHECKSUMS[name]:
        raise RobotError(f"{file} has SHA-256 {checksum}; expected {CHECKSUMS[name]}: restore the file")
    with np.load(file) as arrays:
        return dict(arrays)


def interval(statistic, *samples: NDArray, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of a statistic of paired samples, drawn along their first axis."""
    n = len(samples[0])
    drawn = np.random.default_rng(seed).integers(n, size=(RESAMPLES, n))
    values = [statistic(*(sample[rows] for sample in samples)) for rows in drawn]
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
