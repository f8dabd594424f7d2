"""Statistics, schedules, progress bar and interruption of training, for all learners."""

from __future__ import annotations

import contextlib
import csv
import os
import signal
import stat
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ce_gym.learn.runs.folder import LOG, continue_if_full, run_of
from ce_gym.policies import locate_policy

STEPS, SECONDS, REWARD, LENGTH = (
    "time/total_timesteps", "time/time_elapsed", "rollout/ep_rew_mean", "rollout/ep_len_mean",
)  # fmt: skip
"""Columns of the learning curve, with the names that Stable-Baselines3 uses."""


def spread_episodes(native: Any, rng: np.random.Generator) -> None:
    """Let the first episodes end at different times, if the environments support it.

    Otherwise all robots get new commands in the same step. Then most rollouts contain no change of command, and the
    policy forgets how to change its gait.
    """
    if hasattr(native, "elapsed_steps"):
        native.elapsed_steps = rng.integers(0, native.max_episode_steps, native.num_envs)


class RecentEpisodes:
    """Statistics of the last episodes.

    Args:
        count: Number of episodes.

    Attributes:
        names: Names of the entries: return `r`, length `l`, reward terms, metrics.
    """

    def __init__(self, count: int) -> None:
        self.count, self.names, self._rows = count, [], np.zeros((0, 0))

    def add(self, done: NDArray[np.bool_], infos: dict[str, Any]) -> None:
        """Add the episodes that ended in this step, if the environments report them."""
        if "episode_terms" in infos:
            terms = dict(infos["episode_terms"])
            entries = {"r": terms.pop("return"), "l": terms.pop("length"), **terms}
            self.names, new = list(entries), np.stack([values[done] for values in entries.values()], axis=1)
            self._rows = np.concatenate([self._rows.reshape(-1, len(entries)), new])[-self.count :]

    def means(self) -> dict[str, float]:
        """Return the mean of every entry; empty before the first episode ends."""
        return dict(zip(self.names, self._rows.mean(axis=0).tolist(), strict=True)) if len(self._rows) else {}

    def rows(self) -> NDArray:
        """Return the entries, one episode per row."""
        return self._rows

    def restore(self, names: list[str], rows: NDArray) -> None:
        """Replace names and entries, see `rows`."""
        self.names, self._rows = names, rows


class Log:
    """Writes the statistics of each iteration to `progress.csv`, and to other programs.

    Args:
        folder: Folder of the run.
        resume: Policy from which training continues; the rows of its run are kept.
        steps: Steps done so far; earlier rows beyond them are dropped.
        trackers: Receive each row as well, see `logs.open_trackers`.
    """

    def __init__(self, folder: Path, resume: Path | None, steps: int, trackers: Sequence[Any] = ()) -> None:
        self.file, self.trackers = folder / LOG, trackers
        earlier = read_rows(run_of(locate_policy(resume)) / LOG) if resume else []
        self.rows: list[Mapping[str, Any]] = [row for row in earlier if row[STEPS] <= steps]
        self.columns = list(dict.fromkeys(name for row in self.rows for name in row))
        self.started = time.perf_counter() - (self.rows[-1][SECONDS] if self.rows else 0.0)
        self._begun = False

    def add(self, steps: int, means: Mapping[str, float], figures: Mapping[str, float]) -> None:
        """Write one row with its time. If the row has new columns, write the whole file again.

        Args:
            steps: Environment steps done.
            means: Means of recent episodes, see `RecentEpisodes`.
            figures: Statistics of the update.
        """
        row = {STEPS: steps, SECONDS: round(time.perf_counter() - self.started, 3)}
        row |= {{"r": REWARD, "l": LENGTH}.get(key, key): mean for key, mean in means.items()} | dict(figures)
        self.rows.append(row)
        new = [name for name in row if name not in self.columns]
        self.columns += new
        whole, self._begun = bool(new) or not self._begun, True
        self._write(self.rows if whole else [row], "w" if whole else "a")
        for tracker in self.trackers:
            with continue_if_full():
                tracker.log(row, step=steps)

    def close(self) -> None:
        """End the logs of other programs."""
        for tracker in self.trackers:
            with continue_if_full():
                tracker.finish()

    def _write(self, rows: Sequence[Mapping[str, Any]], mode: str) -> None:
        with continue_if_full(), self.file.open(mode, newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.columns)
            if mode == "w" and self.columns:
                writer.writeheader()
            writer.writerows(rows)


def read_rows(file: Path) -> list[dict[str, Any]]:
    """Return the rows of a log, with steps and seconds as numbers; no rows if there is no such file.

    Raises:
        ValueError: If a column is missing, or a number in it.
    """
    if not file.exists():
        return []
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            whole = [row for row in csv.DictReader(lines) if None not in row.values()]  # a killed run cuts its last row
        return [{**row, STEPS: float(row[STEPS]), SECONDS: float(row[SECONDS])} for row in whole]
    except (KeyError, TypeError, ValueError, csv.Error):
        raise ValueError(f"{file}: expected the columns {STEPS} and {SECONDS}, numbers in each row") from None


def read_curve(file: Path) -> list[dict[str, float]]:
    """Return the learning curve in a log: steps, seconds, mean reward and length of recent episodes by row."""
    names = {"steps": STEPS, "seconds": SECONDS, "reward": REWARD, "length": LENGTH}
    return [{name: float(row[key]) for name, key in names.items()} for row in read_rows(file) if row.get(REWARD)]


def adapted_rate(rate: float, kl: float, target: float, limits: tuple[float, float] = (1e-5, 1e-2)) -> float:
    """Return the learning rate that keeps the KL divergence of an update near a target.

    The rule of Schulman et al. 2017 (arXiv:1707.06347, section 4), with the limits usual for legged robots: below half
    and above twice the target, change the rate by a factor of 1.5.

    Args:
        rate: Learning rate of the last update.
        kl: Mean divergence of the last update.
        target: Desired divergence.
        limits: Smallest and largest learning rate.
    """
    factor = 1 / 1.5 if kl > 2.0 * target else 1.5 if kl < 0.5 * target else 1.0
    return float(np.clip(rate * factor, *limits))


def linear(start: float, end: float, done: float) -> float:
    """Return a value that changes linearly; `done` is the finished fraction of training."""
    return start + done * (end - start)


def geometric(start: float, end: float, done: float) -> float:
    """Return a value that changes by the same factor in every step; `done` is the finished fraction of training."""
    return float(np.exp(linear(np.log(start), np.log(end), done)))


def fall_cost(most: float, done: float) -> float:
    """Return the cost of a fall: 0 until 30 % of training, then linear, and `most` from 60 %.

    A robot that cannot walk yet falls whatever it does. An early cost would teach it to stand still.
    """
    return most * float(np.clip((done - 0.3) / 0.3, 0.0, 1.0))


class StopInOrder:
    """Context that ends training between two updates: at a deadline, after Ctrl-C, SIGTERM or SIGHUP.

    A second signal, or a signal before the first update, interrupts immediately. A signal that the process ignores, as
    SIGHUP under `nohup`, stays ignored.

    Args:
        seconds: Longest time to train [s].

    Attributes:
        interrupted: Whether a signal ended training.
        has_progress: Whether there is an update to save.
    """

    def __init__(self, seconds: float = float("inf")) -> None:
        self.interrupted, self.has_progress = False, False
        self._deadline = time.monotonic() + seconds

    def __enter__(self) -> StopInOrder:
        numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
        heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
        self._previous = {number: signal.signal(number, self._on_signal) for number in heard}
        return self

    def __exit__(self, *_: object) -> None:
        for number, previous in self._previous.items():
            signal.signal(number, previous)

    def _on_signal(self, number: int, _: object) -> None:
        if number == getattr(signal, "SIGHUP", None):
            leave_terminal()
        if self.interrupted or not self.has_progress:
            raise KeyboardInterrupt
        self.interrupted = True

    @property
    def due(self) -> bool:
        """Whether to stop now."""
        return self.interrupted or time.monotonic() >= self._deadline


def leave_terminal() -> None:
    """Discard what is printed from now on, because the terminal that shows it is closing or has closed."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            if stat.S_ISCHR(os.fstat(stream.fileno()).st_mode):
                os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


class ProgressBar:
    """Progress bar with steps, speed, remaining time, recent episodes and shares of the time.

    Args:
        total: Steps at which training ends.
        steps: Steps done so far.
    """

    def __init__(self, total: int, steps: int) -> None:
        interval = 0.5 if sys.stderr.isatty() else 10.0  # fewer lines in a log file
        form = "{percentage:3.0f}% |{bar:20}| {n_fmt}/{total_fmt} steps, {rate_fmt}, {remaining} left{postfix}"
        options = {"unit": " steps", "unit_scale": True, "dynamic_ncols": True, "smoothing": 0.05}
        self.bar: Any = tqdm(total=total, initial=steps, mininterval=interval, bar_format=form, **options)
        self.bar.set_postfix_str("first update")
        self.started = time.perf_counter()

    def show(self, learner: Any) -> None:
        """Show steps, recent episodes, and shares of the time: physics, rest of collection, learning."""
        total, means = time.perf_counter() - self.started, learner.episodes.means()
        physics, collecting = learner.step_seconds / total, learner.collect_seconds / total
        shares = f"physics {physics:.0%} policy {collecting - physics:.0%} learning {1 - collecting:.0%}"
        self.bar.set_postfix_str(f"{_figures(means)} | {shares}", refresh=False)
        try:
            self.bar.update(min(learner.steps, self.bar.total) - self.bar.n)
        except OSError:
            leave_terminal()


def _figures(means: Mapping[str, float]) -> str:
    """Return means of recent episodes as text: reward, length and two metrics."""
    if not means:
        return "no episode has ended yet"
    metrics = {key.split("/")[1].replace("_", " "): x for key, x in means.items() if key.startswith("metrics/")}
    shown = list({"reward": means["r"], "length": means["l"], **metrics}.items())[:4]
    return ", ".join(f"{name} {value:.3g}" for name, value in shown)
