"""Animation tracks: poses and scales over time, packed for meshcat's page."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.viewer.page.three import Command

Array = NDArray[np.float64]


def quaternions(rotations: Array) -> Array:
    """Return quaternions in three.js order (x, y, z, w), shape (..., 4), of rotation matrices, shape (..., 3, 3).

    Shepperd's method: of the four formulas the one with the largest divisor is taken, so none is near zero.
    """
    r = rotations
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    trace = diagonal.sum(-1)
    off = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)
    candidates = np.empty((*r.shape[:-2], 4, 4))
    candidates[..., :3, :3] = r + np.swapaxes(r, -1, -2)
    candidates[..., [0, 1, 2], [0, 1, 2]] = 1 + 2 * diagonal - trace[..., None]
    candidates[..., :3, 3] = candidates[..., 3, :3] = off
    candidates[..., 3, 3] = 1 + trace
    best = np.argmax(candidates[..., range(4), range(4)], -1)
    chosen = np.take_along_axis(candidates, best[..., None, None], -2)[..., 0, :]
    return chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)


def track(name: str, times: Array, values: Array) -> Command:
    """Return an animation track.

    Args:
        name: "position" or "scale", each with 3 numbers, or "quaternion" with 4.
        times: [s], shape (T,).
        values: Shape (T, 3) or (T, 4).
    """
    still = np.abs(values - values[0]).max() < 1e-6
    keys = [0, -1] if still else slice(None)  # both ends, so that all tracks last equally long
    kind = "quaternion" if name == "quaternion" else "vector3"
    return {"name": f".{name}", "type": kind, "times": times[keys], "values": values[keys].ravel()}


def clip(path: str, *tracks: Command) -> Command:
    """Return the animation of one scene path."""
    return {"path": path, "clip": {"fps": 1, "name": path, "tracks": list(tracks)}}  # fps 1: times are in seconds


def moving(path: str, times: Array, end: float, values: dict[str, Array]) -> Command:
    """Return a clip whose tracks all reach to `end` [s], holding the last value."""
    if times[-1] < end:
        times = np.append(times, end)
        values = {name: np.concatenate([value, value[-1:]]) for name, value in values.items()}
    return clip(path, *(track(name, times, value) for name, value in values.items()))


def set_animation(clips: list[Command]) -> Command:
    """Return the command that loads clips and plays them over and over."""
    options = {"play": True, "repetitions": float("inf")}
    return {"type": "set_animation", "path": "", "animations": clips, "options": options}
