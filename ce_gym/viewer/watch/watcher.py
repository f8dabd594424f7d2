"""Follows training runs: a thread reads what they write, lets the newest policy walk, and sends both to the page.

Training knows nothing of it: runs are read from their folders. Reading policies and compiling their environment is done
in another thread.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.policies import load_policy
from ce_gym.viewer.feed import Feed
from ce_gym.viewer.page.charts import packed
from ce_gym.viewer.page.html import color_of, css
from ce_gym.viewer.watch.run_log import LENGTH, LOG, REWARD, TERM, RunLog, find_runs, read_log
from ce_gym.viewer.watch.walker import Walker, newest_policy

PERIOD = 1.0  # between two looks at the folders [s]
IDLE = 0.25  # between two messages while nothing walks [s]
MOST_ROWS = 1000  # of a run's figures that are sent
MOST_TERMS = 5  # reward terms that are plotted at first
MOST_RUNS = 8


class Watcher:
    """Follows some training runs until it is closed.

    Args:
        folders: Of training runs, or folders that have them.
        env_id: The environment that the user named; policies name it otherwise.
        kwargs: Arguments of the environment that replace those of policies.
        patient: Whether folders may be empty yet.

    Attributes:
        feed: The events that the page receives.

    Raises:
        ViewerError: A folder has no training run, or its log is none.
    """

    def __init__(
        self, folders: Sequence[Path], env_id: str = "", kwargs: Mapping[str, Any] | None = None, patient: bool = False
    ) -> None:
        self._folders, self._env_id, self._kwargs = list(folders), env_id, dict(kwargs or {})
        self.feed, self._ended = Feed(), threading.Event()
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="watch")
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._runs: list[Path] = []
        self._logs: dict[Path, tuple[float, RunLog]] = {}
        self._walker: Walker | None = None
        self._tried: tuple[Path, float] | None = None
        self._making: Future[Walker | None] | None = None
        self._record: dict[str, Any] = {}
        self._notice, self._next_look = "", 0.0
        if not patient:
            self._runs = [run for folder in self._folders for run in find_runs(folder)]
            self._read()

    @property
    def name(self) -> str:
        """What is watched, in a word."""
        return ", ".join(folder.resolve().name for folder in self._folders)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread, and wait until it has ended."""
        self._ended.set()
        self.feed.close()
        if self._thread.is_alive():
            self._thread.join()
        self._beside.shutdown(cancel_futures=True)
        if self._walker:
            self._walker.close()

    def _follow(self) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            if time.monotonic() >= self._next_look:
                self._look()
            watched = self._show()
            due = max(due + (self._walker.dt if self._walker and watched else IDLE), time.monotonic())
            self._ended.wait(due - time.monotonic())

    def _look(self) -> None:
        """See what is new in the folders."""
        start = time.monotonic()
        try:
            self._runs = self._found()
            self._read()
        except Exception as problem:  # half-written files, and damage, show in every kind of them
            self._notice = " ".join(str(problem).split())
        self._take()
        taken = time.monotonic() - start
        self._next_look = start + max(PERIOD, 20 * taken)  # of a long log, less often

    def _found(self) -> list[Path]:
        runs = []
        for folder in self._folders:
            if folder.is_dir() and ((folder / LOG).is_file() or any(folder.glob(f"*/{LOG}"))):
                runs += find_runs(folder)
        return runs[:MOST_RUNS]

    # Curves.

    def _read(self) -> None:
        changed = False
        for run in self._runs:
            stamp = (run / LOG).stat().st_mtime
            if self._logs.get(run, (0.0,))[0] != stamp:
                self._logs[run], changed = (stamp, read_log(run)), True
        if changed:
            self.feed.keep("curves", json.dumps(self.curves()).encode())

    def curves(self) -> dict[str, Any]:
        """Return the figures of all runs, as the page's plots take them."""
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
        return {"sources": sources, "span": [0.0, float(last)], "chosen": chosen(logs)}

    # The robot.

    def _take(self) -> None:
        """Let the newest policy act, or have it read, and its environment made, if there is another."""
        if self._making is not None:
            if not self._making.done():
                return
            making, self._making = self._making, None
            try:
                self._replace(making.result())
            except Exception as problem:  # the page keeps the robot it has
                self._notice = " ".join(str(problem).split())
        files = [file for run in self._runs if (file := newest_policy(run))]
        try:
            newest = max(((file.stat().st_mtime, file) for file in files), default=None)
        except OSError:  # replaced meanwhile: next time
            return
        if newest and (newest[1], newest[0]) != self._tried:
            self._tried = newest[1], newest[0]
            self._making = self._beside.submit(self._made, newest[1])

    def _made(self, file: Path) -> Walker | None:
        policy = load_policy(file)
        walker = self._walker
        self._record = policy.record
        if walker is None or not walker.fits(policy):
            return Walker(policy, self._env_id, self._kwargs)
        walker.policy = policy
        return walker

    def _replace(self, walker: Walker | None) -> None:
        self._notice = ""
        if walker is self._walker or walker is None:
            return
        old, self._walker = self._walker, walker
        self.feed.keep("scene", json.dumps(walker.scene.commands()).encode())
        if old:
            old.close()

    def _show(self) -> bool:
        """Send a message, and the pose after a control step if a robot is there; return whether anybody looks."""
        moves, told = {}, dict[str, Any]()
        if self._walker:
            try:
                self._walker.step()
            except ValueError as problem:  # the policy is of another environment than it says
                self._notice, self._walker = str(problem), None
        if self._walker:
            moves, told = self._walker.moves(), self._walker.state()
            if ground := self._walker.scene.new_ground(moves):
                self.feed.keep("ground", ground)
        message = {"moves": moves, "state": {**self.state(), **told}}
        return self.feed.publish(f"data: {json.dumps(message)}\n\n".encode())

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
            "ended": self._has_ended(),
            "finished": self._record.get("finished") is True,
            "making": self._making is not None and self._walker is None,
            "notice": self._notice,
        }

    def _has_ended(self) -> bool:
        """Whether the newest policy is the one that a run leaves at its end."""
        return self._tried is not None and self._tried[0].parent in self._runs


def chosen(logs: Sequence[RunLog]) -> list[list[str]]:
    """Return the signals of each plot at first: reward, length, and the largest terms of the reward in one."""
    sizes: dict[str, float] = {}
    for log in logs:
        for name, values in log.signals.items():
            tail = values[-20:][np.isfinite(values[-20:])]
            if name.startswith(TERM) and len(tail):
                sizes[name] = max(sizes.get(name, 0.0), float(np.abs(tail).mean()))
    terms = sorted(sizes, key=lambda name: -sizes[name])[:MOST_TERMS]
    single = [[name] for name in (REWARD, LENGTH) if any(name in log.signals for log in logs)]
    return [*single, *([terms] if terms else [])]
