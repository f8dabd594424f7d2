"""Triangles of a robot's scene commands (`three.mesh`), for the ray tracer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.viewer.page.three import Command

Array = NDArray[np.float64]
Indices = NDArray[np.signedinteger[Any]]

SEGMENTS = 18  # around a round body; its normals are smooth, so that only the outline shows segments
ROWS = 9  # from pole to pole of a sphere


@dataclass(frozen=True)
class Mesh:
    """Triangles fixed to numbered bodies.

    Attributes:
        vertices: In the frame of their body [m], shape (n, 3).
        normals: Unit vectors in the frame of their body, shape (n, 3).
        bodies: Index of the body of each vertex, shape (n,).
        triangles: Vertices of each triangle, shape (m, 3).
        solids: A number for the solid that each triangle belongs to, shape (m,).
        colors: Red, green, blue in 0..1 of each triangle, shape (m, 3).
    """

    vertices: Array
    normals: Array
    bodies: NDArray[np.intp]
    triangles: NDArray[np.int32]
    solids: NDArray[np.intp]
    colors: Array


def mesh_of(commands: Iterable[Command], paths: dict[str, int]) -> Mesh:
    """Return the solids that commands draw directly at the paths of bodies.

    Args:
        commands: Commands of a robot; solids in hidden groups are left out.
        paths: Index of the body at each scene path.
    """
    parts: list[tuple[Array, Array, Indices, int, list[float]]] = []
    for command in commands:
        body = paths.get(command["path"].rpartition("/")[0])
        if command["type"] != "set_object" or body is None:
            continue
        points, normals, triangles = _solid(command["object"]["geometries"][0])
        matrix = np.reshape(command["object"]["object"]["matrix"], (4, 4)).T
        color = [(command["object"]["materials"][0]["color"] >> shift & 255) / 255 for shift in (16, 8, 0)]
        parts.append((points @ matrix[:3, :3].T + matrix[:3, 3], normals @ matrix[:3, :3].T, triangles, body, color))
    starts = np.cumsum([0, *(len(points) for points, *_ in parts)])
    return Mesh(
        np.concatenate([points for points, *_ in parts]),
        np.concatenate([normals for _, normals, *_ in parts]),
        np.concatenate([np.full(len(points), body) for points, _, _, body, _ in parts]),
        np.concatenate([part[2] + start for part, start in zip(parts, starts, strict=False)]).astype(np.int32),
        np.repeat(np.arange(len(parts)), [len(triangles) for _, _, triangles, *_ in parts]),
        np.concatenate([np.tile(color, (len(triangles), 1)) for _, _, triangles, _, color in parts]),
    )


def _solid(geometry: dict[str, Any]) -> tuple[Array, Array, Indices]:
    """Return vertices (n, 3), their normals (n, 3) and triangles (m, 3) of a geometry of `ce_gym.viewer.page.three`."""
    kind = geometry["type"]
    if kind == "BufferGeometry":
        return _faceted(geometry["data"])
    if kind == "BoxGeometry":
        return _box(np.array([geometry["width"], geometry["height"], geometry["depth"]]) / 2)
    if kind == "CylinderGeometry":
        radius, half = geometry["radiusBottom"], geometry["height"] / 2
        outline = np.array([[0, -half], [radius, -half], [radius, -half], [radius, half], [radius, half], [0, half]])
        return _turned(outline, np.array([[0, -1], [0, -1], [1, 0], [1, 0], [0, 1], [0, 1]], float))
    if kind == "SphereGeometry":
        angles = np.linspace(-np.pi / 2, np.pi / 2, ROWS)
        outward = np.column_stack([np.cos(angles), np.sin(angles)])
        return _turned(geometry["radius"] * outward, outward)
    outline = np.array([[point["x"], point["y"]] for point in geometry["points"]])[::3]  # a capsule, with fewer rows
    along = np.gradient(outline, axis=0)
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    return _turned(outline, outward / np.linalg.norm(outward, axis=1, keepdims=True))


def _faceted(data: dict[str, Any]) -> tuple[Array, Array, Indices]:
    """Return triangles without common corners, each with its own normal."""
    vertices = np.reshape(data["attributes"]["position"]["array"], (-1, 3))
    corners = vertices[np.reshape(data["index"]["array"], (-1, 3)).astype(np.intp)]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    return corners.reshape(-1, 3), np.repeat(normals, 3, axis=0), np.arange(3 * len(corners)).reshape(-1, 3)


def _box(half: Array) -> tuple[Array, Array, Indices]:
    """Return six faces of four corners each, with sharp edges."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    points, normals = np.empty((6, 4, 3)), np.zeros((6, 4, 3))
    for face in range(6):
        axis, side = face // 2, 1 - 2 * (face % 2)
        points[face, :, axis] = normals[face, :, axis] = side
        points[face][:, [(axis + 1) % 3, (axis + 2) % 3]] = corners
    triangles = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(6)[:, None, None]
    return points.reshape(-1, 3) * half, normals.reshape(-1, 3), triangles.reshape(-1, 3)


def _turned(outline: Array, outward: Array) -> tuple[Array, Array, Indices]:
    """Turn an outline (r, y) and its normals, shape (k, 2) each, about y."""
    angles = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    across = np.column_stack([np.cos(angles), np.zeros(SEGMENTS), np.sin(angles)])
    points, normals = (
        rows[:, None, :1] * across + rows[:, None, 1:] * np.array([0.0, 1.0, 0.0]) for rows in (outline, outward)
    )
    first, second = np.arange(SEGMENTS), np.roll(np.arange(SEGMENTS), -1)
    strip = np.concatenate(
        [
            np.column_stack([first, first + SEGMENTS, second]),
            np.column_stack([second, first + SEGMENTS, second + SEGMENTS]),
        ]
    )
    triangles = (strip + SEGMENTS * np.arange(len(outline) - 1)[:, None, None]).reshape(-1, 3)
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    a, b, c = points[triangles].swapaxes(0, 1)
    return points, normals, triangles[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0]
