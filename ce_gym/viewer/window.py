"""A live window: meshcat's page, served on the loopback interface, that receives each new pose.

No browser is opened and no call waits for one; without a connected browser drawing costs almost nothing.
"""

from __future__ import annotations

import json
import time
import weakref
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.feed import Feed
from ce_gym.viewer.page.html import filled
from ce_gym.viewer.page.moving import MovingScene
from ce_gym.viewer.page.poses import PosedModel
from ce_gym.viewer.server import PageServer

Array = NDArray[np.float64]

_PAGE = Path(__file__).with_name("window.html")


class Window:
    """Shows one robot to every browser that looks.

    The address is printed when the window is first drawn into; a server runs until `close`, or until the window is
    dropped.

    Args:
        model: The robot and its forward kinematics.
        q: Positions in a typical pose, shape (nq,); they set how far the camera is away.
        fps: Poses in a second of real time: drawing waits for it while a browser is connected [1/s].
        terrain: The ground, the plane z = 0 if None.

    Raises:
        ViewerError: meshcat is not installed.
    """

    def __init__(self, model: PosedModel, q: Array, *, fps: float, terrain: Terrain | None = None) -> None:
        self._model, self._scene, self._period = model, MovingScene(model, q, terrain=terrain), 1 / fps
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
        moves = self._scene.moves([self._model], [q])
        if ground := self._scene.new_ground(moves):
            self._feed.keep("ground", ground)
        if self._feed.publish(f"data: {json.dumps(moves)}\n\n".encode()):
            time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = max(self._due, time.monotonic() - self._period) + self._period

    def close(self) -> None:
        """Stop the server and free its port; harmless if done before."""
        self._feed.close()
        if self._server:
            self._server.close()

    def _page(self) -> str:
        return filled(_PAGE, self._scene.robot.name, commands=json.dumps(self._scene.commands()))


def _stop(server: PageServer, feed: Feed) -> None:
    feed.close()
    server.stop()
