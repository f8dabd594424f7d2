"""The mass matrix and forward dynamics of an exported robot by MuJoCo, in our coordinates."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from ce_gym.export.mujoco_coordinates import Coordinates
from ce_gym.model.description import Robot

Array = NDArray[np.float64]


def mass_matrix(model: mujoco.MjModel, robot: Robot, q: Array) -> Array:
    """Return MuJoCo's mass matrix in our coordinates, dependent joints eliminated exactly, shape (nv, nv)."""
    coordinates = Coordinates.of(model, robot)
    data = mujoco.MjData(model)
    data.qpos[:] = coordinates.positions(q)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    T = coordinates.velocity_map(q)
    return T.T @ full @ T


def forward_dynamics(model: mujoco.MjModel, robot: Robot, q: Array, v: Array, tau: Array) -> Array:
    """Return the acceleration in our coordinates from MuJoCo's mass matrix and bias forces, shape (nv,).

    No contact and no joint damping; dependent joints are eliminated exactly, so that soft equalities play no part.
    """
    coordinates = Coordinates.of(model, robot)
    T = coordinates.velocity_map(q)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = coordinates.positions(q), T @ v
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    bias = data.qfrc_bias + full @ coordinates.velocity_product(q, v)
    return np.linalg.solve(T.T @ full @ T, tau - T.T @ bias)
