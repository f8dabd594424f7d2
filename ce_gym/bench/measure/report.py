"""Report of a benchmark: tables, requirements, remarks and machine, as text and as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

from ce_gym.bench.measure import machine
from ce_gym.model.table import Cell, table_text


@dataclass(frozen=True)
class Table:
    """A table of results.

    Attributes:
        title: Title of the table.
        columns: Headings, with units.
        rows: One cell for each column; numbers are kept as numbers for JSON.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def as_text(self) -> str:
        """Return the table with aligned columns: text left, numbers right."""
        return f"{self.title}\n\n{table_text(self.columns, self.rows, indent='', text=cell_text)}"


@dataclass(frozen=True)
class Requirement:
    """A requirement on a measured value.

    Attributes:
        claim: The requirement in words, with the required value.
        measured: The measured value.
        met: Whether the requirement is met; None without a measurement.
    """

    claim: str
    measured: str
    met: bool | None

    @property
    def verdict(self) -> str:
        """Return the result in one word."""
        return "none" if self.met is None else "met" if self.met else "MISSED"


@dataclass
class Report:
    """Tables, requirements and remarks of one run; if `failed`, the exit status is 1."""

    name: str
    tables: list[Table] = field(default_factory=list)
    requirements: list[Requirement] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    failed: bool = False
    machine: dict[str, str] = field(default_factory=machine.describe)
    command: str = ""

    def as_text(self) -> str:
        """Return the report as plain text."""
        parts = ["\n".join(f"{key:>10}: {value}" for key, value in self.machine.items())]
        parts += [table.as_text() for table in self.tables]
        if self.requirements:
            parts.append("\n".join(f"{r.verdict:6}  {r.claim}: {r.measured}" for r in self.requirements))
        parts += self.remarks
        return "\n\n".join(parts)

    def as_json(self) -> str:
        """Return the report as JSON."""
        content = {
            "name": self.name,
            "command": self.command,
            "commit": machine.commit(),
            "machine": self.machine,
            "tables": [{"title": t.title, "columns": t.columns, "rows": t.rows} for t in self.tables],
            "requirements": [vars(r) for r in self.requirements],
            "remarks": self.remarks,
        }
        return json.dumps(content, indent=2, default=lambda scalar: scalar.item()) + "\n"  # numpy scalars


def read_report(file: Path) -> Report:
    """Return the report in a JSON file."""
    content = json.loads(file.read_text(encoding="utf-8"))
    tables = [Table(t["title"], tuple(t["columns"]), tuple(map(tuple, t["rows"]))) for t in content["tables"]]
    requirements = [Requirement(**requirement) for requirement in content["requirements"]]
    remarks, command = content["remarks"], content["command"]
    return Report(content["name"], tables, requirements, remarks, machine=content["machine"], command=command)


def cell_text(cell: Cell) -> str:
    """Return a cell as text: four significant digits for a float, an empty string for None."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        return f"{cell:.4g}" if abs(cell) < 1e4 or cell != cell else f"{cell:,.0f}"
    return f"{cell:,}" if isinstance(cell, int) else cell
