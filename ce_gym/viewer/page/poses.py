"""A rollout with the world poses of its robot's bodies at the frames to show."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.page.robot import body_paths, extent, joint_poses, pose_bodies
from ce_gym.viewer.page.three import Command, clip, quaternions, transform
from ce_gym.viewer.rollouts.ground_patch import level
from ce_gym.viewer.rollouts.rollout import Rollout

if TYPE_CHECKING:
    from ce_gym.dynamics.model import Model

Array = NDArray[np.float64]


class PosedRollout:
    """A rollout with the world poses of its robot's bodies at the frames to show.

    Args:
        rollout: The rollout.
        model: Its robot.
        path: Scene path of the robot's world.
        max_fps: Frames beyond this rate are left out [1/s].

    Attributes:
        frames: Numbers of the frames to show, shape (F,).
        times: Time since the first frame [s], shape (F,).
        positions: Of the bodies, in the robot's order [m], shape (F, n_bodies, 3).
        rotations: Body to world, shape (F, n_bodies, 3, 3).
        contact_names: Contacts with recorded forces.
        extent: Box around the robot in the first frame.
        middle: Point that the camera follows [m], shape (F, 2): the base, or the middle of a robot with a fixed base.
        levels: Mean height of the ground around the robot [m], shape (F,).

    Raises:
        ViewerError: The rollout does not fit the robot.
    """

    def __init__(self, rollout: Rollout, model: Model, path: str, max_fps: float) -> None:
        self.rollout, self.robot, self.path = rollout, model.robot, path
        stride = max(1, round(1.0 / (max_fps * rollout.dt)))
        self.frames = np.arange(0, len(rollout), stride)
        self.times = rollout.times[self.frames] - rollout.times[0]
        try:
            self.positions, self.rotations = pose_bodies(model, rollout.q[self.frames])
        except ValueError as error:
            raise ViewerError(f"rollout of {rollout.robot!r} does not fit the robot: {error}") from None
        self.contact_names = _contact_names(rollout, model.contact_names)
        self.extent = extent(self.robot, self.positions[0], self.rotations[0])
        fixed = np.tile(self.extent.middle[:2], (len(self.times), 1))
        self.middle = self.positions[:, 0, :2] if self.robot.floating else fixed
        self.levels = level(rollout.ground, self.middle, self.extent.radius / 2)

    @property
    def start(self) -> Array:
        """Place of the base on the ground in the first frame, and its heading, shape (4, 4)."""
        if not self.robot.floating:
            return np.eye(4)
        (x, y, _), (forward, left, _) = self.positions[0, 0], self.rotations[0, 0, :, 0]
        length = float(np.hypot(forward, left)) or 1.0
        c, s = (forward / length, left / length) if forward or left else (1.0, 0.0)
        return transform([x, y, self.levels[0]], [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def clips(self, end: float) -> Iterator[Command]:
        """Animate every body against its parent until `end` [s]."""
        paths = body_paths(self.robot, self.path)
        for name, position, rotation in joint_poses(self.robot, self.positions, self.rotations):
            values = {"position": position, "quaternion": quaternions(rotation)}
            yield clip(paths[name], self.times, end, values)


def _contact_names(rollout: Rollout, known: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the contacts with recorded forces."""
    count, names = rollout.contact_forces.shape[1], tuple(rollout.contact_names)
    if unknown := [contact for contact in names if contact not in known]:
        raise ViewerError(f"rollout of {rollout.robot!r} has forces of contact {unknown[0]!r}, which the robot lacks")
    if count not in (0, len(names or known)):
        raise ViewerError(f"rollout of {rollout.robot!r} has forces of {count} contacts; the robot has {len(known)}")
    return (names or known) if count else ()


def smooth(values: Array, times: Array, seconds: float) -> Array:
    """Return a centred moving average, shape (F, n), whose width shrinks towards both ends.

    Args:
        values: Shape (F, n).
        times: Evenly spaced [s], shape (F,).
        seconds: Width of the average [s].
    """
    count = len(times)
    step = (times[-1] - times[0]) / max(count - 1, 1)
    half = 0 if step == 0 else min(int(seconds / step / 2), count // 2)
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    middle = np.arange(count)
    width = np.minimum(np.minimum(middle, count - 1 - middle), half)
    return (total[middle + width + 1] - total[middle - width]) / (2 * width + 1)[:, None]
