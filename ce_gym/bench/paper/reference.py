"""Instruction counts of other people's algorithms on the paper's systems, read from `data/`, which cites sources."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from importlib.resources import files


@dataclass(frozen=True)
class ChainReference:
    """Counts for one scaling chain, None where nobody counted.

    Attributes:
        chain: Name of the rule that makes it.
        branches: Number of branches; None for parallel chains.
        depth: Units in each branch, or links in each parallel chain.
        loop_size: Bodies tied together; None for branched chains.
        ce_aba: The paper authors' constraint-embedding articulated-body algorithm.
        approximate: Their articulated-body algorithm with rotors or loops deleted.
        proximal: Pinocchio's proximal and sparse forward dynamics.
        lagrange: The paper authors' dense Lagrange multipliers.
    """

    chain: str
    branches: int | None
    depth: int
    loop_size: int | None
    ce_aba: int
    approximate: int | None
    proximal: int | None
    lagrange: int | None


@dataclass(frozen=True)
class RobotReference:
    """Counts for one robot, None where nobody counted.

    Attributes:
        ce_aba: The paper authors' constraint-embedding articulated-body algorithm.
        approximate: Their articulated-body algorithm with rotors deleted.
        proximal: Pinocchio's proximal and sparse forward dynamics.
        paper_saving: How much less the approximate algorithm takes, as printed in the paper [%].
    """

    ce_aba: int
    approximate: int | None
    proximal: int | None
    paper_saving: float | None


def chain_references() -> list[ChainReference]:
    """Return the counts of every chain on file."""
    return [
        ChainReference(
            row["chain"],
            _whole(row["branches"]),
            int(row["depth"]),
            _whole(row["loop_size"]),
            int(row["ce_aba"]),
            _whole(row["approximate"]),
            _whole(row["proximal"]),
            _whole(row["lagrange"]),
        )
        for row in _rows("paper_chains.csv")
    ]


def robot_references() -> dict[str, RobotReference]:
    """Return the counts of every robot on file, by name."""
    return {
        row["robot"]: RobotReference(
            int(row["ce_aba"]),
            _whole(row["approximate"]),
            _whole(row["proximal"]),
            float(row["paper_saving"]) if row["paper_saving"] else None,
        )
        for row in _rows("paper_robots.csv")
    }


def _rows(name: str) -> list[dict[str, str]]:
    text = (files("ce_gym.bench.paper") / "data" / name).read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


def _whole(cell: str) -> int | None:
    return int(cell) if cell else None
