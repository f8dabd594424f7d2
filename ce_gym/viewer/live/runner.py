"""A session in real time: a thread processes the page's requests, advances the session and sends its poses."""

from __future__ import annotations

import contextlib
import queue
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from ce_gym.model.options import flag, one_of
from ce_gym.viewer.live.messages import checked, parsed, request_of
from ce_gym.viewer.live.robot import RANGES, LiveRobot
from ce_gym.viewer.live.session import Session
from ce_gym.viewer.live.setup import GROUNDS, LEVELS, Setup, policies_for
from ce_gym.viewer.page.html import filled, packed_commands
from ce_gym.viewer.page.moving import MovingScene
from ce_gym.viewer.stream import LivePage

RATE = 60.0  # of messages to the page [1/s]
LATEST = 0.1  # longer delays are skipped [s]
MOST_RECORDINGS = 100


class Runner(LivePage):
    """Runs one session until it is closed.

    Args:
        setup: The first setup.
        folder: Where recordings are written.

    Attributes:
        session: The session.
        scene: Its scene.
        offered: Policies that the page offers: the first one, and the shipped policies of the robot.
    """

    def __init__(self, setup: Setup, folder: Path) -> None:
        super().__init__("live")
        self._setup, self._folder = setup, folder
        self.session = Session(setup.robots())
        robot = self.session.robots[0]
        self.offered = policies_for(robot.model.robot.name, [setup.policy])
        self.scene = MovingScene(robot.model, robot.model.standing_q, 2, robot.terrain, robot.scan)
        self._requests: queue.SimpleQueue[Callable[[Session], None]] = queue.SimpleQueue()
        self._rate, self._last = 1.0, time.monotonic()
        self._recordings = 0

    def html(self) -> str:
        """Return the live page."""
        policies = [(name, Path(name).stem if Path(name).suffix else name) for name in self.offered]
        levels = [(name, name) for name in LEVELS]
        choices = {
            "policy": [*policies, ("", "none: hold the pose")],
            "transmission": levels,
            "ghost": [("", "none"), *levels],
            "terrain": [(name, name) for name in GROUNDS],
        }
        bodies = {path: name for name, path in self.scene.paths[0].items()}
        return filled(
            "live",
            self.scene.robot.name,
            scripts=("belts", "overlays", "stream", "live"),
            constants={
                "COMMANDS": packed_commands(self.scene.commands()),
                "OFFER": {"choices": choices, "figures": RANGES, "bodies": bodies},
            },
        )

    def close(self) -> None:
        """Stop the threads, wait until they have ended, and close the environments."""
        super().close()
        self.session.close()

    def receive(self, body: bytes) -> None:
        """Take a message of the page; see `messages`, and `choose` and `record` here.

        Raises:
            ValueError: The message is not a valid request.
        """
        message = parsed(body)
        if message.get("do") == "choose":
            self._requests.put(self._choice(message))
        elif message.get("do") == "record":
            on = flag("on", checked(message, {"on": flag}).get("on"))
            self._requests.put(self._start_recording if on else self._write_recording)
        else:
            self._requests.put(request_of(message))

    def _choice(self, message: dict[str, Any]) -> Callable[[Session], None]:
        """Return the request for another policy, level, ghost or ground."""
        choices = {"policy": ["", *self.offered], "transmission": LEVELS, "ghost": ("", *LEVELS), "terrain": GROUNDS}
        changes = checked(message, {name: one_of(known) for name, known in choices.items()})
        return lambda _: self._prepare_robots(changes)

    def _prepare_robots(self, changes: dict[str, str]) -> None:
        if self._job is None:
            setup = self._setup.changed(changes)
            self._job = self._background.submit(lambda: (setup, setup.robots()))

    def _replace_robots(self, setup: Setup, robots: list[LiveRobot]) -> None:
        """Continue with other robots in the state of the present one, on other ground where they stand."""
        old, same_ground = self.session.robots, setup.terrain == self._setup.terrain
        for robot in robots:
            robot.set_figures(old[0].figures)
            if same_ground:
                robot.write(*old[0].state())
            elif robot is not robots[0]:
                robot.write(*robots[0].state())
        self.session.take(robots)
        self.scene.set_ground(robots[0].terrain, robots[0].scan)
        self._setup = setup
        for robot in old:
            robot.close()

    def _start_recording(self, session: Session) -> None:
        if self._recordings < MOST_RECORDINGS:
            session.record(True)
        else:
            self.notice = f"{MOST_RECORDINGS} recordings are written; start the page again for more"

    def _write_recording(self, session: Session) -> None:
        recording = session.record(False)
        self._recordings += recording is not None

        def write() -> None:
            try:
                self.notice = f"written: {recording.write(self._folder)}" if recording else ""
            except (OSError, RuntimeError) as error:
                self.notice = str(error)

        self._background.submit(write)

    def update(self) -> float:
        """Process requests, advance the session, and send the poses; return the time until the next update [s]."""
        self.process_requests()
        now = time.monotonic()
        passed, self._last = now - self._last, now
        share = min(passed, LATEST) / passed if passed > 0 else 1.0
        self._rate += 0.02 * (share - self._rate)
        self.session.advance(min(passed, LATEST))
        models = [robot.model for robot in self.session.robots]
        self.scene.send(self.feed, models, self.session.poses(), self.state())
        return 1 / RATE

    def process_requests(self) -> None:
        """Replace the robots if new ones are ready, and carry out the requests of the page."""
        if ready := self._finished_job():
            self._replace_robots(*ready)
        with contextlib.suppress(queue.Empty):
            while True:
                self._requests.get_nowait()(self.session)

    def state(self) -> dict[str, Any]:
        """Return the state that the page shows as text."""
        session = self.session
        kept, back = session.past
        q, v = session.robots[0].state()
        return {
            "time": round(session.time, 3),
            "command": session.command.round(3).tolist(),
            "base": {"place": q[:3].round(4).tolist(), "velocity": v[3:6].round(4).tolist()},
            "paused": session.paused,
            "speed": session.speed,
            "kept": round(kept, 2),
            "back": round(back, 2),
            "rate": round(self._rate, 2),
            "ghost": len(session.robots) > 1,
            "flat": session.robots[0].terrain is None,
            "figures": session.robots[0].figures,
            "pulled": session.pulled,
            "recording": session.recording is not None,
            "making": self._job is not None,
            "notice": self.notice,
            "setup": {f.name: getattr(self._setup, f.name) for f in fields(self._setup) if f.name != "kwargs"},
        }
