"""The renderers of environments, a function for each render mode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.page.poses import PosedModel

if TYPE_CHECKING:
    from ce_gym.viewer.raytrace.picture import Picture
    from ce_gym.viewer.window import Window


def rgb_array(
    model: PosedModel, q: NDArray[np.float64], *, width: int, height: int, fps: float, terrain: Terrain | None
) -> Picture:
    """Return what draws arrays; see `Picture`."""
    from ce_gym.viewer.raytrace.picture import Picture

    return Picture(model, q, width=width, height=height, terrain=terrain)


def human(
    model: PosedModel, q: NDArray[np.float64], *, width: int, height: int, fps: float, terrain: Terrain | None
) -> Window:
    """Return what shows a page in browsers on this machine; see `Window`."""
    from ce_gym.viewer.window import Window

    return Window(model, q, fps=fps, terrain=terrain)
