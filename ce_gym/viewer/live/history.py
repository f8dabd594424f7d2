"""The last seconds of a session."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.coordinates import Layout

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Moment:
    """All robots at one time.

    Attributes:
        time: Time since the start of the session [s].
        poses: Positions of each robot, shape (nq,) each.
        snapshots: Snapshot of each robot.
    """

    time: float
    poses: tuple[Array, ...]
    snapshots: tuple[Any, ...]


class History:
    """Moments of the last `seconds` [s], oldest first."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._moments: deque[Moment] = deque()

    def add(self, moment: Moment) -> None:
        """Append the newest moment and remove moments that are too old."""
        self._moments.append(moment)
        while self._moments[0].time < moment.time - self._seconds:
            self._moments.popleft()

    @property
    def span(self) -> tuple[float, float]:
        """Times of the oldest and the newest moment [s]."""
        return self._moments[0].time, self._moments[-1].time

    def around(self, time: float) -> tuple[Moment, Moment]:
        """Return the moments before and after a time; at an end of the history both are the same."""
        after = min(bisect_left(self._moments, time, key=lambda moment: moment.time), len(self._moments) - 1)
        before = after if self._moments[after].time <= time else max(after - 1, 0)
        return self._moments[before], self._moments[after]

    def return_to(self, time: float) -> Moment:
        """Remove the moments after a time, except the oldest moment; return the last one left."""
        while len(self._moments) > 1 and self._moments[-1].time > time + 1e-9:
            self._moments.pop()
        return self._moments[-1]


def between(before: Moment, after: Moment, time: float, layouts: Iterable[Layout]) -> tuple[Array, ...]:
    """Return the robots' positions at a time between two moments: linear interpolation, quaternions normalised."""
    length = after.time - before.time
    share = 0.0 if length <= 0 else float(np.clip((time - before.time) / length, 0.0, 1.0))
    poses = zip(before.poses, after.poses, layouts, strict=True)
    return tuple(_blend(a, b, share, layout) for a, b, layout in poses)


def _blend(a: Array, b: Array, share: float, layout: Layout) -> Array:
    toward, quaternions = b.copy(), [slice(row, row + 4) for row, _ in layout.turns]
    for part in quaternions:
        if a[part] @ b[part] < 0:  # the same orientation
            toward[part] *= -1
    blended = (1 - share) * a + share * toward
    for part in quaternions:
        blended[part] /= np.linalg.norm(blended[part])
    return blended
