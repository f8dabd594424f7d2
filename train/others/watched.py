"""`watched:watched/Stand-v0`: an environment that writes the return of every episode into the file `$WATCHED_FILE`.

So that learning is seen whatever the learner prints. One line an episode, by any number of processes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium

import ce_gym  # noqa: F401  (registers the environments)

STAND = "ce_gym/MiniCheetahStand-v0"


def note(returns: Iterable[float]) -> None:
    """Add returns to the file."""
    with Path(os.environ["WATCHED_FILE"]).open("a", encoding="utf-8") as file:
        file.write("".join(f"{number:.6g}\n" for number in returns))


class Watched(gymnasium.Wrapper):
    """One robot."""

    total = 0.0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and note the return of an episode that has ended."""
        observation, reward, terminated, truncated, info = super().step(action)
        self.total += float(reward)
        if terminated or truncated:
            note([self.total])
            self.total = 0.0
        return observation, reward, terminated, truncated, info


class WatchedVector(gymnasium.vector.VectorWrapper):
    """A native batch."""

    def __init__(self, envs: gymnasium.vector.VectorEnv) -> None:
        super().__init__(envs)
        self.autoreset_mode = envs.unwrapped.autoreset_mode  # type: ignore[attr-defined]  # what some learners ask for

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step, and note the returns of the episodes that have ended."""
        observations, rewards, terminated, truncated, infos = super().step(actions)
        if "episode_terms" in infos:
            note(infos["episode_terms"]["return"][infos["_episode_terms"]])
        return observations, rewards, terminated, truncated, infos


def make(**kwargs: Any) -> gymnasium.Env:
    """Entry point of one robot."""
    return Watched(gymnasium.make(STAND, **kwargs))


def make_vector(num_envs: int, **kwargs: Any) -> gymnasium.vector.VectorEnv:
    """Entry point of a native batch."""
    return WatchedVector(gymnasium.make_vec(STAND, num_envs, vectorization_mode="vector_entry_point", **kwargs))


gymnasium.register("watched/Stand-v0", entry_point=make, vector_entry_point=make_vector)
