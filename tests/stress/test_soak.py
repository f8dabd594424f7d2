"""Random actions on every environment in turn, for minutes, with failures put in; memory and counts must stay right.

Every environment gets a batch with episodes short enough to end by every cause: time, falls, and divergence, which is
put in by writing a number that is not one into the velocity of a robot now and then. Nothing
may raise, and all results must be finite. Exactly the robots made to diverge are flagged, and counts agree. Sums and
lengths belong to their episodes. After three rounds through all environments the process no longer grows, nor holds
more threads and files (sockets are files), though every other environment is dropped without `close`.
"""

from __future__ import annotations

import gc
import os
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import ce_gym

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
NUM_ENVS = 64
"""Robots in a batch."""
STEPS = 150
"""Control steps in one environment before the next."""
EPISODE = 60
"""Control steps until time is up."""
SPOIL_EVERY = 25
"""Control steps from one spoilt robot to the next."""
WARM_UP = 2
"""Rounds through all environments before memory is first looked at."""
GROWTH = 24.0
"""How much the process may grow after that, allocators being what they are [MiB]."""


@dataclass
class Account:
    """What happened in one environment.

    Attributes:
        steps: Control steps of robots.
        episodes: Episodes that have ended.
        spoilt: Robots that were made to diverge.
        diverged: Robots that were flagged.
        complaints: Errors found, one line each.
    """

    steps: int = 0
    episodes: int = 0
    spoilt: int = 0
    diverged: int = 0
    complaints: list[str] = field(default_factory=list)


@pytest.mark.stress
def test_environments_for_long(minutes: float):
    accounts = {name: Account() for name in sorted(ce_gym.environment_ids())}
    soaked(accounts, minutes)


@pytest.mark.slow
def test_an_environment_for_seconds():
    soaked({"ce_gym/MiniCheetahVelocity-v0": Account()}, 0.05)


def soaked(accounts: dict[str, Account], minutes: float) -> None:
    """Go through environments until time is up, at least `WARM_UP + 1` times, and check all accounts."""
    rng, memory, held = np.random.default_rng(0), list[float](), list[int]()
    end = time.monotonic() + 60 * minutes
    while len(memory) <= WARM_UP or time.monotonic() < end:
        for name, account in accounts.items():
            soak(name, STEPS, rng, account)
        gc.collect()
        memory.append(resident_memory())
        held.append(threading.active_count() + len(os.listdir("/proc/self/fd")))
    assert not [text for account in accounts.values() for text in account.complaints]
    assert all(account.spoilt == account.diverged > 0 for account in accounts.values())
    assert max(memory[WARM_UP:]) - memory[WARM_UP] <= GROWTH
    assert max(held[WARM_UP:]) <= held[WARM_UP]


def resident_memory() -> float:
    """Return the resident memory of this process [MiB]."""
    (line,) = [text for text in Path("/proc/self/status").read_text().splitlines() if text.startswith("VmRSS:")]
    return int(line.split()[1]) / 1024


def soak(env_id: str, steps: int, rng: np.random.Generator, account: Account) -> None:
    """Take `steps` control steps in a fresh batch of one environment, and count errors and episodes."""
    mode = str(rng.choice(["SameStep", "NextStep"]))
    made: dict[str, Any] = {"num_envs": NUM_ENVS, "max_episode_steps": EPISODE, "num_threads": int(rng.integers(1, 3))}
    envs: Any = gymnasium.make_vec(env_id, autoreset_mode=mode, **made).unwrapped
    envs.reset(seed=int(rng.integers(2**31)))
    length, over, diverged = np.zeros(NUM_ENVS, int), np.zeros(NUM_ENVS, bool), 0
    for step in range(steps):
        ignored = over if mode == "NextStep" else np.zeros(NUM_ENVS, bool)
        victims = spoil(envs, rng, ignored) if step % SPOIL_EVERY == SPOIL_EVERY - 1 else np.zeros(NUM_ENVS, bool)
        actions = rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        observation, reward, terminated, truncated, infos = envs.step(actions)
        length = np.where(ignored, 0, length + 1)
        over = terminated | truncated
        if not (np.isfinite(observation).all() and np.isfinite(reward).all()):
            account.complaints.append(f"{env_id}: step {step} shows a number that is not finite")
        if not np.array_equal(infos["diverged"], victims):
            account.complaints.append(f"{env_id}: step {step} flags robots {np.flatnonzero(infos['diverged'])}")
        if over.any():
            wrong = inconsistent(infos["episode_terms"], over, length, victims)
            account.complaints += [f"{env_id}: {text}" for text in wrong]
        account.steps += NUM_ENVS
        account.episodes += int(over.sum())
        account.spoilt += int(victims.sum())
        diverged += int(infos["diverged"].sum())
        length[over] = 0
    account.diverged += diverged
    if envs.n_diverged != diverged:
        account.complaints.append(f"{env_id}: n_diverged is {envs.n_diverged} after {diverged} flags")
    if rng.random() < 0.5:  # others are dropped without closing
        envs.close()


def spoil(envs: Any, rng: np.random.Generator, spared: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Make some robots of a batch diverge in their next step; returns which, shape (num_envs,)."""
    victims = (rng.random(NUM_ENVS) < 0.05) & ~spared
    velocity = envs.batch.rows("v")
    velocity[victims, rng.integers(velocity.shape[1])] = rng.choice([np.nan, np.inf, 1e9])
    envs.batch.write("v", velocity, victims)
    return victims


def inconsistent(
    terms: dict[str, NDArray], over: NDArray[np.bool_], length: NDArray, spoilt: NDArray[np.bool_]
) -> list[str]:
    """Return errors in the statistics of the episodes that have just ended."""
    wrong = []
    if not np.array_equal(terms["length"], length * over):
        wrong.append(f"lengths {terms['length'][over]} of episodes of {length[over]}")
    if not all(np.isfinite(values).all() for values in terms.values()):
        wrong.append("sums of an episode that are not finite")
    parts = sum(values for name, values in terms.items() if name.startswith("reward/"))
    below = terms["return"] < np.asarray(parts) - 1e-6 * (1 + np.abs(parts))  # above only where negative sums count 0
    if (below & ~spoilt).any():
        wrong.append("a return below the sum of its terms")
    if any((values[~over] != 0).any() for values in terms.values()):
        wrong.append("sums of an episode that has not ended")
    return wrong
