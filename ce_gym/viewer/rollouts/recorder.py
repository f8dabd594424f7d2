"""Collects the frames of a rollout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.rollouts.ground_patch import around
from ce_gym.viewer.rollouts.rollout import Rollout, RolloutError

Array = NDArray[np.float64]


class Recorder:
    """Collects frames while something runs.

    Args:
        robot: Name of the robot, or path of its file.
        transmission: Transmission level.
        dt: Time between frames [s].
        label: A few words for the legend.
        info: Anything else worth keeping, as text.
        contact_names: Which contacts the forces belong to; empty means all of the robot's.
        signal_names: Of what else is recorded for plots.
        terrain: The ground, of which the part around the robot's path is kept; None if it is flat.
        scan: Where height and range scans look, see `Rollout.scan`.
    """

    def __init__(
        self,
        robot: str,
        transmission: str,
        dt: float,
        *,
        label: str = "",
        info: Mapping[str, str] | None = None,
        contact_names: Sequence[str] = (),
        signal_names: Sequence[str] = (),
        terrain: Terrain | None = None,
        scan: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        self._terrain = terrain
        self._fixed: dict[str, Any] = {
            "robot": robot,
            "transmission": transmission,
            "dt": dt,
            "label": label,
            "info": dict(info or {}),
            "contact_names": tuple(contact_names),
            "signal_names": tuple(signal_names),
            "scan": tuple(scan),
        }
        self._frames: list[dict[str, Any]] = []

    def __len__(self) -> int:
        return len(self._frames)

    def add(
        self,
        time: float,
        q: ArrayLike,
        v: ArrayLike,
        contact_forces: ArrayLike = (),
        command: ArrayLike = (),
        torque: ArrayLike = (),
        signals: ArrayLike = (),
    ) -> None:
        """Append one frame; the arrays are copied.

        Args:
            time: [s]
            q: Positions, shape (nq,).
            v: Velocities, shape (nv,).
            contact_forces: Force on each contact, world axes [N], shape (n_contacts, 3).
            command: Shape (n,); see `Rollout.commands`.
            torque: Of the motors at the independent joints [N m], shape (n_joints,).
            signals: One number for each of `signal_names`.
        """
        frame = {"times": time, "q": q, "v": v, "commands": command, "torques": torque, "signals": signals}
        frame["contact_forces"] = np.reshape(contact_forces, (-1, 3))
        self._frames.append({name: np.array(value, float) for name, value in frame.items()})

    def rollout(self) -> Rollout:
        """Return everything added so far.

        Raises:
            RolloutError: Nothing was added, or frames differ in shape.
        """
        if not self._frames:
            raise RolloutError("nothing was recorded: expected at least one frame")
        arrays: dict[str, Any] = {name: _stack(name, self._frames) for name in self._frames[0]}
        return Rollout(**self._fixed, **arrays, ground=self._ground(arrays["q"], arrays["v"]))

    def _ground(self, q: Array, v: Array) -> Terrain | None:
        if self._terrain is None:
            return None
        floats = q.shape[1] > v.shape[1]  # of a base that moves, the quaternion has one number more
        return around(self._terrain, q[:, :2] if floats else np.zeros((1, 2)))


def _stack(name: str, frames: list[dict[str, Any]]) -> Array:
    column = [frame[name] for frame in frames]
    shapes = sorted({value.shape for value in column})
    if len(shapes) > 1:
        raise RolloutError(f"{name} changes shape from frame to frame: {shapes[0]} and {shapes[1]}")
    return np.array(column, float)
