"""Renderers of environments, one function for each render mode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain

if TYPE_CHECKING:
    from ce_gym.dynamics.model import Model
    from ce_gym.viewer.raytrace.picture import Picture
    from ce_gym.viewer.window import Window


def rgb_array(
    model: Model, q: NDArray[np.float64], *, width: int, height: int, fps: float, terrain: Terrain | None
) -> Picture:
    """Return the renderer of arrays, a `Picture`."""
    from ce_gym.viewer.raytrace.picture import Picture

    return Picture(model, q, width=width, height=height, terrain=terrain)


def human(
    model: Model, q: NDArray[np.float64], *, width: int, height: int, fps: float, terrain: Terrain | None
) -> Window:
    """Return the renderer of live pages, a `Window`."""
    from ce_gym.viewer.window import Window

    return Window(model, q, fps=fps, terrain=terrain)
