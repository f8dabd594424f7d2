"""Writers of learning curves for other programs: TensorBoard, Weights & Biases, trackio."""

from __future__ import annotations

import importlib
import importlib.util
import numbers
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

PROJECT = "ce_gym"
"""Name of the project at Weights & Biases and trackio; a run has the name of its folder."""


class Writer(Protocol):
    """Receives the statistics of each iteration."""

    def write(self, figures: Mapping[str, float], steps: int) -> None:
        """Add figures by name at a number of environment steps."""
        ...

    def close(self) -> None:
        """End the run."""
        ...


class TensorBoard:
    """Writes an event file into the folder of a run."""

    def __init__(self, folder: Path, _settings: Mapping[str, Any]) -> None:
        from tensorboard.compat.proto.event_pb2 import Event  # type: ignore[attr-defined]
        from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[attr-defined]
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        self._event, self._summary = Event, Summary
        self._file = EventFileWriter(str(folder))

    def write(self, figures: Mapping[str, float], steps: int) -> None:
        """See `Writer`."""
        values = [self._summary.Value(tag=name, simple_value=figure) for name, figure in figures.items()]
        summary = self._summary(value=values)
        self._file.add_event(self._event(wall_time=time.time(), step=steps, summary=summary))

    def close(self) -> None:
        """See `Writer`."""
        self._file.close()


class Tracker:
    """Sends figures to a package with the functions `init`, `log` and `finish` of Weights & Biases."""

    def __init__(self, package: str, folder: Path, settings: Mapping[str, Any]) -> None:
        self._package: Any = importlib.import_module(package)
        self._package.init(project=PROJECT, name=folder.name, config=dict(settings))

    def write(self, figures: Mapping[str, float], steps: int) -> None:
        """See `Writer`."""
        self._package.log(dict(figures), step=steps)

    def close(self) -> None:
        """See `Writer`."""
        self._package.finish()


LOGS = ("tensorboard", "wandb", "trackio")
"""Packages that `--log` names."""


def default_logs() -> tuple[str, ...]:
    """Return "tensorboard" if that is installed, otherwise nothing."""
    return LOGS[:1] if importlib.util.find_spec(LOGS[0]) else ()


def open_writers(names: Sequence[str], folder: Path, settings: Mapping[str, Any]) -> list[Writer]:
    """Return the writers of a run.

    Args:
        names: Some of `LOGS`.
        folder: Folder of the run.
        settings: Settings of the run, as plain data.

    Raises:
        ModuleNotFoundError: If a package is not installed.
    """
    return [TensorBoard(folder, settings) if name == LOGS[0] else Tracker(name, folder, settings) for name in names]


def numbers_of(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers in a row of a log by name."""
    return {name: float(x) for name, x in row.items() if isinstance(x, numbers.Real) and not isinstance(x, bool)}
