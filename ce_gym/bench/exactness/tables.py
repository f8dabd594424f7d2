"""Tables of the studies: percentiles over poses, and figures to six digits, so that files stay small and comparable."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ce_gym.bench.exactness.protocol import Array
from ce_gym.bench.measure.report import Cell, Table

DIGITS = 6


def spread(x: Array) -> tuple[float, float, float]:
    """Return percentiles 5, 50 and 95."""
    low, middle, high = np.percentile(x, (5, 50, 95))
    return float(low), float(middle), float(high)


def table(title: str, columns: tuple[str, ...], rows: Iterable[tuple[Cell, ...]]) -> Table:
    """Return a table whose figures have six digits."""
    return Table(title, columns, tuple(tuple(_short(cell) for cell in row) for row in rows))


def _short(cell: Cell) -> Cell:
    return float(f"{cell:.{DIGITS}g}") if isinstance(cell, float) else cell
