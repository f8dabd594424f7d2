"""Compare run times: competitors run alternately, so that changes of the machine's speed affect all."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ce_gym.console import progress


@dataclass(frozen=True)
class Competitor:
    """A function to time.

    Attributes:
        run: The function.
        work: Units of work in one call, such as robots times sub-steps.
    """

    run: Callable[[], object]
    work: int = 1


@dataclass(frozen=True)
class Timing:
    """Times for one unit of work.

    Attributes:
        seconds: Time in each round [s].
    """

    seconds: tuple[float, ...]

    @property
    def best(self) -> float:
        """The shortest time [s], which other processes disturb least."""
        return min(self.seconds)

    @property
    def median(self) -> float:
        """The median time [s]."""
        return statistics.median(self.seconds)


@dataclass(frozen=True)
class Ratio:
    """Ratio of the times of two competitors.

    Attributes:
        of_best: Ratio of the shortest times.
        median: Median of the ratios in each round.
        lowest: Smallest ratio of a round.
        highest: Largest ratio of a round.
    """

    of_best: float
    median: float
    lowest: float
    highest: float

    @property
    def cautious(self) -> float:
        """The smaller one of `of_best` and `median`."""
        return min(self.of_best, self.median)

    def __str__(self) -> str:
        return f"{self.of_best:.3g}; by rounds {self.median:.3g} ({self.lowest:.3g} to {self.highest:.3g})"


def interleaved(
    competitors: Mapping[str, Competitor], rounds: int = 7, clock: Callable[[], float] = time.perf_counter
) -> dict[str, Timing]:
    """Time competitors alternately.

    Args:
        competitors: Competitors by name. Each runs once before the timing.
        rounds: Number of timings of each competitor.
        clock: `time.perf_counter` for elapsed time, or `time.thread_time` for the processor time of the calling thread.

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
    """Return the ratio of two timings of one `interleaved` run."""
    ratios = [a / b for a, b in zip(slow.seconds, fast.seconds, strict=True)]
    return Ratio(slow.best / fast.best, statistics.median(ratios), min(ratios), max(ratios))
