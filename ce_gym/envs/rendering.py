"""What `render` shows: environments ask for a render mode, the top of the package says where its renderer is.

The packages that draw depend on this one, so this file cannot import them: `use_renderers` registers the name of a
module with a function for each render mode, which is imported when an environment is made with a render mode.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Protocol

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from ce_gym.envs.runtime.batch import TaskBatch
from ce_gym.envs.task.terrain_tiles import field_of
from ce_gym.sim.arguments import check_whole

RENDER_MODES = ("human", "rgb_array")

_home: list[str] = []  # the module of the renderers, once it is known


class Renderer(Protocol):
    """Shows one robot."""

    def draw(self, q: NDArray[np.float64]) -> NDArray[np.uint8] | None:
        """Show the robot at positions `q`, shape (nq,); return a picture, shape (height, width, 3), if it is one."""
        ...

    def close(self) -> None:
        """Give back whatever is held; harmless if done before."""
        ...


def use_renderers(module: str) -> None:
    """Say where renderers are.

    Args:
        module: Name of a module with a function for each render mode, which takes a model, positions in a typical
            pose, shape (nq,), and the keywords width [pixels], height [pixels], fps [1/s] and terrain (None if flat),
            and returns a `Renderer`.
    """
    _home[:] = [module]


class Screen:
    """Shows the robots of a batch in one render mode.

    Args:
        mode: "human", "rgb_array" or None.
        batch: The environments.
        width: Of a picture [pixels].
        height: Of a picture [pixels].

    Raises:
        ValueError: If there is no such mode, or the size is not positive.
        ViewerError: If what the mode needs is not installed.
    """

    def __init__(self, mode: str | None, batch: TaskBatch, *, width: int, height: int) -> None:
        if mode is not None and mode not in RENDER_MODES:
            raise ValueError(f"render_mode={mode!r}; expected one of {', '.join(RENDER_MODES)}, or None")
        for name, value in (("width", width), ("height", height)):
            check_whole(name, value, 1, " of pixels")
        self._mode, self._batch = mode, batch
        self._renderer: Renderer | None = None
        if mode is not None:
            model, fps = batch.program.model, 1 / batch.program.control_dt
            make: Any = getattr(import_module(_home[0]), mode)
            ground = field_of(batch.program.task.terrain)
            self._renderer = make(
                model, model.standing_q, width=int(width), height=int(height), fps=fps, terrain=ground
            )

    def frames(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each environment; or show the first one and return None."""
        if self._renderer is None:
            logger.warn(f"render() does nothing without a render mode; make the environment with one of {RENDER_MODES}")
            return None
        q = self._batch.rows("q").astype(float)
        if self._mode == "human":
            self._renderer.draw(q[0])
            return None
        pictures = [self._renderer.draw(row) for row in q]
        return tuple(picture for picture in pictures if picture is not None)

    def refresh(self) -> None:
        """Show the new state in mode "human", which Gymnasium expects to draw by itself."""
        if self._mode == "human":
            self.frames()

    def close(self) -> None:
        """Give back whatever the renderer holds; harmless if done before."""
        if self._renderer is not None:
            self._renderer.close()
