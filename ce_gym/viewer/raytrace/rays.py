"""Ray tracing with embreex, a binding to Embree."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.viewer.errors import ViewerError

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]  # single precision, for speed


class Embree:
    """Finds the hits of rays.

    Raises:
        ViewerError: embreex is not installed.
    """

    def __init__(self) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore import EmbreeDevice
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise ViewerError.missing("embreex") from None
        self._new, self._add, self._device = EmbreeScene, TriangleMesh, EmbreeDevice()

    def scene(self, vertices: Array, triangles: NDArray[np.int32]) -> Any:
        """Return a scene of vertices, shape (n, 3), and triangles, shape (m, 3)."""
        scene = self._new(self._device)
        self._add(scene, vertices.astype(np.float32), triangles)
        return scene

    @staticmethod
    def meet(scene: Any, starts: Floats, rays: Floats) -> dict[str, NDArray[Any]]:
        """Return for each ray `primID`, the first triangle or -1, its distance `tfar`, and `u`, `v` on the triangle."""
        return scene.run(starts, rays, output=1)

    @staticmethod
    def meets(scene: Any, starts: Floats, rays: Floats) -> NDArray[np.bool_]:
        """Return whether each ray hits a triangle."""
        return scene.run(starts, rays, query="OCCLUDED") >= 0
