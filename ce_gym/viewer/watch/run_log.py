"""Logs of training runs: finds the folders of runs and reads their signals over the steps."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.viewer.errors import ViewerError

Array = NDArray[np.float64]

LOG = "progress.csv"
STEPS, SECONDS = "time/total_timesteps", "time/time_elapsed"
MOST_BYTES, MOST_COLUMNS = 2**26, 500
REWARD, LENGTH, SPEED = "reward of an episode", "length of an episode [steps]", "speed of training [steps/s]"
TERM = "reward: "
NAMES = {"rollout/ep_rew_mean": REWARD, "rollout/ep_len_mean": LENGTH}
GROUPS = {"reward": TERM, "metrics": "", "train": "learning: "}


@dataclass(frozen=True)
class RunLog:
    """Signals of a training run.

    Attributes:
        name: Name of the run's folder.
        steps: Environment steps, shape (n,).
        seconds: Duration of the training [s].
        signals: By name, each shape (n,); NaN for missing values.
    """

    name: str
    steps: Array
    seconds: float
    signals: Mapping[str, Array]

    def thinned(self, most: int) -> RunLog:
        """Return the log with at most `most` rows: means over neighbours, at the last step of each."""
        count = len(self.steps)
        if count <= most:
            return self
        starts = np.unique(np.arange(most) * count // most)
        ends = np.append(starts[1:], count) - 1
        signals = {name: _block_means(values, starts) for name, values in self.signals.items()}
        return RunLog(self.name, self.steps[ends], self.seconds, signals)


def find_runs(folder: Path) -> list[Path]:
    """Return the folder itself if it has a log, otherwise its subfolders with a log, by name.

    Raises:
        ViewerError: There is no log.
    """
    if not folder.is_dir():
        raise ViewerError(f"{folder}: no such folder; expected the folder of a training run")
    subfolders = sorted(run for run in folder.iterdir() if (run / LOG).is_file())
    runs = [folder] if (folder / LOG).is_file() else subfolders
    if not runs:
        raise ViewerError(f"{folder}: no {LOG} in it or in its subfolders; expected the folder of a training run")
    return runs


def read_log(run: Path) -> RunLog:
    """Return the log of a run, which may still be training.

    Raises:
        ViewerError: A file is not the log of a training run.
    """
    columns = _table(run / LOG)
    if columns and STEPS not in columns:
        raise ViewerError(f"{run / LOG}: expected a column {STEPS}, as in the log of a training run")
    steps = columns.get(STEPS, np.zeros(0))
    seconds = columns.get(SECONDS, np.full(len(steps), np.nan))
    signals = {_signal_name(name): values for name, values in columns.items() if not name.startswith("time/")}
    if len(steps) > 1:
        signals[SPEED] = _speed(steps, seconds)
    return RunLog(run.resolve().name, steps, float(np.nanmax(seconds, initial=0.0)), signals)


def _table(file: Path) -> dict[str, Array]:
    """Return the columns of a CSV file of numbers; a missing or empty file has no columns.

    Raises:
        ViewerError: The file is not a CSV file of numbers, or too large.
    """
    try:
        if file.stat().st_size > MOST_BYTES:
            raise ViewerError(f"{file}: {file.stat().st_size} bytes; expected at most {MOST_BYTES}")
        text = file.read_text(encoding="utf-8")
        header, *rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines())) or [[]]  # whole lines only
        if len(header) > MOST_COLUMNS:
            raise ViewerError(f"{file}: {len(header)} columns; expected at most {MOST_COLUMNS}")
        values = [[float(cell or "nan") for cell in row] for row in rows if len(row) == len(header)]
    except FileNotFoundError:
        return {}
    except (ValueError, csv.Error) as error:
        raise ViewerError(f"{file}: expected a CSV file of numbers: {' '.join(str(error).split())[:100]}") from None
    table = np.array(values, float).reshape(len(values), len(header))
    return dict(zip(header, table.T, strict=True))


def _signal_name(column: str) -> str:
    group, _, name = column.rpartition("/")
    return NAMES.get(column) or GROUPS.get(group, f"{group}: " if group else "") + name.replace("_", " ")


def _speed(steps: Array, seconds: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = np.diff(steps) / np.diff(seconds)
    speed[~np.isfinite(speed)] = np.nan  # Stable-Baselines3 logs whole seconds
    return np.append(speed[:1], speed)


def _block_means(values: Array, starts: NDArray[np.int64]) -> Array:
    """Return the mean of the finite values of each block that begins at `starts`, NaN for a block without."""
    finite = np.isfinite(values)
    counts = np.add.reduceat(finite.astype(float), starts)
    sums = np.add.reduceat(np.where(finite, values, 0.0), starts)
    return np.divide(sums, counts, out=np.full(len(starts), np.nan), where=counts > 0)
