"""Follows training runs: reads their files, simulates the newest policy, and sends both to the page.

The training does not take part. Another thread reads policies and compiles their environments.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.policies import load_policy
from ce_gym.viewer.page.charts import packed
from ce_gym.viewer.page.html import color_of, css, filled, packed_commands
from ce_gym.viewer.stream import LivePage
from ce_gym.viewer.watch.run_log import LENGTH, LOG, REWARD, TERM, RunLog, find_runs, read_log
from ce_gym.viewer.watch.walker import Walker, newest_policy

PERIOD = 1.0  # between two readings of the folders [s]
IDLE = 0.25  # between two messages without a robot [s]
MOST_ROWS = 1000  # of a run's log that are sent
MOST_TERMS = 5  # reward terms in their first plot
MOST_RUNS = 8


class Watcher(LivePage):
    """Follows some training runs until it is closed.

    Args:
        folders: Folders of training runs, or folders with such folders.
        env_id: Environment from the command line; "" for the environment of each policy's record.
        kwargs: Arguments of the environment, in place of the record's.
        patient: Whether runs may begin later.

    Raises:
        ViewerError: A folder has no training run, or a log cannot be read.
    """

    def __init__(
        self, folders: Sequence[Path], env_id: str = "", kwargs: Mapping[str, Any] | None = None, patient: bool = False
    ) -> None:
        super().__init__("watch")
        self._folders, self._env_id, self._kwargs = list(folders), env_id, dict(kwargs or {})
        self._runs: list[Path] = []
        self._logs: dict[Path, tuple[float, RunLog]] = {}  # time of each file, content
        self._walker: Walker | None = None
        self._newest: tuple[float, Path] | None = None  # time and file of the policy read last
        self._record: dict[str, Any] = {}
        self._next_reading = 0.0
        if not patient:
            self._runs = [run for folder in self._folders for run in find_runs(folder)]
            self._read_logs()

    def html(self) -> str:
        """Return the page."""
        title = ", ".join(folder.resolve().name for folder in self._folders)
        return filled("watch", title, scripts=("stream", "graph", "plots", "watch"), constants={"COMMANDS": []})

    def close(self) -> None:
        """Stop the threads, wait until they have ended, and close the environment."""
        super().close()
        if self._walker:
            self._walker.close()

    def update(self) -> float:
        """Read new files, simulate and send one control step; return the time until the next update [s]."""
        start = time.monotonic()
        if start >= self._next_reading:
            self._read_folders()
            self._next_reading = start + max(PERIOD, 20 * (time.monotonic() - start))  # long logs are read less often
        if self._walker:
            try:
                return self._walker.dt if self._walker.step(self.feed, self.state()) else IDLE
            except ValueError as error:  # the policy does not fit the environment of its record
                self.notice, self._walker = str(error), None
        self.feed.publish({"moves": {}, "state": self.state()})
        return IDLE

    def _read_folders(self) -> None:
        try:
            self._runs = self._present_runs()
            self._read_logs()
        except Exception as error:  # damaged and half-written files raise errors of many kinds
            self.notice = " ".join(str(error).split())
        if walker := self._finished_job():
            self._use(walker)
        self._read_newest_policy()

    def _present_runs(self) -> list[Path]:
        runs = []
        for folder in self._folders:
            if folder.is_dir() and ((folder / LOG).is_file() or any(folder.glob(f"*/{LOG}"))):
                runs += find_runs(folder)
        return runs[:MOST_RUNS]

    def _read_logs(self) -> None:
        changed = False
        for run in self._runs:
            modified = (run / LOG).stat().st_mtime
            if self._logs.get(run, (0.0,))[0] != modified:
                self._logs[run], changed = (modified, read_log(run)), True
        if changed:
            self.feed.keep("curves", self._curves())

    def _curves(self) -> dict[str, Any]:
        """Return the logs of all runs for the page's plots."""
        logs = [self._logs[run][1].thinned(MOST_ROWS) for run in self._runs if run in self._logs]
        sources = [
            {
                "name": log.name,
                "color": css(color_of(index)),
                "times": packed(log.steps),
                "signals": {name: packed(values) for name, values in log.signals.items()},
            }
            for index, log in enumerate(logs)
        ]
        last = max((log.steps[-1] for log in logs if len(log.steps)), default=0.0)
        return {"sources": sources, "span": [0.0, float(last)], "chosen": first_plots(logs)}

    def _read_newest_policy(self) -> None:
        """Have the newest policy read in the background, if it is new."""
        files = [file for run in self._runs if (file := newest_policy(run))]
        try:
            newest = max(((file.stat().st_mtime, file) for file in files), default=None)
        except OSError:  # replaced in the meantime; the next reading finds the file
            return
        if newest and newest != self._newest and self._job is None:
            self._newest = newest
            self._job = self._background.submit(self._make_walker, newest[1])

    def _make_walker(self, file: Path) -> Walker:
        policy = load_policy(file)
        walker = self._walker
        self._record = policy.record
        if walker is None or not walker.fits(policy):
            return Walker(policy, self._env_id, self._kwargs)
        walker.policy = policy
        return walker

    def _use(self, walker: Walker) -> None:
        if walker is self._walker:
            return
        old, self._walker = self._walker, walker
        self.feed.keep("scene", packed_commands(walker.scene.commands()))
        if old:
            old.close()

    def state(self) -> dict[str, Any]:
        """Return the state that the page shows as text."""
        logs = [log for _, log in self._logs.values()]
        newest = max(logs, key=lambda log: log.steps[-1] if len(log.steps) else 0.0, default=None)
        settings = self._record.get("settings")
        total = settings.get("steps") if isinstance(settings, dict) else None
        return {
            "steps": float(newest.steps[-1]) if newest and len(newest.steps) else 0.0,
            "seconds": newest.seconds if newest else 0.0,
            "total": total if isinstance(total, int | float) else None,
            "policy_steps": self._record.get("steps"),
            "ended": self._record.get("ended") is True,
            "finished": self._record.get("finished") is True,
            "making": self._job is not None and self._walker is None,
            "notice": self.notice,
        }


def first_plots(logs: Sequence[RunLog]) -> list[list[str]]:
    """Return the signals of each first plot: reward, length, and the largest reward terms in one plot."""
    sizes: dict[str, float] = {}
    for log in logs:
        for name, values in log.signals.items():
            tail = values[-20:][np.isfinite(values[-20:])]
            if name.startswith(TERM) and len(tail):
                sizes[name] = max(sizes.get(name, 0.0), float(np.abs(tail).mean()))
    terms = sorted(sizes, key=lambda name: -sizes[name])[:MOST_TERMS]
    single = [[name] for name in (REWARD, LENGTH) if any(name in log.signals for log in logs)]
    return [*single, *([terms] if terms else [])]
