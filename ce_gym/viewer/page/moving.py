"""A scene of a live page: robots in one place, whose poses are sent one by one; the camera follows the first."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.page import three
from ce_gym.viewer.page.lights_and_camera import TILE, camera_commands, eye, field_command, surroundings
from ce_gym.viewer.page.poses import PosedModel
from ce_gym.viewer.page.robot import body_paths, extent, placed_scans, robot_commands
from ce_gym.viewer.page.scene import GHOST_OPACITY, GHOST_TINTS
from ce_gym.viewer.rollouts.ground_patch import around, level, reach

Array = NDArray[np.float64]
Scan = Sequence[Mapping[str, Any]]

WORLD, SURROUNDINGS = "/world", "/surroundings"
BLOCK = 4.0  # edge of the squares of the world that share a piece of ground that is not flat [m]


class MovingScene:
    """Robots of one kind, all but the first drawn as ghosts.

    Args:
        model: The robot and its forward kinematics.
        q: Positions in a typical pose, shape (nq,); they set how far the camera is away.
        count: How many there are.
        terrain: The ground, the plane z = 0 if None.
        scan: Where the first robot's scans look, see `Rollout.scan`.

    Attributes:
        paths: Scene path of each body, by name, for each robot.
    """

    def __init__(
        self, model: PosedModel, q: Array, count: int = 1, terrain: Terrain | None = None, scan: Scan = ()
    ) -> None:
        self.robot = model.robot
        self.paths = [body_paths(self.robot, f"{WORLD}/{index}") for index in range(count)]
        self._index = {body.name: model.body_names.index(body.name) for body in self.robot.bodies}
        positions, rotations = (np.asarray(rows[0]) for rows in model.body_poses(np.asarray(q, float)[None]))
        order = list(self._index.values())
        low, high = extent(self.robot, positions[order], rotations[order])
        self._radius = max(float(np.linalg.norm(high - low)) / 2, 0.05)
        self._middle, self._height = (low + high)[:2] / 2, float(low[2] + high[2]) / 2
        self.stand_on(terrain, scan)

    def stand_on(self, terrain: Terrain | None, scan: Scan = ()) -> None:
        """Change the ground, and where the first robot's scans look."""
        self._terrain, self._scan = terrain, scan
        self._block: tuple[int, int] | None = None  # the piece of ground that the page has

    def commands(self) -> list[str]:
        """Return meshcat's commands for all that is there from the start, packed, as base64."""
        here = np.zeros(2)
        commands = [*surroundings(here, here, root=SURROUNDINGS, radius=self._radius)]
        commands.append(three.set_property(f"{SURROUNDINGS}/ground", "visible", self._terrain is None))
        for index in range(len(self.paths)):
            tint, opacity = (GHOST_TINTS[index - 1], GHOST_OPACITY) if index else (None, 1.0)
            commands += robot_commands(self.robot, f"{WORLD}/{index}", tint=tint, opacity=opacity)
        commands += camera_commands(eye(self._radius))
        return [base64.b64encode(three.pack(command)).decode() for command in commands]

    def moves(self, models: Sequence[PosedModel], poses: Sequence[Array]) -> dict[str, list[float]]:
        """Return the matrix of each path that moves: bodies against their parents, the world under the camera.

        Args:
            models: Of robots that are there.
            poses: Positions of each, shape (nq,).
        """
        matrices: dict[str, Array] = {}
        for model, q, paths in zip(models, poses, self.paths, strict=False):
            matrices |= dict(self._body_matrices(model, q, paths))
        x, y = place = self._place(matrices)
        z = level(self._terrain, place[None], self._radius / 2)[0]
        matrices[WORLD] = three.transform([-x, -y, -self._height - z])
        # the same everywhere, so it never ends
        matrices[SURROUNDINGS] = three.transform([-(x % TILE), -(y % TILE), -self._height])
        return {path: np.round(matrix.T.ravel(), 6).tolist() for path, matrix in matrices.items()}

    def _body_matrices(self, model: PosedModel, q: Array, paths: dict[str, str]) -> Iterator[tuple[str, Array]]:
        positions, rotations = (np.asarray(rows[0]) for rows in model.body_poses(np.asarray(q, float)[None]))
        poses = {name: three.transform(positions[i], rotations[i]) for name, i in self._index.items()}
        for body in self.robot.bodies:
            pose = poses[body.name]
            yield paths[body.name], pose if body.parent is None else np.linalg.inv(poses[body.parent]) @ pose

    def _place(self, matrices: dict[str, Array]) -> Array:
        """Return where the first robot is [m], shape (2,)."""
        base = matrices[self.paths[0][self.robot.bodies[0].name]]
        return base[:2, 3] if self.robot.floating else self._middle

    def new_ground(self, moves: dict[str, list[float]]) -> bytes | None:
        """Return the command that draws the ground around the first robot, None if it is flat or there already."""
        place = self._place({path: np.reshape(matrix, (4, 4)).T for path, matrix in moves.items()})
        row, column = np.floor(place / BLOCK).astype(int).tolist()
        if self._terrain is None or self._block == (row, column):
            return None
        block = BLOCK * np.array([[row, column], [row + 1, column + 1]])
        ground, root = around(self._terrain, block), self.paths[0][self.robot.bodies[0].name]
        scans = placed_scans(self._scan, self.robot, f"{WORLD}/0")
        command = field_command(f"{WORLD}/ground", ground, [root], reach(ground, block), scans=scans)
        self._block = (row, column)
        return json.dumps(command).encode()
