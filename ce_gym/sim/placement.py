"""How the contact spheres of a robot are placed above the ground. May know models and terrain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.model import Model
from ce_gym.sim.terrain import Terrain


class Placement:
    """The contact spheres that take part, and the ground under them.

    Args:
        model: The robot.
        contacts: Names of the spheres.
        terrain: The ground; the plane z = 0 if None.
    """

    def __init__(self, model: Model, contacts: Sequence[str], terrain: Terrain | None) -> None:
        self._model, self._terrain = model, terrain
        self._chosen = [model.contact_names.index(name) for name in contacts]
        self._radius = np.array([model.robot.contacts[i].radius for i in self._chosen])

    def depth(self, q: ArrayLike) -> NDArray:
        """Return how deep each sphere is in the ground, 0 if it is above [m], shape (..., n_contacts)."""
        _, above, cosine = self._above_ground(q)
        return np.maximum(self._radius - cosine * above, 0)

    def lift(self, q: ArrayLike) -> float:
        """Return how far to raise a robot for no contact to be deeper in the terrain than it is in flat ground [m]."""
        if self._terrain is None or not self._chosen:
            return 0.0
        z, above, cosine = self._above_ground(q)
        return float((np.minimum(z, self._radius) / cosine - above).max())

    def _above_ground(self, q: ArrayLike) -> tuple[NDArray, NDArray, NDArray]:
        """Return heights of the centres in the world and above the ground [m], and the cosine of the ground's slope."""
        centres = self._model.contact_points(q, np.zeros(self._model.nv))[0][..., self._chosen, :]
        x, y, z = np.moveaxis(centres, -1, 0)
        ground = self._terrain.at(x, y) if self._terrain is not None else np.zeros((*x.shape, 3))
        return z, z - ground[..., 0], 1 / np.sqrt(1 + np.square(ground[..., 1:]).sum(-1))
