"""Rendering of environments by a module that is registered by name.

The viewer depends on this package, so this file cannot import the viewer. `use_renderers` registers the name of a
module, which is imported when an environment is made with a render mode.
"""

from __future__ import annotations

from importlib import import_module
from typing import Protocol

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from ce_gym.envs.runtime.batch import TaskBatch
from ce_gym.model.arguments import check_whole

RENDER_MODES = ("human", "rgb_array")

_renderers: list[str] = []  # name of the registered module


class Renderer(Protocol):
    """Shows one robot."""

    def draw(self, q: NDArray[np.float64]) -> NDArray[np.uint8] | None:
        """Show the robot at positions `q`, shape (nq,); return the picture, shape (height, width, 3), if it has one."""
        ...

    def close(self) -> None:
        """Release all resources. Repeated calls have no effect."""
        ...


def use_renderers(module: str) -> None:
    """Register the module of the renderers.

    Args:
        module: Name of a module with a function for each render mode. A function takes a model, positions in a typical
            pose, shape (nq,), and the keywords width [pixels], height [pixels], fps [1/s] and terrain (None if flat).
            It returns a `Renderer`.
    """
    _renderers[:] = [module]


class Screen:
    """Shows the robots of a batch in one render mode.

    Args:
        mode: "human", "rgb_array" or None.
        batch: The environments.
        width: Width of a picture [pixels].
        height: Height of a picture [pixels].

    Raises:
        ValueError: The mode does not exist, or the size is not positive.
        ViewerError: A package that the mode needs is not installed.
    """

    def __init__(self, mode: str | None, batch: TaskBatch, *, width: int, height: int) -> None:
        if mode is not None and mode not in RENDER_MODES:
            raise ValueError(f"render_mode={mode!r}; expected one of {', '.join(RENDER_MODES)}, or None")
        for name, value in (("width", width), ("height", height)):
            check_whole(name, value, 1, " of pixels")
        self._mode, self._batch = mode, batch
        self._renderer: Renderer | None = None
        if mode is not None:
            program, make = batch.program, getattr(import_module(_renderers[0]), mode)
            size = {"width": int(width), "height": int(height)}
            options = {**size, "fps": 1 / program.control_dt, "terrain": program.field}
            self._renderer = make(program.model, program.model.standing_q, **options)

    def frames(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each environment; in mode "human" show the first environment and return None."""
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
        """Show the new state in mode "human", without a call of `render`, as Gymnasium requires."""
        if self._mode == "human":
            self.frames()

    def close(self) -> None:
        """Release the resources of the renderer. Repeated calls have no effect."""
        if self._renderer is not None:
            self._renderer.close()
