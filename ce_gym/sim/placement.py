"""Contact spheres of a robot above the ground: depths, and the lift that a pose needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.forces.ground import above, lift
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
        return np.maximum(self._radius - above(*self._over_ground(q)), 0)

    def lift(self, q: ArrayLike) -> float:
        """Return how far to raise a robot for no contact to be deeper in the terrain than it is in flat ground [m]."""
        if self._terrain is None or not self._chosen:
            return 0.0
        over = self._over_ground(q)
        return float(lift(np.minimum(over[0], self._radius), *over).max())

    def _over_ground(self, q: ArrayLike) -> tuple[Any, ...]:
        """Return z of the centres [m], and height [m] and slopes of the ground under them."""
        centres = self._model.contact_points(q, np.zeros(self._model.nv))[0][..., self._chosen, :]
        x, y, z = np.moveaxis(centres, -1, 0)
        ground = self._terrain.at(x, y) if self._terrain is not None else np.zeros((*x.shape, 3))
        return z, *np.moveaxis(ground, -1, 0)
