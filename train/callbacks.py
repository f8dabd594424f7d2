"""What happens beside learning: progress bar, logs, checkpoints, learning rate, and stopping in good order.

Every class is a Stable-Baselines3 callback and does one thing. Knows the learner and the `episode` entries that
environments report; knows nothing of robots or tasks.
"""

from __future__ import annotations

import csv
import math
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import FloatSchedule
from tqdm import tqdm


class _Quiet(BaseCallback):
    """A callback that does nothing at each step unless it says so."""

    def _on_step(self) -> bool:
        return True


def episode_means(episodes: Any) -> dict[str, float]:
    """Mean of every entry of recent episodes, without the clock `t`; empty before the first episode ends."""
    if not episodes:
        return {}
    return {key: float(np.mean([episode[key] for episode in episodes])) for key in episodes[-1] if key != "t"}


class EpisodeLog(_Quiet):
    """Writes the mean of every reward term and metric of recent episodes to the log."""

    def _on_rollout_end(self) -> None:
        for key, value in episode_means(self.model.ep_info_buffer).items():
            if key not in ("r", "l"):  # the learner logs these two itself
                self.logger.record(key, value)


class Curve(_Quiet):
    """Writes how learning goes into a small CSV file: steps, seconds, mean reward and length of recent episodes.

    The learner's own log begins anew when training goes on from a policy; this one keeps what came before.

    Args:
        file: To write, a row after every rollout.
        before: Rows of the training that led to the policy gone on from, see `read_curve`.
    """

    def __init__(self, file: Path, before: list[dict[str, float]]) -> None:
        super().__init__()
        self.file, self.before = file, before

    def _on_training_start(self) -> None:
        rows = [row for row in self.before if row["steps"] <= self.num_timesteps]
        self.started = time.perf_counter() - (rows[-1]["seconds"] if rows else 0.0)
        self._write(rows, "w")

    def _on_rollout_end(self) -> None:
        means = episode_means(self.model.ep_info_buffer)
        if means:
            seconds = round(time.perf_counter() - self.started, 2)
            values = (self.num_timesteps, seconds, round(means["r"], 4), round(means["l"], 2))
            self._write([dict(zip(CURVE, values, strict=True))], "a")

    def _write(self, rows: list[dict[str, float]], mode: str) -> None:
        with self.file.open(mode, newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, CURVE)
            if mode == "w":
                writer.writeheader()
            writer.writerows(rows)


CURVE: tuple[str, ...] = ("steps", "seconds", "reward", "length")
"""Columns of a learning curve."""


def read_curve(file: Path) -> list[dict[str, float]]:
    """Return the rows of a learning curve; none if there is no such file.

    Raises:
        ValueError: If it is something else.
    """
    if not file.exists():
        return []
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            return [{key: float(row[key]) for key in CURVE} for row in csv.DictReader(lines)]
    except (KeyError, TypeError, ValueError, csv.Error):
        raise ValueError(f"{file}: expected the columns {', '.join(CURVE)}, numbers in each row") from None


class AdaptiveLearningRate(_Quiet):
    """Keeps the KL divergence of an update near a target by changing the learning rate.

    The rule of Schulman et al. 2017 (arXiv:1707.06347, section 4) as legged-robot learners use it: outside half and
    twice the target, change the rate by a factor of 1.5.

    Args:
        target: Desired mean KL divergence of one update.
        limits: Smallest and largest learning rate.
    """

    def __init__(self, target: float, limits: tuple[float, float] = (1e-5, 1e-2)) -> None:
        super().__init__()
        self.target, self.limits = target, limits

    def _on_rollout_start(self) -> None:
        kl = self.logger.name_to_value.get("train/approx_kl")  # of the update that has just ended
        if kl is None:
            return
        rate = self.model.policy.optimizer.param_groups[0]["lr"]
        if kl > 2.0 * self.target:
            rate /= 1.5
        elif kl < 0.5 * self.target:
            rate *= 1.5
        self.model.lr_schedule = FloatSchedule(float(np.clip(rate, *self.limits)))


class _Schedule(_Quiet):
    """Changes something between rollouts by the share of the training that is done.

    Args:
        start: Its value before the first step.
        end: Its value after the last one.
        steps: Steps in all.
    """

    def __init__(self, start: float, end: float, steps: int) -> None:
        super().__init__()
        self.start, self.end, self.steps = start, end, steps

    def _on_rollout_start(self) -> None:
        self._set(min(self.num_timesteps / self.steps, 1.0))

    def _set(self, done: float) -> None:
        raise NotImplementedError


class EntropySchedule(_Schedule):
    """Changes the weight of the entropy bonus in proportion to the steps done."""

    def _set(self, done: float) -> None:
        self.model.ent_coef = self.start + done * (self.end - self.start)  # type: ignore[attr-defined]  # of PPO


class NoiseSchedule(_Schedule):
    """Changes the standard deviation of the actions by the same factor in every step."""

    def _set(self, done: float) -> None:
        log_std: Any = self.model.policy.log_std
        log_std.data.fill_((1 - done) * math.log(self.start) + done * math.log(self.end))


class Checkpoints(_Quiet):
    """Saves the policy between updates, every so many steps.

    Args:
        save: Writes a checkpoint.
        every: Steps between two checkpoints.
    """

    def __init__(self, save: Callable[[], None], every: int) -> None:
        super().__init__()
        self.save, self.every, self.next = save, every, every

    def _on_training_start(self) -> None:
        self.next = self.num_timesteps + self.every

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self.next:
            self.save()
            self.next = self.num_timesteps + self.every


class StopInOrder(BaseCallback):
    """Ends training between two steps, at a deadline or at Ctrl-C, so that the policy is whole when it is saved.

    A second Ctrl-C interrupts at once. Use as a context manager around `learn`.

    Args:
        seconds: Longest time to train [s].

    Attributes:
        interrupted: Whether Ctrl-C ended training.
    """

    def __init__(self, seconds: float = float("inf")) -> None:
        super().__init__()
        self.seconds, self.interrupted = seconds, False

    def __enter__(self) -> StopInOrder:
        self._previous = signal.signal(signal.SIGINT, self._on_interrupt)
        self._deadline = time.monotonic() + self.seconds
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _on_interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        self.interrupted = True

    def _on_step(self) -> bool:
        return not self.interrupted and time.monotonic() < self._deadline


class ProgressBar(BaseCallback):
    """Steps, speed and time left, with the figures of recent episodes and where the time goes.

    "physics" is time inside the environment, "policy" the rest of collection, "learning" the updates.

    Args:
        total: Steps at which training ends.
    """

    def __init__(self, total: int) -> None:
        super().__init__()
        self.total = total

    def _on_training_start(self) -> None:
        interval = 0.5 if sys.stderr.isatty() else 10.0  # a log file gets a line now and then
        form = "{percentage:3.0f}% |{bar:20}| {n_fmt}/{total_fmt} steps, {rate_fmt}, {remaining} left {postfix}"
        self.bar = tqdm(
            total=self.total, initial=self.num_timesteps, unit=" steps", unit_scale=True, mininterval=interval,
            bar_format=form, dynamic_ncols=True, smoothing=0.05,
        )  # fmt: skip
        self.started = time.perf_counter()
        self.collecting, self.rollout_started = 0.0, self.started
        self.physics_before = self._physics()

    def _on_rollout_start(self) -> None:
        self.rollout_started = time.perf_counter()

    def _on_step(self) -> bool:
        self.bar.update(min(self.num_timesteps, self.total) - self.bar.n)
        return True

    def _on_rollout_end(self) -> None:
        self.collecting += time.perf_counter() - self.rollout_started
        self.bar.set_postfix_str(f"| {self._figures()} | {self._shares()}", refresh=False)

    def _on_training_end(self) -> None:
        self.bar.close()

    def _physics(self) -> float:
        """Time spent inside the environment so far [s]."""
        return getattr(self.training_env, "step_seconds", 0.0)

    def _figures(self) -> str:
        """Means over recent episodes."""
        means = episode_means(self.model.ep_info_buffer)
        if not means:
            return "no episode has ended yet"
        metrics = [
            (key.split("/", 1)[1].replace("_", " "), x) for key, x in means.items() if key.startswith("metrics/")
        ]
        shown = [("reward", means["r"]), ("length", means["l"]), *metrics[:2]]
        return ", ".join(f"{name} {value:.3g}" for name, value in shown)

    def _shares(self) -> str:
        """Where the time went since training began."""
        total = time.perf_counter() - self.started
        physics = self._physics() - self.physics_before
        parts = {"physics": physics, "policy": self.collecting - physics, "learning": total - self.collecting}
        return " ".join(f"{name} {100 * seconds / total:.0f}%" for name, seconds in parts.items())
