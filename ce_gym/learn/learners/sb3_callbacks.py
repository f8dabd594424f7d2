"""Callbacks of Stable-Baselines3 for the learning curve, the progress bar and schedules; see progress.py."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys
from stable_baselines3.common.utils import FloatSchedule

from ce_gym.learn.runs.folder import continue_if_full
from ce_gym.learn.runs.page import Present
from ce_gym.learn.runs.progress import (
    Log,
    ProgressBar,
    StopInOrder,
    adapted_rate,
    episode_means,
    fall_cost,
    geometric,
    linear,
    spread_episodes,
)


class _Quiet(BaseCallback):
    """A callback that does nothing after a step."""

    def _on_step(self) -> bool:
        return True


class EpisodeLog(_Quiet):
    """Logs the mean of every reward term and metric of recent episodes."""

    def _on_rollout_end(self) -> None:
        for key, value in episode_means(self.model.ep_info_buffer).items():
            if key not in ("r", "l"):  # Stable-Baselines3 logs these two itself
                self.logger.record(key, value)


class SpreadEpisodes(_Quiet):
    """Spreads the ends of the first episodes, see `spread_episodes`."""

    def _on_training_start(self) -> None:
        spread_episodes(self.training_env.unwrapped.envs.unwrapped, np.random.default_rng(self.model.seed))  # type: ignore[attr-defined]


class AdaptiveLearningRate(_Quiet):
    """Keeps the KL divergence of an update near a target by changing the learning rate, see `adapted_rate`."""

    def __init__(self, target: float) -> None:
        super().__init__()
        self.target = target

    def _on_rollout_start(self) -> None:
        kl = self.logger.name_to_value.get("train/approx_kl")  # of the last update
        if kl is not None:
            rate = self.model.policy.optimizer.param_groups[0]["lr"]
            self.model.lr_schedule = FloatSchedule(adapted_rate(rate, kl, self.target))


class _Schedule(_Quiet):
    """Changes a value between rollouts.

    Args:
        start: Value before the first step.
        end: Value after the last step.
        steps: Number of steps of the training.
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
        self.model.ent_coef = linear(self.start, self.end, done)  # type: ignore[attr-defined]  # of PPO


class NoiseSchedule(_Schedule):
    """Changes the standard deviation of the actions by the same factor in every step."""

    def _set(self, done: float) -> None:
        log_std: Any = self.model.policy.log_std
        log_std.data.fill_(math.log(geometric(self.start, self.end, done)))


class FallCost(_Schedule):
    """Subtracts the cost of a fall from the reward of a step that ends an episode as a failure.

    Args:
        most: Final cost of a fall, see `fall_cost`.
        steps: Number of steps of the training.
    """

    def __init__(self, most: float, steps: int) -> None:
        super().__init__(0.0, most, steps)

    def _set(self, done: float) -> None:
        self.cost = fall_cost(self.end, done)

    def _on_step(self) -> bool:
        infos, rewards = self.locals["infos"], self.locals["rewards"]  # of the last step; not in the buffer yet
        for i in np.flatnonzero(self.locals["dones"]):
            if not (infos[i]["TimeLimit.truncated"] or infos[i]["diverged"]):
                rewards[i] -= self.cost
        return True


class Checkpoints(_Quiet):
    """Saves the policy between updates.

    Args:
        save: Function that writes a checkpoint.
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


class KeepPresent(_Quiet):
    """Writes the policy for the page between updates."""

    def __init__(self, present: Present) -> None:
        super().__init__()
        self.present = present

    def _on_rollout_start(self) -> None:
        self.present.keep()


class Lenient(KVWriter):
    """A log writer that lets training continue when its disk is full.

    Args:
        writer: Writer of Stable-Baselines3.
    """

    def __init__(self, writer: KVWriter) -> None:
        self.writer = writer

    def write(self, *args: Any) -> None:
        """Write one row, see `KVWriter`."""
        with continue_if_full():
            self.writer.write(*args)

    def close(self) -> None:
        """Close the file."""
        with continue_if_full():
            self.writer.close()


class WriteLog(KVWriter):
    """Writes the log of Stable-Baselines3 as `progress.csv`.

    Args:
        log: File to write.
    """

    def __init__(self, log: Log) -> None:
        self.log = log

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Write one row, see `KVWriter`."""
        self.log.add(filter_excluded_keys(key_values, key_excluded, "csv"))

    def close(self) -> None:
        """Do nothing: the file is closed after every row."""


class Stop(BaseCallback):
    """Ends training between two steps, see `StopInOrder`."""

    def __init__(self, stop: StopInOrder) -> None:
        super().__init__()
        self.stop = stop

    def _on_step(self) -> bool:
        return not self.stop.due


class ShowProgress(_Quiet):
    """Updates the progress bar.

    Args:
        total: Steps at which training ends.

    Attributes:
        shares: See `ProgressBar`; empty before training.
    """

    def __init__(self, total: int) -> None:
        super().__init__()
        self.total, self.shares = total, dict[str, float]()

    def _on_training_start(self) -> None:
        self.bar = ProgressBar(self.total, self.num_timesteps)
        self.collecting, self.rollout_started = 0.0, time.perf_counter()
        self.physics_before = self._physics()

    def _on_rollout_start(self) -> None:
        self.rollout_started = time.perf_counter()

    def _on_step(self) -> bool:
        self.bar.advance(self.num_timesteps)
        return True

    def _on_rollout_end(self) -> None:
        self.collecting += time.perf_counter() - self.rollout_started
        physics = self._physics() - self.physics_before
        self.bar.describe(episode_means(self.model.ep_info_buffer), physics, self.collecting)
        self.shares = self.bar.shares

    def _on_training_end(self) -> None:
        self.bar.close()

    def _physics(self) -> float:
        """Return the time inside the environment so far [s]."""
        return getattr(self.training_env, "step_seconds", 0.0)
