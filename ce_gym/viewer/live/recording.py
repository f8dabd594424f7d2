"""A recording of a session: a rollout of each robot, written as files and as one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.viewer.live.robot import LiveRobot
from ce_gym.viewer.page.html import write_html
from ce_gym.viewer.rollouts.recording import Recorder, robot_reference

Array = NDArray[np.float64]


class LiveRecording:
    """Collects frames of the robots of a session."""

    def __init__(self, robots: Sequence[LiveRobot]) -> None:
        self._dt = robots[0].dt
        self._recorders = [
            Recorder(
                robot_reference(robot.model.robot),
                robot.model.transmission,
                robot.dt,
                label=robot.model.transmission,
                terrain=robot.terrain,
                scan=robot.scan,
            )
            for robot in robots
        ]

    def add(self, frames: Sequence[Mapping[str, Array]]) -> None:
        """Append a frame of each robot, see `LiveRobot.frame`."""
        for recorder, frame in zip(self._recorders, frames, strict=True):
            time = len(recorder) * self._dt
            recorder.add(time, frame["q"], frame["v"], command=frame["command"], torque=frame["torque"])

    def write(self, folder: Path) -> Path | None:
        """Write the rollouts and their page; return the page, or None without frames."""
        if not len(self._recorders[0]):
            return None
        page = _unused(folder)
        rollouts = [recorder.rollout() for recorder in self._recorders]
        for rollout in rollouts:
            rollout.save(page.with_name(f"{page.stem}_{rollout.transmission}.npz"))
        return write_html(rollouts, page, spacing=0.0)


def _unused(folder: Path) -> Path:
    """Return an unused name of a page."""
    number = 1
    while (page := folder / f"live_{number}.html").exists():
        number += 1
    return page
