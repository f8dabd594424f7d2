"""What a study trains and how it evaluates, read from a file in `studies/`, and the rows of finished runs."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from run_folder import write_whole

from ce_gym.policies import parse_yaml

Row = dict[str, str]

RUN = ("task", "arm", "seed", "steps", "processor [s]")
"""Columns that say what a run was, time since it was last gone on with; those of figures follow, `where: figure`."""


@dataclass(frozen=True)
class Trial:
    """A task of a study: the environment, how long to train, what decides, of which more is better, and is reported."""

    env: str
    steps: float
    decides: str
    metrics: list[str]
    motors: list[str]
    seconds: float

    @property
    def figures(self) -> list[str]:
        """Names of all that is reported, the one that decides first."""
        return list(dict.fromkeys([self.decides, *self.metrics, "falls", "reward", *self.motors]))


@dataclass(frozen=True)
class Arm:
    """A way to train: arguments of the environment, those for training only, and its turn: 0 is made before 1."""

    env_args: dict[str, Any]
    training: dict[str, Any]
    turn: int


@dataclass(frozen=True)
class Judged:
    """A way to judge: arguments of the environment that replace those of training, episodes, robots for motors.

    What `decides` is what arms lose against the first one in the ways of judging that say so.
    """

    env_args: dict[str, Any]
    episodes: int
    robots: int
    decides: bool


@dataclass(frozen=True)
class Study:
    """What is trained, and how it is judged; see the files in `studies/`."""

    seeds: list[int]
    tasks: dict[str, Trial]
    arms: dict[str, Arm]
    judged: dict[str, Judged]

    @property
    def columns(self) -> list[str]:
        """Of the table of all runs."""
        figures = dict.fromkeys(name for task in self.tasks.values() for name in task.figures)
        return [*RUN, *(f"{where}: {name}" for where in self.judged for name in figures)]

    def runs(self) -> Iterator[tuple[str, str, int]]:
        """Task, arm and seed of all runs, in the order in which they are made."""
        keys = ((task, arm, seed) for seed in self.seeds for task in self.tasks for arm in self.arms)
        return iter(sorted(keys, key=lambda key: self.arms[key[1]].turn))


def read_study(file: Path) -> Study:
    """Read a study.

    Raises:
        ValueError: If a key is missing or unknown.
    """
    data = parse_yaml(file.read_text(encoding="utf-8"))
    parts = {"tasks": Trial, "arms": Arm, "judged": Judged}
    for name, kind in parts.items():
        data[name] = {key: _made(kind, value, f"{file}: {name}: {key}") for key, value in data[name].items()}
    return _made(Study, data, str(file))


def _made(kind: Any, data: Mapping[str, Any], source: str) -> Any:
    expected = {field.name for field in fields(kind)}
    if wrong := expected.symmetric_difference(data):
        raise ValueError(f"{source}: {min(wrong)}: expected {', '.join(sorted(expected))} and nothing else")
    return kind(**data)


def read_rows(file: Path, study: Study) -> list[Row]:
    """Return the rows of runs that are done; none if there is no such file.

    Raises:
        ValueError: If they are of another study.
    """
    if not file.exists():
        return []
    with file.open(newline="", encoding="utf-8") as lines:
        reader = csv.DictReader(lines)
        rows = list(reader)
    if reader.fieldnames != study.columns:
        raise ValueError(f"{file}: has other columns than the study; expected {', '.join(study.columns)[:200]} ...")
    return rows


def write_rows(file: Path, study: Study, rows: list[Row]) -> None:
    """Write all rows, or none.

    Raises:
        OSError: If they cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, study.columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole({file: text.getvalue().encode()})
