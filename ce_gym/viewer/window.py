"""The window of `render_mode="human"`: a page on the loopback interface that receives each new pose."""

from __future__ import annotations

import time
import weakref
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.page.html import filled, packed_commands
from ce_gym.viewer.page.moving import MovingScene
from ce_gym.viewer.server import PageServer
from ce_gym.viewer.stream import Feed

if TYPE_CHECKING:
    from ce_gym.dynamics.model import Model

Array = NDArray[np.float64]


class Window:
    """Shows one robot to every connected browser; without a browser drawing costs almost nothing.

    The first drawing starts the server and prints its address. The server ends with `close`, or with the window.

    Args:
        model: The robot.
        q: Positions in a typical pose, shape (nq,); they set the distance of the camera.
        fps: Poses per second of real time: drawing waits while a browser is connected [1/s].
        terrain: The ground; None for the plane z = 0.

    Raises:
        ViewerError: meshcat is not installed.
    """

    def __init__(self, model: Model, q: Array, *, fps: float, terrain: Terrain | None = None) -> None:
        self._model, self._scene, self._period = model, MovingScene(model, q, terrain=terrain), 1 / fps
        self._feed, self._server, self._due = Feed(), None, 0.0
        self._text = filled(
            "window",
            model.robot.name,
            scripts=("stream",),
            constants={"COMMANDS": packed_commands(self._scene.commands())},
        )

    def draw(self, q: Array) -> None:
        """Show the robot at positions `q`, shape (nq,)."""
        if self._feed.closed:
            return
        if self._server is None:
            self._server = PageServer(self._text, self._feed.events)
            weakref.finalize(self, _stop, self._server, self._feed)
            print(f"watch at {self._server.url}", flush=True)
        if self._scene.send(self._feed, [self._model], [q]):
            time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = max(self._due, time.monotonic() - self._period) + self._period

    def close(self) -> None:
        """Stop the server and free its port; may be called again."""
        self._feed.close()
        if self._server:
            self._server.close()


def _stop(server: PageServer, feed: Feed) -> None:
    feed.close()
    server.stop()
