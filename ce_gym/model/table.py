"""Aligned plain-text tables for people to read in a terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

Cell = str | int | float | None


def cell_text(cell: Cell) -> str:
    """Return one cell: four significant digits for a float, empty for None."""
    if cell is None:
        return ""
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def table_text(
    columns: Sequence[str],
    rows: Sequence[Sequence[Cell]],
    indent: str = "  ",
    text: Callable[[Any], str] = cell_text,
) -> str:
    """Return rows under headings: words to the left, columns of numbers to the right.

    Args:
        columns: Headings.
        rows: One cell for each column.
        indent: What every line starts with.
        text: How a cell is written.
    """
    cells = [[text(cell) for cell in row] for row in rows]
    widths = [max(len(line[i]) for line in [columns, *cells]) for i in range(len(columns))]
    right = [not any(isinstance(row[i], str) for row in rows) for i in range(len(columns))]

    def line(row: Sequence[str]) -> str:
        aligned = [x.rjust(w) if r else x.ljust(w) for x, w, r in zip(row, widths, right, strict=True)]
        return (indent + "  ".join(aligned)).rstrip()

    return "\n".join([line(columns), line(["-" * width for width in widths]), *map(line, cells)])
