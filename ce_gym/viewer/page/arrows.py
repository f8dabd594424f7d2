"""Arrows for contact forces at the contacts, and for commanded and actual speed above the base.

An arrow is one unit long along z; its scale track stretches it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.forces.ground import above_deepest
from ce_gym.viewer.page import three
from ce_gym.viewer.page.fallback_shapes import frame_along
from ce_gym.viewer.page.poses import PosedRollout, smooth
from ce_gym.viewer.page.three import Color, Command

Array = NDArray[np.float64]

FORCE_COLOR = (0.90, 0.20, 0.24)
COMMAND_COLOR = (0.13, 0.65, 0.35)
VELOCITY_COLOR = (0.15, 0.42, 0.85)
HIDDEN = 1e-4  # scale of an invisible arrow; zero would make its matrix singular
HEAD = 0.2  # share of the head in the arrow's length
LONGEST = 2.0  # length of the longest arrow in radii of the robot, for impacts


@dataclass(frozen=True)
class Arrow:
    """A moving arrow.

    Attributes:
        path: Scene path.
        color: Red, green, blue.
        thickness: Radius of the head [m].
        start: Its start [m], shape (F, 3).
        vector: From start to tip [m], shape (F, 3).
    """

    path: str
    color: Color
    thickness: float
    start: Array
    vector: Array

    def commands(self) -> Iterator[Command]:
        """Draw a shaft and a head that together reach from 0 to 1 along z."""
        shaft = three.cylinder(0.45 * self.thickness, 1.0 - HEAD)
        head = three.cylinder(self.thickness, HEAD, top=0.0)
        middle = three.transform([0, 0, (1.0 - HEAD) / 2]), three.transform([0, 0, 1.0 - HEAD / 2])
        yield three.mesh(f"{self.path}/shaft", shaft, self.color, middle[0] @ three.Y_TO_Z)
        yield three.mesh(f"{self.path}/head", head, self.color, middle[1] @ three.Y_TO_Z)
        for part in ("shaft", "head"):
            yield three.set_property(f"{self.path}/{part}/<object>", "castShadow", False)

    def values(self) -> dict[str, Array]:
        """Return the values of the animation tracks by name."""
        length = np.linalg.norm(self.vector, axis=-1)
        # Short arrows are thin, so that they vanish smoothly.
        width = np.clip(length / (6.0 * self.thickness), HIDDEN, 1.0)
        return {
            "position": self.start,
            "quaternion": three.quaternions(frame_along(self.vector)),
            "scale": np.column_stack([width, width, np.maximum(length, HIDDEN)]),
        }


def all_arrows(run: PosedRollout) -> Iterator[Arrow]:
    """Yield the arrows of a rollout's contact forces and speeds."""
    yield from force_arrows(run)
    if run.rollout.commands.shape[1] >= 2:
        yield from speed_arrows(run)


def force_arrows(run: PosedRollout) -> Iterator[Arrow]:
    """Yield one arrow for each contact; a force of the robot's weight is as long as 1.5 radii of the robot."""
    robot, forces = run.robot, run.rollout.contact_forces[run.frames]
    weight = robot.total_mass * float(np.linalg.norm(robot.gravity)) or 1.0
    spheres = {sphere.name: sphere for sphere in robot.contacts}
    bodies = [body.name for body in robot.bodies]
    for name, force in zip(run.contact_names, np.moveaxis(forces, 1, 0), strict=True):
        sphere = spheres[name]
        index = bodies.index(sphere.body)
        centre = run.positions[:, index] + run.rotations[:, index] @ np.array(sphere.position)
        vector = limited(1.5 * force * run.extent.radius / weight, LONGEST * run.extent.radius)
        path = f"{run.path}/contact forces/{name.replace('/', '_')}"
        axis, up = run.rotations[:, index] @ np.array(sphere.axis), np.array([0.0, 0.0, 1.0])
        start = centre - above_deepest(sphere.radius, sphere.rim, up, axis, axis[:, 2:])
        yield Arrow(path, FORCE_COLOR, 0.035 * run.extent.radius, start, vector)


def speed_arrows(run: PosedRollout) -> Iterator[Arrow]:
    """Yield arrows of the commanded and the actual horizontal speed; 1 m/s is as long as 0.7 radii of the robot."""
    base, forward = run.positions[:, 0], run.rotations[:, 0, :, 0]
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    x, y = run.rollout.commands[run.frames, :2].T
    command = np.column_stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, 0 * x])
    top = base + [0.0, 0.0, float(run.extent.high[2] - base[0, 2]) + 0.25 * run.extent.radius]
    arrows = {"command": (COMMAND_COLOR, 0.0, command), "velocity": (VELOCITY_COLOR, 0.12, velocity(run))}
    for name, (color, drop, speed) in arrows.items():
        vector = limited(0.7 * speed * run.extent.radius, LONGEST * run.extent.radius)
        start = top - [0.0, 0.0, drop * run.extent.radius]
        yield Arrow(f"{run.path}/{name}", color, 0.03 * run.extent.radius, start, vector)


def velocity(run: PosedRollout, seconds: float = 0.2) -> Array:
    """Return the horizontal velocity of the base [m/s], shape (F, 3), averaged over `seconds` [s]."""
    if len(run.times) < 2:
        return np.zeros((len(run.times), 3))
    speed = np.gradient(run.positions[:, 0], run.times, axis=0) * [1.0, 1.0, 0.0]
    return smooth(speed, run.times, seconds)


def limited(vectors: Array, longest: float) -> Array:
    """Return vectors, shape (F, 3), shortened to at most `longest`."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors * np.minimum(1.0, longest / np.maximum(length, 1e-12))
