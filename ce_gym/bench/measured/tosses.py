"""Measured tosses of a cube, and errors of simulated ones.

Source: Pfrommer, Halm and Posa, "ContactNets", CoRL 2020; data of DAIRLab/contact-nets, see `docs/data/measured`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measured.data import load

Array = NDArray[np.float64]
SIDE, MASS = 0.1048, 0.37
"""Side [m] and mass [kg] of the cube, as published."""
INERTIA = 0.295 * (SIDE / 2) ** 2
"""Published moment of inertia [kg m^2]; the file has 0.295 in units of kg and half sides."""
FRAMES = 130
"""Later frames are left out: but for a toss in which a hand moves the cube, it rests then."""
HALF_FRAME_OF_GRAVITY = 9.81 * 0.00676 / 2
"""Published velocities are differences to the frame before, and so lag by half a frame [m/s]."""


@dataclass(frozen=True)
class Tosses:
    """Measured tosses, padded with their last pose to equal lengths.

    Attributes:
        dt: Time between frames [s].
        poses: Position [m] and quaternion (w, x, y, z) of the cube, shape (N, T, 7).
        velocities: First velocity of the centre, world axes [m/s], and angular velocity, axes of the cube [rad/s],
            shape (N, 6).
        lengths: Number of frames of each toss, shape (N,).
    """

    dt: float
    poses: Array
    velocities: Array
    lengths: NDArray[np.int64]

    def select(self, rows: NDArray) -> Tosses:
        """Return some tosses."""
        return replace(self, poses=self.poses[rows], velocities=self.velocities[rows], lengths=self.lengths[rows])


def read_tosses() -> Tosses:
    """Return all tosses."""
    data = load("cube_tosses.npz")
    starts, lengths = data["starts"][:-1], np.minimum(np.diff(data["starts"]), FRAMES)
    frames = np.minimum(np.arange(FRAMES), lengths[:, None] - 1)
    poses = data["poses"][starts[:, None] + frames].astype(np.float64)
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    velocities = data["velocities"].astype(np.float64)
    velocities[:, 2] -= HALF_FRAME_OF_GRAVITY
    return Tosses(float(data["dt"]), poses, velocities, lengths)


def errors(tosses: Tosses, poses: Array) -> tuple[Array, Array]:
    """Return errors of position [m] and rotation [rad] of poses (..., N, T, 7); nan after the end of a toss."""
    position = np.linalg.norm(poses[..., :3] - tosses.poses[..., :3], axis=-1)
    cosine = np.abs((poses[..., 3:] * tosses.poses[..., 3:]).sum(-1))
    rotation = 2.0 * np.arccos(np.minimum(cosine, 1.0))
    ended = np.arange(tosses.poses.shape[1]) >= tosses.lengths[:, None]
    return np.where(ended, np.nan, position), np.where(ended, np.nan, rotation)


def final(tosses: Tosses, error: Array) -> Array:
    """Return the errors at the last frames, shape (..., N), of errors (..., N, T)."""
    return error[..., np.arange(len(tosses.lengths)), tosses.lengths - 1]


def corner_error(position: Array, rotation: Array) -> Array:
    """Return the root mean square distance of corresponding corners [m] at errors of position and rotation."""
    return np.sqrt(position**2 + 2.0 * SIDE**2 * np.sin(rotation / 2.0) ** 2)


def depths(poses: Array) -> Array:
    """Return how deep the lowest corner is below z = 0 [m], shape (...), of poses (..., 7)."""
    w, x, y, z = np.moveaxis(poses[..., 3:], -1, 0)
    vertical = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    return SIDE / 2 * np.abs(vertical).sum(-1) - poses[..., 2]
