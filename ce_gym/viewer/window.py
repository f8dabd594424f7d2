"""A live window: meshcat's page at this machine's loopback, to which poses are sent as they come.

Nothing is opened and nothing waits: where no browser looks, drawing costs next to nothing. Knows posed models, scene
commands and how to serve a page; knows no environments.
"""

from __future__ import annotations

import base64
import contextlib
import html
import json
import string
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.viewer import three
from ce_gym.viewer.actor import PosedModel
from ce_gym.viewer.html import meshcat_code
from ce_gym.viewer.live import serve
from ce_gym.viewer.robot import body_paths, extent, robot_commands
from ce_gym.viewer.stage import HORIZON, TILE, camera_commands, stage_commands

Array = NDArray[np.float64]

_PAGE = Path(__file__).with_name("window.html")
_ROBOT, _STAGE = "/robot", "/stage"


class Window:
    """Shows one robot to every browser that looks.

    The address is printed when the window is first drawn into; a server runs until `close`.

    Args:
        model: The robot and its forward kinematics.
        q: Positions in a typical pose, shape (nq,); they set how far the camera is away.
        fps: Poses in a second of real time: drawing waits for it while somebody looks [1/s].

    Raises:
        ViewerError: meshcat is not installed.
    """

    def __init__(self, model: PosedModel, q: Array, *, fps: float) -> None:
        self._model, self._robot, self._period = model, model.robot, 1 / fps
        self._paths = body_paths(self._robot, _ROBOT)
        self._index = {body.name: model.body_names.index(body.name) for body in self._robot.bodies}
        positions, rotations = (np.asarray(rows[0]) for rows in model.body_poses(np.asarray(q, float)[None]))
        order = list(self._index.values())
        low, high = extent(self._robot, positions[order], rotations[order])
        self._middle, self._height = (low + high)[:2] / 2, float(low[2] + high[2]) / 2
        self._text = self._page(low, high)
        self._news = threading.Condition()
        self._event, self._count, self._watchers, self._closed = b"", 0, 0, False
        self._due = 0.0
        self._running = contextlib.ExitStack()
        self.url: str | None = None

    def draw(self, q: Array) -> None:
        """Show the robot at positions `q`, shape (nq,)."""
        if self._closed:
            return
        if self.url is None:
            self.url = self._running.enter_context(serve(self._text, self._events))
            print(f"watch at {self.url}", flush=True)
        positions, rotations = (np.asarray(rows[0]) for rows in self._model.body_poses(np.asarray(q, float)[None]))
        event = f"data: {json.dumps(self._moves(positions, rotations))}\n\n".encode()
        with self._news:
            self._event, self._count = event, self._count + 1
            self._news.notify_all()
            watched = self._watchers > 0
        if watched:
            time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = max(self._due, time.monotonic() - self._period) + self._period

    def close(self) -> None:
        """Stop the server and free its port; harmless if done before."""
        with self._news:
            self._closed = True
            self._news.notify_all()
        self._running.close()

    def _page(self, low: Array, high: Array) -> str:
        code = meshcat_code()
        radius = max(float(np.linalg.norm(high - low)) / 2, 0.05)
        here = np.zeros(2)
        commands = [*robot_commands(self._robot, _ROBOT), *stage_commands(here, here, root=_STAGE, radius=radius)]
        commands += camera_commands(radius)
        packed = [base64.b64encode(three.pack(command)).decode() for command in commands]
        return string.Template(_PAGE.read_text(encoding="utf-8")).substitute(
            title=html.escape(self._robot.name),
            meshcat=code,
            commands=json.dumps(packed),
            horizon=three.hex_color(HORIZON),
        )

    def _moves(self, positions: Array, rotations: Array) -> dict[str, list[float]]:
        """Return the matrix of each path that moves: bodies against their parents, the world under the camera."""
        poses = {name: three.transform(positions[i], rotations[i]) for name, i in self._index.items()}
        x, y = positions[self._index[self._robot.bodies[0].name], :2] if self._robot.floating else self._middle
        matrices = {
            _ROBOT: three.transform([-x, -y, -self._height]),
            _STAGE: three.transform([-(x % TILE), -(y % TILE), -self._height]),  # the same everywhere, so it never ends
        }
        for body in self._robot.bodies:
            pose = poses[body.name]
            matrices[self._paths[body.name]] = pose if body.parent is None else np.linalg.inv(poses[body.parent]) @ pose
        return {path: np.round(matrix.T.ravel(), 6).tolist() for path, matrix in matrices.items()}

    def _events(self) -> Iterator[bytes]:
        """Yield the newest poses to one browser until the window is closed."""
        seen = 0
        with self._news:
            self._watchers += 1
        try:
            while True:
                with self._news:
                    # Without news for a second, an empty line finds out whether the browser is still there.
                    if not self._closed and self._count == seen:
                        self._news.wait(timeout=1.0)
                    if self._closed:
                        return
                    event, seen = (self._event, self._count) if self._count > seen else (b":\n\n", seen)
                yield event
        finally:
            with self._news:
                self._watchers -= 1
