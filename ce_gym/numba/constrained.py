"""Dynamics with held frames, and inertia at a frame, as `@njit` functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba import njit

from ce_gym.dynamics.model import REDUNDANT, Model
from ce_gym.model.errors import check_names
from ce_gym.numba.quantities import forward_dynamics, mass_matrix, quantity

LINEAR_TERMS = "frame_jacobian", "frame_bias_acceleration"
"""Quantities with the terms of `J vdot + Jdot v`."""


def constrained_forward_dynamics(model: Model, frames: Sequence[str]) -> Callable[..., Any]:
    """Return `Model.constrained_forward_dynamics` as an `@njit` function (q, v, tau) -> (vdot, force) of one robot.

    Results have shapes (nv,) and (n_frames, 3) and are those of `Model` up to rounding; nan where the method raises an
    error.

    Args:
        model: The robot at a transmission level.
        frames: Names of the frames that are held, one or more.

    Raises:
        ValueError: If a frame does not exist, or there is none.
    """
    check_names("frames", frames, model.frame_names, f"a frame of {model.robot.name}:")
    if not frames:
        raise ValueError("frames=[]; expected the name of a frame or more")
    forward, mass, fill = forward_dynamics(model), mass_matrix(model), _fill_nothing
    for i, frame in enumerate(frames):
        fill = _filling(fill, i, *[quantity(model, f"{kind}:{frame}") for kind in LINEAR_TERMS])
    n, nv, smallest, dtype = len(frames), model.nv, REDUNDANT[model.dtype], np.dtype(model.dtype)

    @njit(nogil=True)
    def dynamics(q, v, tau):
        free, J, bias = forward(q, v, tau), np.empty((3 * n, nv), dtype), np.empty(3 * n, dtype)
        if np.isnan(free).any():
            return np.full(nv, np.nan, dtype), np.full((n, 3), np.nan, dtype)
        fill(q, v, J, bias)
        response = np.linalg.solve(mass(q), J.T)  # M^-1 J^T
        force = -np.linalg.pinv(J @ response, smallest) @ (J @ free + bias)
        return free + response @ force, force.reshape((n, 3))

    return dynamics


@njit
def _fill_nothing(q, v, J, bias):
    pass


def _filling(fill_others: Callable[..., Any], i: int, jacobian: Any, bias_acceleration: Any) -> Callable[..., Any]:
    """Return the function that writes the linear rows of frame i, after those of other frames."""

    @njit
    def fill(q, v, J, bias):
        fill_others(q, v, J, bias)
        J[3 * i : 3 * i + 3] = jacobian(q)[3:]
        bias[3 * i : 3 * i + 3] = bias_acceleration(q, v)[3:]

    return fill


def operational_space_inertia(model: Model, frame: str) -> Callable[..., Any]:
    """Return `Model.operational_space_inertia` as an `@njit` function q -> (6, 6) of one robot.

    Results are those of `Model` up to rounding; nan where the method raises an error.

    Raises:
        KeyError: If the frame does not exist.
    """
    jacobian, mass = quantity(model, f"frame_jacobian:{frame}"), mass_matrix(model)
    smallest, dtype = REDUNDANT[model.dtype], np.dtype(model.dtype)

    @njit(nogil=True)
    def inertia(q):
        J = jacobian(q)
        if np.isnan(J).any():
            return np.full((6, 6), np.nan, dtype)
        inverse = J @ np.linalg.solve(mass(q), J.T)
        values = np.linalg.eigvalsh(inverse)
        if values[0] <= smallest * values[-1]:
            return np.full((6, 6), np.nan, dtype)
        return np.linalg.inv(inverse)

    return inertia
