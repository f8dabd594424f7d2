"""Clearance between the contact spheres of a robot and the ground: depths, and the lift that a pose needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.forces.ground import above, lift, reach
from ce_gym.dynamics.hulls import Hull
from ce_gym.dynamics.model import Model
from ce_gym.sim.terrain import Terrain


class GroundClearance:
    """Contact spheres of a robot, and the ground under them.

    Args:
        model: The robot.
        contacts: Names of the spheres.
        terrain: The ground; the plane z = 0 if None.
        hulls: Convex shapes whose corners are some of the spheres, on a field.
    """

    def __init__(
        self, model: Model, contacts: Sequence[str], terrain: Terrain | None, hulls: Sequence[Hull] = ()
    ) -> None:
        self._model, self._terrain, self._hulls = model, terrain, hulls
        self._chosen = [model.contact_names.index(name) for name in contacts]
        spheres = [model.robot.contacts[i] for i in self._chosen]
        self._carriers = [model.body_names.index(sphere.body) for sphere in spheres]
        self._radius = np.array([sphere.radius for sphere in spheres])
        self._rim = np.array([sphere.rim for sphere in spheres])
        self._axes = np.array([sphere.axis for sphere in spheres]).reshape(-1, 3)

    def depth(self, q: ArrayLike) -> NDArray:
        """Return the depth of each sphere in the ground, 0 above the ground [m], shape (..., n_contacts)."""
        over = self._over_ground(q)
        return np.maximum(self._reach(q, *over[2:]) - above(*over), 0)

    def lift(self, q: ArrayLike) -> float:
        """Return the lift after which no contact is deeper in the terrain than in flat ground [m]."""
        if self._terrain is None or not self._chosen:
            return 0.0
        over, level = self._over_ground(q), self._reach(q)
        allowed = np.minimum(over[0], level) + (self._reach(q, *over[2:]) - level)
        return max(float(lift(allowed, *over).max()), *(self._lift_of(hull, q) for hull in self._hulls), -np.inf)

    def _lift_of(self, hull: Hull, q: ArrayLike) -> float:
        """Return the lift for the points of a hull [m]."""
        at, turned = self._model.body_poses(q)
        body = self._model.body_names.index(hull.body)
        x, y, z = at[body][:, None] + turned[body] @ np.array(hull.points).T
        return float(lift(np.minimum(z, hull.radius), z, *np.moveaxis(self._terrain.at(x, y), -1, 0)).max())  # type: ignore[union-attr]

    def _reach(self, q: ArrayLike, slope_x: ArrayLike = 0.0, slope_y: ArrayLike = 0.0) -> NDArray:
        """Return the distance of the lowest point of each contact from its centre, towards ground with slopes [m]."""
        if not self._rim.any():
            return self._radius
        rotations = self._model.body_poses(q)[1][..., self._carriers, :, :]
        axes = np.moveaxis(np.einsum("...cij,cj->...ci", rotations, self._axes), -1, 0)
        return reach(self._radius, self._rim, axes, np.asarray(slope_x), np.asarray(slope_y))

    def _over_ground(self, q: ArrayLike) -> tuple[Any, ...]:
        """Return z of the centres [m], and height [m] and slopes of the ground under them."""
        centres = self._model.contact_points(q, np.zeros(self._model.nv))[0][..., self._chosen, :]
        x, y, z = np.moveaxis(centres, -1, 0)
        ground = self._terrain.at(x, y) if self._terrain is not None else np.zeros((*x.shape, 3))
        return z, *np.moveaxis(ground, -1, 0)
