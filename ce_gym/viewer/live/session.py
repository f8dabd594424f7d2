"""The simulation of a live page, without clock, thread or browser.

`advance` steps the driven robot and its ghost: a robot at another transmission level with the same commands and pulls.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.viewer.live.history import History, Moment, between
from ce_gym.viewer.live.pull import pulled
from ce_gym.viewer.live.recording import LiveRecording
from ce_gym.viewer.live.robot import LiveRobot

Array = NDArray[np.float64]

REMEMBERED = 30.0  # length of the history [s]
THROW = (0.0, 0.0, 2.5)  # change of velocity [m/s]
DROP = 0.5  # height from which `drop` lets the robot fall [m]


class Session:
    """Robots under one command.

    Args:
        robots: The driven robot, and optionally its ghost.

    Attributes:
        robots: The same robots.
        command: Forward [m/s], sideways [m/s], yaw rate [rad/s].
        paused: Whether the simulation is paused.
        speed: Seconds of simulation per second.
        time: Time of the shown moment [s].
    """

    def __init__(self, robots: list[LiveRobot]) -> None:
        self.command, self.paused, self.speed, self.time = np.zeros(3), False, 1.0, 0.0
        self._drag: tuple[str, Array, Array] | None = None
        self.recording: LiveRecording | None = None
        self.take(robots)

    def take(self, robots: list[LiveRobot]) -> None:
        """Replace the robots, and clear history and recording."""
        self.robots, self.dt = robots, robots[0].dt
        self._steps = 0
        self._start = self.time
        self._history = History(REMEMBERED)
        self.recording = None
        self._remember()

    def advance(self, seconds: float) -> None:
        """Simulate some real time [s], scaled by `speed`."""
        if self.paused:
            return
        self.time += seconds * self.speed
        while self._simulated < self.time:
            self._step()

    def step_once(self) -> None:
        """Simulate one control step, and pause."""
        self.pause(True)
        self._continue_here()
        self._step()
        self.time = self._simulated

    def set_speed(self, speed: float) -> None:
        """Set the seconds of simulation per second."""
        self.speed = speed

    def pause(self, on: bool) -> None:
        """Pause, or continue from the shown moment."""
        if not on and self.paused:
            self._continue_here()
        self.paused = on

    def look_back(self, seconds: float) -> None:
        """Pause, and show the moment `seconds` before the newest one [s]."""
        self.paused = True
        first, last = self._history.span
        self.time = float(np.clip(last - seconds, first, last))

    @property
    def past(self) -> tuple[float, float]:
        """Length of the history, and age of the shown moment [s]."""
        first, last = self._history.span
        return last - first, max(last - self.time, 0.0)

    @property
    def _simulated(self) -> float:
        return self._start + self._steps * self.dt

    def _continue_here(self) -> None:
        """Return to the shown moment, if it is not the newest."""
        moment = self._history.return_to(self.time)
        if moment.time < self._simulated - self.dt / 2:
            for robot, snapshot in zip(self.robots, moment.snapshots, strict=True):
                robot.restore(snapshot)
            self._start, self._steps, self.recording = moment.time, 0, None
        self.time = self._simulated

    def _step(self) -> None:
        self._pull()
        for robot in self.robots:
            robot.step(self.command)
        self._steps += 1
        self._remember()
        if self.recording:
            self.recording.add([robot.frame() for robot in self.robots])

    def _remember(self) -> None:
        poses = tuple(robot.state()[0] for robot in self.robots)
        self._history.add(Moment(self._simulated, poses, tuple(robot.snapshot() for robot in self.robots)))

    def poses(self) -> tuple[Array, ...]:
        """Return the positions to show, at most one control step old, shape (nq,) each."""
        shown = self.time if self.paused else self.time - self.dt
        return between(*self._history.around(shown), shown, [robot.model.robot.layout for robot in self.robots])

    def drive(self, shares: ArrayLike) -> None:
        """Command shares (-1 to 1) of the task's largest forward, sideways and turning speeds."""
        low, high = self.robots[0].command_range.T
        shares = np.clip(np.asarray(shares, float), -1.0, 1.0)
        self.command = np.where(shares < 0, -shares * low, shares * high)

    def drag(self, body: str, point: ArrayLike, target: ArrayLike) -> None:
        """Pull a point of a body, in its frame [m], towards a place in the world [m], until `release`."""
        if body not in self.robots[0].model.body_names:
            return
        self._drag = body, np.asarray(point, float), np.asarray(target, float)

    @property
    def pulled(self) -> str | None:
        """Name of the pulled body."""
        return self._drag[0] if self._drag else None

    def release(self) -> None:
        """End the pull."""
        self._drag = None

    def _pull(self) -> None:
        """Apply the pull of a control step."""
        if self._drag:
            for robot in self.robots:
                q, v = robot.state()
                robot.write(q, pulled(robot.model, q, v, self.dt, *self._drag))

    def throw(self) -> None:
        """Throw the robots into the air."""
        for robot in self.robots:
            q, v = robot.state()
            v[3:6] += robot.model.body_poses(q)[1][0].T @ THROW
            robot.write(q, v)

    def drop(self) -> None:
        """Lift the robots by `DROP` and stop them in the air, from where they fall."""
        for robot in self.robots:
            q, v = robot.state()
            q[2] += DROP
            robot.write(q, 0 * v)

    def align_ghost(self) -> None:
        """Move the ghost to the robot."""
        q, v = self.robots[0].state()
        for ghost in self.robots[1:]:
            ghost.write(q, v)

    def reset(self) -> None:
        """Put all robots into the standing pose, in one place."""
        for robot in self.robots:
            robot.reset()
        self.align_ghost()

    def set_figures(self, figures: Mapping[str, float]) -> None:
        """Change friction or added mass; see `live.robot.RANGES`."""
        for robot in self.robots:
            robot.set_figures(figures)

    def record(self, on: bool) -> LiveRecording | None:
        """Start a recording, or end it and return it."""
        done, self.recording = self.recording, LiveRecording(self.robots) if on else None
        return None if on else done

    def close(self) -> None:
        """Close the environments."""
        for robot in self.robots:
            robot.close()
