"""Pictures of a robot as arrays, traced on the CPU: no display, no OpenGL, nothing but pip packages.

Embree finds what each ray meets; flat ground and the sky need no tracing. A picture depends on the pose alone, not on
what was drawn before.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.page.lights_and_camera import FADING, FIELD_OF_VIEW, HORIZON, STEEP, ZENITH
from ce_gym.viewer.page.poses import PosedModel
from ce_gym.viewer.page.robot import body_paths, extent, robot_commands
from ce_gym.viewer.raytrace.ground import Field
from ce_gym.viewer.raytrace.mesh import mesh_of
from ce_gym.viewer.raytrace.rays import Array, Embree, Floats
from ce_gym.viewer.rollouts.ground_patch import clear_view, level

VIEW = np.array([0.62, -0.80, 0.30])  # from the robot towards the camera: front right, a little above
SUN = np.array([0.45, -0.55, 1.0]) / np.linalg.norm([0.45, -0.55, 1.0])
SUNLIGHT, SKYLIGHT, BOUNCE = 0.72, 0.52, 0.28  # of direct light, of light from above and from below
SHADE = 0.70  # what is left of the ground's brightness in shadow
TILE = 0.5  # edge of a square of the ground [m]
TILES = np.array([[0.90, 0.92, 0.94], [0.79, 0.82, 0.86]], np.float32)
FAR = 14.0  # here the ground is as pale as the horizon, in distances of the camera
CORNERS = np.array([[-0.3, 0.3], [0.3, -0.3]])  # where more rays go through a pixel on an outline, from its middle
CLOSE = 1e-4  # a shadow's ray starts this far off its surface [m]


class _View(NamedTuple):
    """The robot in one pose, where it is and from where it is seen."""

    scene: Any  # what rays are sent into
    normals: Floats  # of the vertices, in the world
    centre: Floats  # the origin of the scene against the pattern of the ground, x and y, in squares
    eye: Floats  # the camera [m]
    axes: Array  # rows: the camera's x, y, z in the world


class _Backdrop(NamedTuple):
    """What rays meet behind the robot, as far as it stays the same when the camera moves along."""

    distance: Floats  # to the ground [m], infinite for rays that miss it, shape (...)
    x: Floats  # where that is, in squares of the ground, shape (...)
    y: Floats
    height: Floats  # of it [m]
    footprint: Floats  # edge of the ground that a pixel covers there, in squares, shape (...)
    light: Floats  # colour of a light square in the haze, or of the sky, shape (..., 3)
    contrast: Floats  # from there to the colour of a dark square, shape (..., 3)

    def part(self, window: tuple[slice, slice]) -> _Backdrop:
        """Return rows and columns as a list of rays."""
        count = self.distance[window].size
        return _Backdrop(*(values[window].reshape(count, *values.shape[2:]) for values in self))


class Picture:
    """Draws one robot.

    Args:
        model: The robot and its forward kinematics.
        q: Positions in a typical pose on the plane z = 0, shape (nq,); they set how far the camera is away.
        width: Of the picture [pixels].
        height: Of the picture [pixels].
        terrain: The ground, the plane z = 0 if None.

    Raises:
        ViewerError: embreex is not installed.
    """

    def __init__(
        self, model: PosedModel, q: Array, *, width: int = 640, height: int = 480, terrain: Terrain | None = None
    ) -> None:
        self._embree = Embree()
        self._field = Field(self._embree, terrain) if terrain else None
        self._model = model
        robot = model.robot
        names = model.body_names
        paths = {path: names.index(name) for name, path in body_paths(robot, "").items()}
        self._mesh = mesh_of(robot_commands(robot, ""), paths)
        order = [names.index(body.name) for body in robot.bodies]
        positions, rotations = (rows[0] for rows in model.body_poses(np.asarray(q, float)[None]))
        self._root = order[0]
        low, high = extent(robot, np.asarray(positions)[order], np.asarray(rotations)[order])
        self._fixed = None if robot.floating else (low + high)[:2] / 2
        radius = self._radius = max(float(np.linalg.norm(high - low)) / 2, 0.05)
        tangent = np.tan(np.radians(FIELD_OF_VIEW / 2))
        back = VIEW / np.linalg.norm(VIEW)
        self._far = FAR * 1.3 * radius / np.sin(np.arctan(tangent)) * max(1.0, height / width)
        self._eye = np.array([0.0, 0.0, (low + high)[2] / 2]) + self._far / FAR * back
        self._middle = float((low + high)[2] / 2)
        self._size, self._focus = (width, height), height / 2 / tangent
        self._pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
        self._axes = _axes(back)
        self._rays = self._directions(self._pixels, self._axes)
        self._backdrop = self._behind(self._rays)

    def draw(self, q: Array) -> NDArray[np.uint8]:
        """Return the robot at positions `q`, shape (nq,), as red, green, blue, shape (height, width, 3)."""
        positions, rotations = (np.asarray(rows[0]) for rows in self._model.body_poses(np.asarray(q, float)[None]))
        centre = np.zeros(3)
        centre[:2] = positions[self._root, :2] if self._fixed is None else self._fixed
        if self._field is not None:
            centre[2] = level(self._field.terrain, centre[None, :2], self._radius / 2)[0]
        mesh = self._mesh
        turn = rotations[mesh.bodies]
        vertices = np.einsum("nij,nj->ni", turn, mesh.vertices) + (positions - centre)[mesh.bodies]
        normals = np.einsum("nij,nj->ni", turn, mesh.normals).astype(np.float32)
        on_tiles = (centre[:2] / TILE % 2).astype(np.float32)
        eye, axes, pixels, behind = self._eye, self._axes, self._rays, self._backdrop
        lowest = 0.0
        if self._field is not None:
            lowest = self._field.lowest(centre[:2]) - centre[2]
            eye = self._clear(centre)
            if (eye != self._eye).any():
                axes = _axes(eye - [0.0, 0.0, self._middle])
                pixels = self._directions(self._pixels, axes)
            behind = self._land(pixels, eye, centre)
        view = _View(self._embree.scene(vertices, mesh.triangles), normals, on_tiles, eye.astype(np.float32), axes)
        image = self._background(behind, view)
        window = self._window(vertices, view, lowest)
        part = image[window]  # a view
        colors, thing = self._trace(view, pixels[window].reshape(-1, 3), behind.part(window), part.reshape(-1, 3))
        part[:] = colors.reshape(part.shape)
        edges = _outline(thing.reshape(part.shape[:2]))
        if edges.any():  # more rays where neighbours differ, so that edges are smooth
            rays = self._directions((self._pixels[window][edges][:, None] + CORNERS).reshape(-1, 2), axes)
            backdrop = self._behind(rays) if self._field is None else self._land(rays, eye, centre)
            colors, _ = self._trace(view, rays, backdrop, self._background(backdrop, view))
            part[edges] = (part[edges] + colors.reshape(-1, len(CORNERS), 3).sum(1)) / (1 + len(CORNERS))
        return (255 * image + 0.5).astype(np.uint8)

    def close(self) -> None:
        """Do nothing: arrays are all there is."""

    def _clear(self, centre: Array) -> Array:
        """Return from where the camera sees the robot, above the ground and against the centre, shape (3,)."""
        assert self._field is not None
        target = centre + [0.0, 0.0, self._middle]
        return clear_view(self._field.terrain, target, centre + self._eye, self._radius / 4) - centre

    def _directions(self, pixels: NDArray[Any], axes: Array) -> Floats:
        """Return unit vectors from the camera through pixels (x, y), shape (..., 2)."""
        width, height = self._size
        x, y = pixels[..., 0] + 0.5 - width / 2, height / 2 - 0.5 - pixels[..., 1]
        rays = np.stack([x, y, np.full(x.shape, -self._focus)], -1) @ axes
        return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)

    def _behind(self, rays: Floats) -> _Backdrop:
        """Return what rays from the camera, shape (..., 3), meet behind the robot."""
        down = rays[..., 2] < -1e-3
        slope = np.where(down, -rays[..., 2], 1.0)
        distance = np.where(down, self._eye[2] / slope, np.inf)
        reach = np.where(down, distance, 0.0)
        x, y = ((self._eye[axis] + reach * rays[..., axis]) / TILE for axis in (0, 1))
        # A pixel covers this much ground across the ray, and more along it; the squares are averaged over both.
        footprint = reach / self._focus * (1 + 1 / slope) / 2 / TILE
        haze = np.clip(distance / self._far, 0, 1)[..., None] ** 2
        sky = _sky(rays)
        light = TILES[0] + haze * (sky - TILES[0])
        found = (distance, x, y, np.zeros_like(x), footprint, light, (1 - haze) * (TILES[1] - TILES[0]))
        return _Backdrop(*(values.astype(np.float32) for values in found))

    def _land(self, rays: Floats, eye: Array, centre: Array) -> _Backdrop:
        """Return what rays, shape (..., 3), meet behind the robot where the ground is not flat."""
        assert self._field is not None
        many = rays.reshape(-1, 3)
        met = self._field.meet(centre, eye, many)
        hit = np.isfinite(met.distance)
        reach = np.where(hit, met.distance, 0)
        x, y, z = (eye.astype(np.float32) + reach[:, None] * many).T
        facing = np.maximum(np.abs((met.normals * many).sum(1)), 0.02)
        footprint = reach / self._focus * (1 + 1 / facing) / 2 / TILE
        fade = np.clip((met.away - FADING) / (1 - FADING), 0, 1)
        haze = np.where(hit, np.maximum(fade * fade * (3 - 2 * fade), np.clip(reach / self._far, 0, 1) ** 2), 1)[
            :, None
        ]
        steep = 1 - STEEP * np.sqrt(np.maximum(1 - met.normals[:, 2] ** 2, 0))
        lit = (
            _light(met.normals, np.ones(len(many), bool)) / _light(np.array([[0, 0, 1.0]]), np.ones(1, bool))
        ) * steep
        sky = _sky(many)
        light = lit[:, None] * TILES[0] * (1 - haze) + haze * sky
        contrast = lit[:, None] * (1 - haze) * (TILES[1] - TILES[0])
        found = (met.distance, x / TILE, y / TILE, z, footprint, light, contrast)
        shapes = [(*rays.shape[:-1], *values.shape[1:]) for values in found]
        return _Backdrop(*(np.reshape(v, shape).astype(np.float32) for v, shape in zip(found, shapes, strict=True)))

    def _background(self, backdrop: _Backdrop, view: _View) -> Floats:
        """Return the colours of ground and sky, shape (..., 3)."""
        x, y = backdrop.x + view.centre[0], backdrop.y + view.centre[1]
        return backdrop.light + _dark_share(x, y, backdrop.footprint)[..., None] * backdrop.contrast

    def _window(self, vertices: Array, view: _View, lowest: float) -> tuple[slice, slice]:
        """Return the rows and columns that may show the robot or its shadow, on ground nowhere below `lowest` [m]."""
        onto_ground = vertices - np.maximum(vertices[:, 2:] - lowest, 0) / SUN[2] * SUN
        seen = (np.concatenate([vertices, onto_ground]) - view.eye) @ view.axes.T
        width, height = self._size
        if (seen[:, 2] > -1e-3).any():  # something is beside or behind the camera
            return slice(None), slice(None)
        spots = seen[:, :2] * [1, -1] / -seen[:, 2:] * self._focus + np.array([width, height]) / 2
        left, top = np.clip(np.floor(spots.min(0)) - 1, 0, [width, height]).astype(int).tolist()
        right, bottom = np.clip(np.ceil(spots.max(0)) + 1, 0, [width, height]).astype(int).tolist()
        return slice(top, bottom), slice(left, right)

    def _trace(
        self, view: _View, rays: Floats, backdrop: _Backdrop, background: Floats
    ) -> tuple[Floats, NDArray[np.intp]]:
        """Return what rays from the camera show, shape (n, 3), and a number for the thing they meet, shape (n,)."""
        found = self._embree.meet(view.scene, np.broadcast_to(view.eye, rays.shape), rays)
        triangle = found["primID"]
        hit = (triangle >= 0) & (found["tfar"] < backdrop.distance)
        triangle, u, v = triangle[hit], found["u"][hit, None], found["v"][hit, None]
        a, b, c = view.normals[self._mesh.triangles[triangle]].swapaxes(0, 1)
        normal = (1 - u - v) * a + u * b + v * c
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        surface = view.eye + found["tfar"][hit, None] * rays[hit] + CLOSE * normal
        ground = ~hit & np.isfinite(backdrop.distance)
        x, y = backdrop.x[ground] * np.float32(TILE), backdrop.y[ground] * np.float32(TILE)
        spots = np.column_stack([x, y, backdrop.height[ground] + np.float32(CLOSE)])
        starts = np.concatenate([surface, spots])
        dark = self._embree.meets(view.scene, starts, np.broadcast_to(SUN.astype(np.float32), starts.shape))
        sunny, shadow = ~dark[: len(surface)], np.zeros(len(rays), bool)
        shadow[ground] = dark[len(surface) :]
        light = _light(normal, sunny)
        colors = background.copy()
        colors[shadow] *= SHADE
        colors[hit] = np.clip(self._mesh.colors[triangle] * light[:, None], 0, 1)
        thing = np.where(shadow, -1, -2)
        thing[hit] = self._mesh.solids[triangle]
        return colors, thing


def _axes(back: Array) -> Array:
    """Return the camera's x, y, z in the world as rows, shape (3, 3); `back` points from what is seen to the camera."""
    back = back / np.linalg.norm(back)
    right = np.array([-back[1], back[0], 0.0]) / np.hypot(back[0], back[1])
    return np.array([right, np.cross(back, right), back], float)


def _sky(rays: Floats) -> Floats:
    """Return the colour of the sky along rays, both shape (..., 3)."""
    blend = np.clip(rays[..., 2:], 0, 1) ** 0.6
    return blend * np.array(ZENITH) + (1 - blend) * np.array(HORIZON)


def _light(normals: Floats, sunny: NDArray[np.bool_]) -> Floats:
    """Return how bright surfaces are, shape (n,): normals (n, 3), and whether the sun shines on them, shape (n,)."""
    direct = SUNLIGHT * sunny * np.clip(normals @ SUN, 0, None)
    return direct + BOUNCE + (SKYLIGHT - BOUNCE) * (1 + normals[:, 2]) / 2


def _outline(thing: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pixels have a neighbour that shows another thing; both have shape (height, width)."""
    edge = np.zeros(thing.shape, bool)
    upright, level = thing[1:] != thing[:-1], thing[:, 1:] != thing[:, :-1]
    edge[1:] |= upright
    edge[:-1] |= upright
    edge[:, 1:] |= level
    edge[:, :-1] |= level
    return edge


def _dark_share(x: Floats, y: Floats, footprint: Floats) -> Floats:
    """Return how much of a pixel lies on dark squares of a chessboard, 0..1; all have the same shape.

    The exact mean over a square footprint: https://iquilezles.org/articles/checkerfiltering.

    Args:
        x: In squares.
        y: In squares.
        footprint: Edge of what the pixel covers, in squares.
    """
    quarter = np.maximum(footprint, 1e-3) / 4

    def mean(place: Floats) -> Floats:
        half = place / 2
        before, behind = half - quarter, half + quarter
        return np.abs(before - np.floor(before) - 0.5) - np.abs(behind - np.floor(behind) - 0.5)

    return 0.5 - mean(x) * mean(y) / (8 * quarter * quarter)
