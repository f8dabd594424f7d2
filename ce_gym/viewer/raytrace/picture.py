"""Pictures of a robot as arrays, ray-traced on the CPU: no display and no OpenGL.

Embree computes the first hit of each ray. The picture depends on the pose alone, not on earlier pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.description import Shape
from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.page.lights_and_camera import FADING, FIELD_OF_VIEW, HORIZON, STEEP, SUN, VIEW, ZENITH
from ce_gym.viewer.page.robot import body_paths, extent, mark_commands, pose_bodies, robot_commands
from ce_gym.viewer.raytrace.ground import Field, Plane
from ce_gym.viewer.raytrace.mesh import mesh_of
from ce_gym.viewer.raytrace.rays import Array, Embree, Floats
from ce_gym.viewer.rollouts.ground_patch import clear_view, level

if TYPE_CHECKING:
    from ce_gym.dynamics.model import Model

TO_SUN = np.array(SUN) / np.linalg.norm(SUN)
SUNLIGHT, SKYLIGHT, BOUNCE = 0.72, 0.52, 0.28  # direct light, light from above and from below
SHADE = 0.70  # brightness of the ground in shadow
TILE = 0.5  # edge of a square of the ground [m]
TILES = np.array([[0.90, 0.92, 0.94], [0.79, 0.82, 0.86]], np.float32)
FAR = 14.0  # distance at which the ground is as pale as the horizon, in distances of the camera
CORNERS = np.array([[-0.3, 0.3], [0.3, -0.3]])  # of further rays through a pixel on an outline, from its middle
CLOSE = 1e-4  # distance of a shadow ray's start from its surface [m]


class _View(NamedTuple):
    """The robot in one pose, and the camera."""

    scene: Any  # of `Embree.scene`
    normals: Floats  # of the vertices, in the world
    centre: Floats  # x and y of the scene's origin on the ground's pattern, in squares
    eye: Floats  # place of the camera [m]
    axes: Array  # rows: the camera's x, y, z in the world


class _Backdrop(NamedTuple):
    """The ground and sky behind the robot, for some rays."""

    distance: Floats  # to the ground [m], infinite for the sky, shape (...)
    x: Floats  # of the point on the ground, in squares, shape (...)
    y: Floats
    height: Floats  # of that point [m]
    footprint: Floats  # edge of the pixel's image on the ground, in squares, shape (...)
    light: Floats  # colour of a light square in the haze, or of the sky, shape (..., 3)
    contrast: Floats  # difference of the colour of a dark square, shape (..., 3)

    def part(self, window: tuple[slice, slice]) -> _Backdrop:
        """Return rows and columns as a list of rays."""
        count = self.distance[window].size
        return _Backdrop(*(values[window].reshape(count, *values.shape[2:]) for values in self))


class Picture:
    """Draws one robot.

    Args:
        model: The robot.
        q: Positions in a typical pose on the plane z = 0, shape (nq,); they set the distance of the camera.
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].
        terrain: The ground; None for the plane z = 0.
        marks: Further shapes to draw on bodies, by name of the body.

    Raises:
        ViewerError: embreex is not installed.
    """

    def __init__(
        self,
        model: Model,
        q: Array,
        *,
        width: int = 640,
        height: int = 480,
        terrain: Terrain | None = None,
        marks: Mapping[str, Sequence[Shape]] | None = None,
    ) -> None:
        self._embree, self._model, robot = Embree(), model, model.robot
        self._ground = Field(self._embree, terrain) if terrain else Plane()
        commands = [*robot_commands(robot, ""), *mark_commands(robot, "", marks or {})]
        self._mesh = mesh_of(commands, {p: i for i, p in enumerate(body_paths(robot, "").values())})
        positions, rotations = pose_bodies(model, [q])
        box = extent(robot, positions[0], rotations[0])
        self._fixed, self._radius = None if robot.floating else box.middle[:2], box.radius
        tangent = np.tan(np.radians(FIELD_OF_VIEW / 2))
        back = np.array(VIEW) / np.linalg.norm(VIEW)
        distance = 1.3 * box.radius / np.sin(np.arctan(tangent)) * max(1.0, height / width)
        self._far, self._middle = FAR * distance, np.array([0.0, 0.0, box.middle[2]])
        self._eye = self._middle + distance * back
        self._size, self._focus = (width, height), height / 2 / tangent
        self._pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
        self._axes = _axes(back)
        self._rays = self._directions(self._pixels, self._axes)
        self._plane = None if terrain else self._backdrop(self._rays, self._eye, np.zeros(3))

    def draw(self, q: Array) -> NDArray[np.uint8]:
        """Return the robot at positions `q`, shape (nq,), as red, green, blue, shape (height, width, 3)."""
        positions, rotations = (rows[0] for rows in pose_bodies(self._model, [q]))
        centre = np.zeros(3)
        centre[:2] = positions[0, :2] if self._fixed is None else self._fixed
        centre[2] = level(self._ground.terrain, centre[None, :2], self._radius / 2)[0]
        mesh = self._mesh
        turn = rotations[mesh.bodies]
        vertices = np.einsum("nij,nj->ni", turn, mesh.vertices) + (positions - centre)[mesh.bodies]
        normals = np.einsum("nij,nj->ni", turn, mesh.normals).astype(np.float32)
        on_tiles = (centre[:2] / TILE % 2).astype(np.float32)
        eye, axes, pixels, behind = self._eye, self._axes, self._rays, self._plane
        if behind is None:
            eye = clear_view(self._ground.terrain, centre + self._middle, centre + eye, self._radius / 4) - centre
            if (eye != self._eye).any():
                axes = _axes(eye - self._middle)
                pixels = self._directions(self._pixels, axes)
            behind = self._backdrop(pixels, eye, centre)
        view = _View(self._embree.scene(vertices, mesh.triangles), normals, on_tiles, eye.astype(np.float32), axes)
        image = self._background(behind, view)
        window = self._window(vertices, view, self._ground.lowest(centre[:2]) - centre[2])
        part = image[window]  # a view
        colors, thing = self._trace(view, pixels[window].reshape(-1, 3), behind.part(window), part.reshape(-1, 3))
        part[:] = colors.reshape(part.shape)
        edges = _outline(thing.reshape(part.shape[:2]))
        if edges.any():  # more rays where neighbours differ, for smooth edges
            rays = self._directions((self._pixels[window][edges][:, None] + CORNERS).reshape(-1, 2), axes)
            backdrop = self._backdrop(rays, eye, centre)
            colors, _ = self._trace(view, rays, backdrop, self._background(backdrop, view))
            part[edges] = (part[edges] + colors.reshape(-1, len(CORNERS), 3).sum(1)) / (1 + len(CORNERS))
        return (255 * image + 0.5).astype(np.uint8)

    def close(self) -> None:
        """Do nothing; a `Renderer` must have this method."""

    def _directions(self, pixels: NDArray[Any], axes: Array) -> Floats:
        """Return unit vectors from the camera through pixels (x, y), shape (..., 2)."""
        width, height = self._size
        x, y = pixels[..., 0] + 0.5 - width / 2, height / 2 - 0.5 - pixels[..., 1]
        rays = np.stack([x, y, np.full(x.shape, -self._focus)], -1) @ axes
        return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)

    def _backdrop(self, rays: Floats, eye: Array, centre: Array) -> _Backdrop:
        """Return ground and sky behind the robot for rays from the camera, shape (..., 3)."""
        many = rays.reshape(-1, 3)
        met = self._ground.meet(centre, eye, many)
        hit = np.isfinite(met.distance)
        reach = np.where(hit, met.distance, 0)
        x, y, z = (eye.astype(np.float32) + reach[:, None] * many).T
        # A pixel covers this much ground across the ray, and more along it; the squares are averaged over both.
        facing = np.maximum(np.abs((met.normals * many).sum(1)), 0.02)
        footprint = reach / self._focus * (1 + 1 / facing) / 2 / TILE
        fade = np.clip((met.away - FADING) / (1 - FADING), 0, 1)
        distant = np.clip(reach / self._far, 0, 1) ** 2
        haze = np.where(hit, np.maximum(fade * fade * (3 - 2 * fade), distant), 1)[:, None]
        steep = 1 - STEEP * np.sqrt(np.maximum(1 - met.normals[:, 2] ** 2, 0))
        sunny = np.ones(len(many), bool)
        lit = (_light(met.normals, sunny) / _light(np.array([[0, 0, 1.0]]), sunny[:1]) * steep)[:, None]
        light = lit * TILES[0] * (1 - haze) + haze * _sky(many)
        contrast = lit * (1 - haze) * (TILES[1] - TILES[0])
        parts = (met.distance, x / TILE, y / TILE, z, footprint, light, contrast)
        return _Backdrop(*(np.reshape(p, (*rays.shape[:-1], *p.shape[1:])).astype(np.float32) for p in parts))

    def _background(self, backdrop: _Backdrop, view: _View) -> Floats:
        """Return the colours of ground and sky, shape (..., 3)."""
        x, y = backdrop.x + view.centre[0], backdrop.y + view.centre[1]
        return backdrop.light + _dark_share(x, y, backdrop.footprint)[..., None] * backdrop.contrast

    def _window(self, vertices: Array, view: _View, lowest: float) -> tuple[slice, slice]:
        """Return the rows and columns that may show the robot or its shadow; no ground is below `lowest` [m]."""
        onto_ground = vertices - np.maximum(vertices[:, 2:] - lowest, 0) / TO_SUN[2] * TO_SUN
        in_camera = (np.concatenate([vertices, onto_ground]) - view.eye) @ view.axes.T
        width, height = self._size
        if (in_camera[:, 2] > -1e-3).any():  # part of the robot is beside or behind the camera
            return slice(None), slice(None)
        spots = in_camera[:, :2] * [1, -1] / -in_camera[:, 2:] * self._focus + np.array([width, height]) / 2
        left, top = np.clip(np.floor(spots.min(0)) - 1, 0, [width, height]).astype(int).tolist()
        right, bottom = np.clip(np.ceil(spots.max(0)) + 1, 0, [width, height]).astype(int).tolist()
        return slice(top, bottom), slice(left, right)

    def _trace(
        self, view: _View, rays: Floats, backdrop: _Backdrop, background: Floats
    ) -> tuple[Floats, NDArray[np.intp]]:
        """Return the colours of rays from the camera, shape (n, 3), and the number of each hit object, shape (n,)."""
        hits = self._embree.meet(view.scene, np.broadcast_to(view.eye, rays.shape), rays)
        triangle = hits["primID"]
        hit = (triangle >= 0) & (hits["tfar"] < backdrop.distance)
        triangle, u, v = triangle[hit], hits["u"][hit, None], hits["v"][hit, None]
        a, b, c = view.normals[self._mesh.triangles[triangle]].swapaxes(0, 1)
        normal = (1 - u - v) * a + u * b + v * c
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        surface = view.eye + hits["tfar"][hit, None] * rays[hit] + CLOSE * normal
        ground = ~hit & np.isfinite(backdrop.distance)
        x, y = backdrop.x[ground] * np.float32(TILE), backdrop.y[ground] * np.float32(TILE)
        spots = np.column_stack([x, y, backdrop.height[ground] + np.float32(CLOSE)])
        starts = np.concatenate([surface, spots])
        dark = self._embree.meets(view.scene, starts, np.broadcast_to(TO_SUN.astype(np.float32), starts.shape))
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
    """Return the camera's x, y, z in the world as rows, shape (3, 3); `back` points from the target to the camera."""
    back = back / np.linalg.norm(back)
    right = np.array([-back[1], back[0], 0.0]) / np.hypot(back[0], back[1])
    return np.array([right, np.cross(back, right), back], float)


def _sky(rays: Floats) -> Floats:
    """Return the colour of the sky along rays, both shape (..., 3)."""
    blend = np.clip(rays[..., 2:], 0, 1) ** 0.6
    return blend * np.array(ZENITH) + (1 - blend) * np.array(HORIZON)


def _light(normals: Floats, sunny: NDArray[np.bool_]) -> Floats:
    """Return the brightness of surfaces, shape (n,), with normals, shape (n, 3), in the sun or not, shape (n,)."""
    direct = SUNLIGHT * sunny * np.clip(normals @ TO_SUN, 0, None)
    return direct + BOUNCE + (SKYLIGHT - BOUNCE) * (1 + normals[:, 2]) / 2


def _outline(thing: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return the pixels with a neighbour of another number; both have shape (height, width)."""
    edge = np.zeros(thing.shape, bool)
    upright, level = thing[1:] != thing[:-1], thing[:, 1:] != thing[:, :-1]
    edge[1:] |= upright
    edge[:-1] |= upright
    edge[:, 1:] |= level
    edge[:, :-1] |= level
    return edge


def _dark_share(x: Floats, y: Floats, footprint: Floats) -> Floats:
    """Return the share of dark squares of a chessboard in pixels, 0..1; all arrays have the same shape.

    Exact mean over a square footprint: https://iquilezles.org/articles/checkerfiltering.

    Args:
        x: In squares.
        y: In squares.
        footprint: Edge of the pixel's image on the ground, in squares.
    """
    quarter = np.maximum(footprint, 1e-3) / 4

    def mean(place: Floats) -> Floats:
        half = place / 2
        before, behind = half - quarter, half + quarter
        return np.abs(before - np.floor(before) - 0.5) - np.abs(behind - np.floor(behind) - 0.5)

    return 0.5 - mean(x) * mean(y) / (8 * quarter * quarter)
