"""A session in real time: a thread steps it, answers the page's requests and sends poses, 60 times a second.

Compiling another scene and writing a recording take seconds; another thread does that.
"""

from __future__ import annotations

import contextlib
import json
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any

from ce_gym.viewer.feed import Feed
from ce_gym.viewer.live.messages import parsed, request_of
from ce_gym.viewer.live.session import Session
from ce_gym.viewer.live.setup import GROUNDS, LEVELS, Setup, policies_for
from ce_gym.viewer.page.moving import MovingScene

RATE = 60.0  # of what is sent [1/s]
LATEST = 0.1  # a longer delay is dropped, not caught up with [s]


class Runner:
    """Runs one session until it is closed.

    Args:
        setup: The first setup.
        folder: Where recordings are written.

    Attributes:
        feed: The events that the page receives.
        offered: Policies that the page may choose: the first one, and those that ship for the robot.
    """

    def __init__(self, setup: Setup, folder: Path) -> None:
        self._setup, self._folder = setup, folder
        self.session = Session(setup.robots())
        first = self.session.robots[0]
        self.offered = policies_for(first.model.robot.name, [setup.policy])
        self.scene = MovingScene(first.model, first.model.standing_q, 2, first.terrain, first.scan)
        self.feed, self._requests, self._notice = Feed(), queue.SimpleQueue[Callable[[Session], None]](), ""
        self._rate, self._ended = 1.0, threading.Event()
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="live")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._making: Future[list[Any]] | None = None

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread, and wait until it has ended."""
        self._ended.set()
        self.feed.close()
        if self._thread.is_alive():
            self._thread.join()
        self._beside.shutdown(cancel_futures=True)
        self.session.close()

    def receive(self, body: bytes) -> None:
        """Take a message of the page; see `messages`, and `choose` and `record` here.

        Raises:
            ValueError: If it is not a valid request.
        """
        message = parsed(body)
        if message.get("do") == "choose":
            self._requests.put(self._choice(message))
        elif message.get("do") == "record":
            self._requests.put(self._record if message.get("on") is True else self._keep)
        else:
            self._requests.put(request_of(message))

    def _choice(self, message: dict[str, Any]) -> Callable[[Session], None]:
        """Return the request for another policy, level, ghost or ground."""
        allowed = {"policy": ["", *self.offered], "transmission": LEVELS, "ghost": ("", *LEVELS), "terrain": GROUNDS}
        given = {name: value for name, value in message.items() if name != "do"}
        for name, value in given.items():
            if name not in allowed or value not in allowed[name]:
                expected = ", ".join(map(repr, allowed.get(name, allowed)))
                raise ValueError(f"{name}={value!r}; expected one of {expected}")
        return lambda _: self._make(given)

    def _make(self, changes: dict[str, str]) -> None:
        if self._making is None:
            wanted = self._setup.changed(changes)
            self._making = self._beside.submit(lambda: [wanted, wanted.robots()])

    def _take(self) -> None:
        """Replace the robots if others have been made."""
        if self._making is None or not self._making.done():
            return
        making, self._making = self._making, None
        try:
            wanted, robots = making.result()
        except Exception as problem:  # the page keeps the robots it has
            self._notice = str(problem)
            return
        old, same_ground = self.session.robots, wanted.terrain == self._setup.terrain
        for robot in robots:
            robot.set_figures(old[0].figures)
            if same_ground:
                robot.write(*old[0].state())
            elif robot is not robots[0]:
                robot.write(*robots[0].state())
        self.session.take(robots)
        self.scene.stand_on(robots[0].terrain, robots[0].scan)
        self._setup, self._notice = wanted, ""
        for robot in old:
            robot.close()

    def _record(self, session: Session) -> None:
        session.record(True)

    def _keep(self, session: Session) -> None:
        recording = session.record(False)

        def write() -> None:
            try:
                self._notice = f"written: {recording.write(self._folder)}" if recording else ""
            except (OSError, RuntimeError) as problem:
                self._notice = str(problem)

        self._beside.submit(write)

    def _run(self) -> None:
        last = due = time.monotonic()
        while not self._ended.is_set():
            self._answer()
            now = time.monotonic()
            passed, last = now - last, now
            share = min(passed, LATEST) / passed if passed > 0 else 1.0
            self._rate += 0.02 * (share - self._rate)
            self.session.advance(min(passed, LATEST))
            self._send()
            due = max(due + 1 / RATE, time.monotonic())
            self._ended.wait(due - time.monotonic())

    def _answer(self) -> None:
        self._take()
        with contextlib.suppress(queue.Empty):
            while True:
                self._requests.get_nowait()(self.session)

    def _send(self) -> None:
        session = self.session
        moves = self.scene.moves([robot.model for robot in session.robots], session.poses())
        if ground := self.scene.new_ground(moves):
            self.feed.keep("ground", ground)
        self.feed.publish(f"data: {json.dumps({'moves': moves, 'state': self.state()})}\n\n".encode())

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
            "making": self._making is not None,
            "notice": self._notice,
            "setup": {f.name: getattr(self._setup, f.name) for f in fields(self._setup) if f.name != "kwargs"},
        }
