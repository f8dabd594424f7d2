"""Honest timing: competitors take turns in one run, so that a change of the machine's pace meets them all."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ce_gym.console import progress


@dataclass(frozen=True)
class Competitor:
    """Something to time.

    Attributes:
        run: Does the work once.
        work: Units of work in one call, such as robots times sub-steps.
    """

    run: Callable[[], object]
    work: int = 1


@dataclass(frozen=True)
class Timing:
    """Seconds for one unit of work, one figure for each round.

    Attributes:
        seconds: In the order of the rounds [s].
    """

    seconds: tuple[float, ...]

    @property
    def best(self) -> float:
        """The fastest round [s], the one least disturbed by other processes."""
        return min(self.seconds)

    @property
    def median(self) -> float:
        """The median round [s]."""
        return statistics.median(self.seconds)


@dataclass(frozen=True)
class Ratio:
    """How many times as long one competitor takes as another.

    Attributes:
        of_best: The best round of one against the best round of the other.
        median: Median over rounds, each compared with the same round of the other.
        lowest: Smallest of those.
        highest: Largest of those.
    """

    of_best: float
    median: float
    lowest: float
    highest: float

    @property
    def cautious(self) -> float:
        """The smaller of the two estimates."""
        return min(self.of_best, self.median)

    def __str__(self) -> str:
        return f"{self.of_best:.3g}; by rounds {self.median:.3g} ({self.lowest:.3g} to {self.highest:.3g})"


def interleaved(
    competitors: Mapping[str, Competitor], rounds: int = 7, clock: Callable[[], float] = time.perf_counter
) -> dict[str, Timing]:
    """Time competitors in turn.

    Args:
        competitors: By name. Each runs once untimed first.
        rounds: How often each is timed.
        clock: `time.perf_counter` for elapsed time, or `time.thread_time` for work that stays on the calling thread, on
            a machine that others use too.

    Returns:
        Timing of one unit of work, by name.
    """
    for competitor in progress(competitors.values(), "first run"):
        competitor.run()
    seconds: dict[str, list[float]] = {name: [] for name in competitors}
    for _ in progress(range(rounds), "rounds"):
        for name, competitor in competitors.items():
            start = clock()
            competitor.run()
            seconds[name].append((clock() - start) / competitor.work)
    return {name: Timing(tuple(values)) for name, values in seconds.items()}


def ratio(slow: Timing, fast: Timing) -> Ratio:
    """Compare two timings of one `interleaved` run."""
    ratios = [a / b for a, b in zip(slow.seconds, fast.seconds, strict=True)]
    return Ratio(slow.best / fast.best, statistics.median(ratios), min(ratios), max(ratios))
