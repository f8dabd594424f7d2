"""The scene of a live page: robots in one place, whose poses are sent one by one; the camera follows the first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.page import three
from ce_gym.viewer.page.lights_and_camera import TILE, camera_commands, eye, field_command, surroundings
from ce_gym.viewer.page.overlays import overlay_commands
from ce_gym.viewer.page.robot import body_paths, extent, joint_poses, placed_scans, pose_bodies, robot_commands
from ce_gym.viewer.page.scene import GHOST_OPACITY, GHOST_TINTS
from ce_gym.viewer.page.three import Command
from ce_gym.viewer.rollouts.ground_patch import around, level, reach
from ce_gym.viewer.stream import Feed

if TYPE_CHECKING:
    from ce_gym.dynamics.model import Model

Array = NDArray[np.float64]
Scan = Sequence[Mapping[str, Any]]

WORLD, SURROUNDINGS = "/world", "/surroundings"
BLOCK = 4.0  # edge of the squares of the world that share a piece of uneven ground [m]


class MovingScene:
    """Robots of one kind, all but the first drawn as ghosts.

    Args:
        model: The robot.
        q: Positions in a typical pose, shape (nq,); they set the distance of the camera.
        count: Number of robots.
        terrain: The ground; None for the plane z = 0.
        scan: Scans of the first robot, see `Rollout.scan`.

    Attributes:
        paths: Scene path of each body, by name, for each robot.
    """

    def __init__(self, model: Model, q: Array, count: int = 1, terrain: Terrain | None = None, scan: Scan = ()) -> None:
        self.robot = model.robot
        self.paths = [body_paths(self.robot, f"{WORLD}/{index}") for index in range(count)]
        positions, rotations = pose_bodies(model, [q])
        self._extent = extent(self.robot, positions[0], rotations[0])
        self.set_ground(terrain, scan)

    def set_ground(self, terrain: Terrain | None, scan: Scan = ()) -> None:
        """Change the ground and the scans of the first robot."""
        self._terrain, self._scan = terrain, scan
        self._block: tuple[int, int] | None = None  # the piece of ground that the page has

    def commands(self) -> list[Command]:
        """Return the commands that draw robots, surroundings and camera."""
        origin = np.zeros(2)
        commands = [*surroundings(origin, origin, root=SURROUNDINGS, radius=self._extent.radius)]
        commands.append(three.set_property(f"{SURROUNDINGS}/ground", "visible", self._terrain is None))
        for index in range(len(self.paths)):
            tint, opacity = (GHOST_TINTS[index - 1], GHOST_OPACITY) if index else (None, 1.0)
            commands += robot_commands(self.robot, f"{WORLD}/{index}", tint=tint, opacity=opacity)
        commands += overlay_commands(self.robot, f"{WORLD}/0")
        return [*commands, *camera_commands(eye(self._extent.radius))]

    def send(self, feed: Feed, models: Sequence[Model], poses: Sequence[Array], state: Any = None) -> bool:
        """Publish a message with the matrix of each moving path, and the ground when the first robot leaves its piece.

        Args:
            feed: Where to publish.
            models: The present robots, at most `count`.
            poses: Positions of each, shape (nq,).
            state: Text for the page, as JSON.

        Returns:
            Whether a browser is connected.
        """
        matrices: dict[str, Array] = {}
        for model, q, paths in zip(models, poses, self.paths, strict=False):
            for name, position, rotation in joint_poses(self.robot, *pose_bodies(model, [q])):
                matrices[paths[name]] = three.transform(position[0], rotation[0])
        base = self.paths[0][self.robot.bodies[0].name]
        place = matrices[base][:2, 3] if self.robot.floating else self._extent.middle[:2]
        x, y = place
        height = self._extent.middle[2]
        z = level(self._terrain, place[None], self._extent.radius / 2)[0]
        matrices[WORLD] = three.transform([-x, -y, -height - z])
        # The flat ground moves within one tile, so that it never ends.
        matrices[SURROUNDINGS] = three.transform([-(x % TILE), -(y % TILE), -height])
        block = tuple(np.floor(place / BLOCK).astype(int).tolist())
        if self._terrain is not None and block != self._block:
            self._block = block
            corners = BLOCK * np.array([block, np.add(block, 1)])
            ground, scans = around(self._terrain, corners), placed_scans(self._scan, self.robot, f"{WORLD}/0")
            feed.keep("ground", field_command(f"{WORLD}/ground", ground, [base], reach(ground, corners), scans=scans))
        moves = {path: np.round(matrix.T.ravel(), 6).tolist() for path, matrix in matrices.items()}
        return feed.publish({"moves": moves, "state": state})
