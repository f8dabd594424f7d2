"""A live window: meshcat's page at this machine's loopback, to which poses are sent as they come.

Nothing is opened and nothing waits: where no browser looks, drawing costs next to nothing.
"""

from __future__ import annotations

import base64
import html
import json
import string
import threading
import time
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.live import PageServer
from ce_gym.viewer.page import three
from ce_gym.viewer.page.html import meshcat_code, source
from ce_gym.viewer.page.lights_and_camera import HORIZON, TILE, camera_commands, eye, field_command, stage_commands
from ce_gym.viewer.page.poses import PosedModel
from ce_gym.viewer.page.robot import body_paths, extent, robot_commands
from ce_gym.viewer.rollouts.ground_patch import around, level, reach

Array = NDArray[np.float64]

_PAGE = Path(__file__).with_name("window.html")
_ROBOT, _STAGE, _FIELD = "/robot", "/stage", "/robot/ground"
BLOCK = 4.0  # edge of the squares of the world that share a piece of ground that is not flat [m]


class Window:
    """Shows one robot to every browser that looks.

    The address is printed when the window is first drawn into; a server runs until `close`, or until the window is
    dropped.

    Args:
        model: The robot and its forward kinematics.
        q: Positions in a typical pose, shape (nq,); they set how far the camera is away.
        fps: Poses in a second of real time: drawing waits for it while somebody looks [1/s].
        terrain: The ground, the plane z = 0 if None.

    Raises:
        ViewerError: meshcat is not installed.
    """

    def __init__(self, model: PosedModel, q: Array, *, fps: float, terrain: Terrain | None = None) -> None:
        self._model, self._robot, self._period = model, model.robot, 1 / fps
        self._paths = body_paths(self._robot, _ROBOT)
        self._index = {body.name: model.body_names.index(body.name) for body in self._robot.bodies}
        positions, rotations = (np.asarray(rows[0]) for rows in model.body_poses(np.asarray(q, float)[None]))
        order = list(self._index.values())
        low, high = extent(self._robot, positions[order], rotations[order])
        self._radius, self._terrain = max(float(np.linalg.norm(high - low)) / 2, 0.05), terrain
        self._block: tuple[int, int] | None = None  # the piece of ground that the page has
        self._middle, self._height = (low + high)[:2] / 2, float(low[2] + high[2]) / 2
        self._text = self._page()
        self._feed, self._due = Feed(), 0.0
        self._server: PageServer | None = None

    @property
    def url(self) -> str | None:
        """Address of the page, once something has been drawn."""
        return self._server.url if self._server else None

    def draw(self, q: Array) -> None:
        """Show the robot at positions `q`, shape (nq,)."""
        if self._feed.closed:
            return
        if self._server is None:
            self._server = PageServer(self._text, self._feed.events)
            weakref.finalize(self, _stop, self._server, self._feed)  # a window that is dropped leaves nothing behind
            print(f"watch at {self.url}", flush=True)
        positions, rotations = (np.asarray(rows[0]) for rows in self._model.body_poses(np.asarray(q, float)[None]))
        event = f"data: {json.dumps(self._moves(positions, rotations))}\n\n".encode()
        self._look_around(self._place(positions))
        if self._feed.publish(event):
            time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = max(self._due, time.monotonic() - self._period) + self._period

    def close(self) -> None:
        """Stop the server and free its port; harmless if done before."""
        self._feed.close()
        if self._server:
            self._server.close()

    def _page(self) -> str:
        code = meshcat_code()
        here, flat = np.zeros(2), self._terrain is None
        commands = [*robot_commands(self._robot, _ROBOT)]
        commands += stage_commands(here, here, root=_STAGE, radius=self._radius, flat=flat)
        commands += camera_commands(eye(self._radius))
        packed = [base64.b64encode(three.pack(command)).decode() for command in commands]
        return string.Template(_PAGE.read_text(encoding="utf-8")).substitute(
            title=html.escape(self._robot.name),
            meshcat=code,
            ground=source("ground.js"),
            commands=json.dumps(packed),
            horizon=three.hex_color(HORIZON),
        )

    def _moves(self, positions: Array, rotations: Array) -> dict[str, list[float]]:
        """Return the matrix of each path that moves: bodies against their parents, the world under the camera."""
        poses = {name: three.transform(positions[i], rotations[i]) for name, i in self._index.items()}
        x, y = place = self._place(positions)
        z = level(self._terrain, place[None], self._radius / 2)[0]
        matrices = {
            _ROBOT: three.transform([-x, -y, -self._height - z]),
            _STAGE: three.transform([-(x % TILE), -(y % TILE), -self._height]),  # the same everywhere, so it never ends
        }
        for body in self._robot.bodies:
            pose = poses[body.name]
            matrices[self._paths[body.name]] = pose if body.parent is None else np.linalg.inv(poses[body.parent]) @ pose
        return {path: np.round(matrix.T.ravel(), 6).tolist() for path, matrix in matrices.items()}

    def _place(self, positions: Array) -> Array:
        """Return where the robot is [m], shape (2,)."""
        return positions[self._index[self._robot.bodies[0].name], :2] if self._robot.floating else self._middle

    def _look_around(self, place: Array) -> None:
        """Let the page have the ground around a place [m], shape (2,), if it is not flat and new to it."""
        row, column = np.floor(place / BLOCK).astype(int).tolist()
        if self._terrain is None or self._block == (row, column):
            return
        block = BLOCK * np.array([[row, column], [row + 1, column + 1]])
        ground = around(self._terrain, block)
        root = self._paths[self._robot.bodies[0].name]
        command = field_command(_FIELD, ground, [root], reach(ground, block))
        self._block = (row, column)
        self._feed.put_ground(f"event: ground\ndata: {json.dumps(command)}\n\n".encode())


def _stop(server: PageServer, feed: Feed) -> None:
    feed.close()
    server.stop()


class Feed:
    """What the browsers of a window are sent: the newest poses, and the ground around them. Knows no window.

    Attributes:
        closed: Whether it has ended.
    """

    def __init__(self) -> None:
        self._news = threading.Condition(threading.RLock())  # a finalizer may close it amid a call
        self._event, self._count, self._watchers = b"", 0, 0
        self._ground, self._grounds = b"", 0
        self.closed = False

    def publish(self, event: bytes) -> bool:
        """Send an event to whoever watches; return whether anybody does."""
        with self._news:
            self._event, self._count = event, self._count + 1
            self._news.notify_all()
            return self._watchers > 0

    def put_ground(self, event: bytes) -> None:
        """Send another piece of ground before the next event."""
        with self._news:
            self._ground, self._grounds = event, self._grounds + 1

    def close(self) -> None:
        """End the stream of every browser."""
        with self._news:
            self.closed = True
            self._news.notify_all()

    def events(self) -> Iterator[bytes]:
        """Yield the newest poses to one browser until the feed is closed."""
        seen = grounds = 0
        with self._news:
            self._watchers += 1
        try:
            while True:
                with self._news:
                    # Without news for a second, an empty line finds out whether the browser is still there.
                    if not self.closed and self._count == seen:
                        self._news.wait(timeout=1.0)
                    if self.closed:
                        return
                    event, seen = (self._event, self._count) if self._count > seen else (b":\n\n", seen)
                    if self._grounds > grounds:
                        event, grounds = self._ground + event, self._grounds
                yield event
        finally:
            with self._news:
                self._watchers -= 1
