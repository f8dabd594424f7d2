"""A rollout with the world poses of its robot's bodies at the frames to show."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.description import Robot
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.page import animation
from ce_gym.viewer.page.robot import body_paths, extent
from ce_gym.viewer.page.three import Command, transform
from ce_gym.viewer.rollouts.ground_patch import level
from ce_gym.viewer.rollouts.rollout import Rollout

Array = NDArray[np.float64]


class PosedModel(Protocol):
    """What the viewer needs of a `ce_gym.Model`."""

    robot: Robot

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies that `body_poses` returns, in order."""
        ...

    @property
    def contact_names(self) -> tuple[str, ...]:
        """Names of the contacts, in the order of `Rollout.contact_forces`."""
        ...

    def body_poses(self, q: Array) -> tuple[Array, Array]:
        """Return positions [m], shape (..., n_bodies, 3), and rotations, shape (..., n_bodies, 3, 3)."""
        ...


class PosedRollout:
    """A rollout with the world poses of its robot's bodies at the frames to show.

    Attributes:
        path: Scene path of the robot's world.
        times: Time since the first frame [s], shape (F,).
        positions: Of all bodies, in the robot's order [m], shape (F, n_bodies, 3).
        rotations: Shape (F, n_bodies, 3, 3).
        contact_names: Of the contacts whose forces were recorded.
        levels: Mean height of the ground about the robot [m], shape (F,).
    """

    def __init__(self, rollout: Rollout, model: PosedModel, path: str, max_fps: float) -> None:
        stride = max(1, round(1.0 / (max_fps * rollout.dt)))
        frames = np.arange(0, len(rollout), stride)
        self.rollout, self.model, self.robot, self.path, self.frames = rollout, model, model.robot, path, frames
        self.times = rollout.times[frames] - rollout.times[0]
        try:
            positions, rotations = model.body_poses(rollout.q[frames])
        except ValueError as error:
            raise ViewerError(f"rollout of {rollout.robot!r} does not fit the robot: {error}") from None
        order = [model.body_names.index(body.name) for body in self.robot.bodies]
        self.positions, self.rotations = np.asarray(positions)[:, order], np.asarray(rotations)[:, order]
        self.contact_names = self._contact_names()
        self.low, self.high = extent(self.robot, self.positions[0], self.rotations[0])
        self.levels = level(rollout.ground, self.middle, self.radius / 2)

    def _contact_names(self) -> tuple[str, ...]:
        """Return the name of each contact that the rollout has forces of."""
        name, found = self.rollout.robot, self.rollout.contact_forces.shape[1]
        names, known = tuple(self.rollout.contact_names), self.model.contact_names
        if unknown := [contact for contact in names if contact not in known]:
            raise ViewerError(f"rollout of {name!r} has forces of contact {unknown[0]!r}, which the robot lacks")
        if found not in (0, len(names or known)):
            raise ViewerError(f"rollout of {name!r} has forces of {found} contacts; the robot has {len(known)}")
        return (names or known) if found else ()

    @property
    def radius(self) -> float:
        """Radius of a ball around the robot in its first frame [m]."""
        return max(float(np.linalg.norm(self.high - self.low)) / 2, 0.05)

    @property
    def middle(self) -> Array:
        """What the camera follows [m], shape (F, 2): the base, or the middle of a robot whose base is fixed."""
        if self.robot.floating:
            return self.positions[:, 0, :2]
        return np.tile((self.low + self.high)[:2] / 2, (len(self.times), 1))

    @property
    def start(self) -> Array:
        """Where on the ground the base is in the first frame and which way it heads, shape (4, 4)."""
        if not self.robot.floating:
            return np.eye(4)
        (x, y, _), (forward, left, _) = self.positions[0, 0], self.rotations[0, 0, :, 0]
        length = float(np.hypot(forward, left)) or 1.0
        c, s = (forward / length, left / length) if forward or left else (1.0, 0.0)
        return transform([x, y, self.levels[0]], [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def clips(self, end: float) -> Iterator[Command]:
        """Animate every body against its parent until `end` [s]."""
        paths = body_paths(self.robot, self.path)
        index = {body.name: i for i, body in enumerate(self.robot.bodies)}
        for body in self.robot.bodies:
            position, rotation = self.positions[:, index[body.name]], self.rotations[:, index[body.name]]
            if body.parent is not None:
                # The pose relative to the parent: R_p^T (x - x_p) and R_p^T R.
                to_parent = np.swapaxes(self.rotations[:, index[body.parent]], -1, -2)
                offset = position - self.positions[:, index[body.parent]]
                position, rotation = (to_parent @ offset[..., None])[..., 0], to_parent @ rotation
            values = {"position": position, "quaternion": animation.quaternions(rotation)}
            yield animation.moving(paths[body.name], self.times, end, values)


def smooth(values: Array, times: Array, seconds: float) -> Array:
    """Return a centred moving average of `values`, shape (F, n), that shrinks towards both ends.

    Args:
        values: Shape (F, n).
        times: Evenly spaced [s], shape (F,).
        seconds: Width of the average [s].
    """
    count = len(times)
    step = (times[-1] - times[0]) / max(count - 1, 1)
    half = 0 if step == 0 else min(int(seconds / step / 2), count // 2)
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    reach = np.minimum(np.minimum(np.arange(count), count - 1 - np.arange(count)), half)[:, None]
    middle = np.arange(count)[:, None]
    rows = np.arange(values.shape[1])
    return (total[middle + reach + 1, rows] - total[middle - reach, rows]) / (2 * reach + 1)
