"""Learning curves for other programs: TensorBoard, Weights & Biases, trackio."""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

LOGS = ("tensorboard", "wandb", "trackio")
"""Packages that `--logs` names."""

PROJECT = "ce_gym"
"""Name of the project at Weights & Biases and trackio; a run has the name of its folder."""


class TensorBoard:
    """An event file in a folder, with the functions `log` and `finish` of Weights & Biases."""

    def __init__(self, folder: Path) -> None:
        from tensorboard.compat.proto.event_pb2 import Event  # type: ignore[attr-defined]
        from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[attr-defined]
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        self._event, self._summary, self._file = Event, Summary, EventFileWriter(str(folder))

    def log(self, figures: Mapping[str, float], step: int) -> None:
        """Add figures by name at a number of environment steps."""
        values = [self._summary.Value(tag=name, simple_value=figure) for name, figure in figures.items()]
        self._file.add_event(self._event(wall_time=time.time(), step=step, summary=self._summary(value=values)))

    def finish(self) -> None:
        """Close the file."""
        self._file.close()


def default_logs() -> tuple[str, ...]:
    """Return "tensorboard" if that is installed, otherwise nothing."""
    return LOGS[:1] if importlib.util.find_spec(LOGS[0]) else ()


def open_trackers(names: Sequence[str], folder: Path, settings: Mapping[str, Any]) -> list[Any]:
    """Return objects with the functions `log(figures, step)` and `finish()` of Weights & Biases.

    Args:
        names: Some of `LOGS`.
        folder: Folder of the run.
        settings: Settings of the run, as plain data.

    Raises:
        ModuleNotFoundError: If a package is not installed.
    """
    trackers: list[Any] = [TensorBoard(folder) if name == LOGS[0] else importlib.import_module(name) for name in names]
    for tracker in trackers:
        if not isinstance(tracker, TensorBoard):
            tracker.init(project=PROJECT, name=folder.name, config=dict(settings))
    return trackers
