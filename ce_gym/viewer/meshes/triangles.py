"""Mesh files -> triangles, few enough for a page."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model import RobotError
from ce_gym.model.description import Robot, Shape
from ce_gym.model.formats.mjcf.source import read_mjcf
from ce_gym.model.frames import ORIGIN, Placement
from ce_gym.viewer.meshes.parts import LARGEST, Beside, check_gltf
from ce_gym.viewer.meshes.visuals import Color, Visual, visuals_of

MOST = 40_000  # triangles of all robots of a page: with them it stays below 5 MB
FEWEST = 80  # triangles of a mesh, however small its share


@dataclass(frozen=True, eq=False)
class Triangles:
    """A mesh to draw.

    Attributes:
        vertices: In its own frame [m], shape (n, 3).
        faces: Vertices of each triangle, shape (m, 3).
        placement: Pose in the frame of its body.
        color: Red, green, blue, alpha in 0..1.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    placement: Placement = ORIGIN
    color: Color = Shape.color


def drawn_meshes(robot: Robot, most: int = MOST) -> dict[str, tuple[Shape | Triangles, ...]]:
    """Return what is drawn of those bodies of a robot whose meshes can be read, by name.

    Meshes share `most` triangles in proportion to those that their files have.

    Warns:
        UserWarning: A mesh cannot be read, or what reads meshes is not installed.
    """
    full = {name: _full(seen) for name, seen in visuals_of(robot).items()}
    count = sum(len(one.faces) for items in full.values() for one in items if isinstance(one, Triangles))
    share = min(1.0, most / max(count, 1))
    return {
        name: tuple(_thinned(one, share) if isinstance(one, Triangles) else one for one in items)
        for name, items in full.items()
        if any(isinstance(one, Triangles) for one in items)
    }


def _full(seen: tuple[Visual, ...]) -> list[Shape | Triangles]:
    """Return primitives, and the meshes that can be read."""
    found: list[Shape | Triangles] = []
    for one in seen:
        if isinstance(one, Shape):
            found.append(one)
            continue
        try:
            vertices, faces, color = _loaded(one.file, one.file.stat().st_mtime_ns, one.index)
        except ImportError as error:
            warnings.warn(f'meshes are not drawn: pip install "ce_gym[viewer]" ({error})', stacklevel=2)
            continue
        except Exception as error:  # damage shows in every kind of them
            warnings.warn(f"{one.file}: mesh is not drawn: {' '.join(str(error).split())[:200]}", stacklevel=2)
            continue
        shown = one.color or color or Shape.color
        mirrored = np.prod(np.sign(one.scale)) < 0
        outwards = faces[:, ::-1] if mirrored else faces  # corners counterclockwise, seen from outside
        found.append(Triangles(vertices * np.array(one.scale), outwards, one.placement, shown))
    return found


@lru_cache(maxsize=256)
def _loaded(file: Path, changed: int, index: int) -> tuple[NDArray[np.float64], NDArray[np.int64], Color | None]:
    """Return vertices, triangles and colour of a file as it was at the time `changed`.

    Raises:
        ImportError: What reads it is not installed.
        ValueError: It is too large, or has no triangles.
    """
    if file.suffix.lower() == ".xml":
        return *_of_mjcf(file, index), None
    import trimesh

    if file.stat().st_size > LARGEST:
        raise ValueError(f"{file.stat().st_size} bytes; expected at most {LARGEST}")
    kind = file.suffix[1:].lower()
    is_collada, is_gltf = kind == "dae", kind in ("glb", "gltf")
    if is_collada and b"<!DOCTYPE" in file.read_bytes():  # entities can read other files or grow without bound
        raise ValueError("there is a <!DOCTYPE>; expected none")
    if is_gltf:
        check_gltf(file)
    beside: Any = Beside(file)
    # Materials of .obj files are files of their own.
    scene: Any = trimesh.load_scene(str(file), file_type=kind, resolver=beside, skip_materials=not is_gltf)
    mesh = scene.to_mesh()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    scale, faces = _unit(file) if is_collada else 1.0, _proper(mesh.faces)
    if not len(faces) or not np.isfinite(mesh.vertices).all():
        raise ValueError("expected triangles with finite corners")
    return scale * np.array(mesh.vertices, float), faces, _color(scene)


def _proper(faces: Any) -> NDArray[np.int64]:
    """Return the triangles that have three corners."""
    a, b, c = np.transpose(faces)
    return np.asarray(faces, np.int64)[(a != b) & (b != c) & (c != a)]


def _unit(file: Path) -> float:
    """Return the length of a COLLADA file's unit [m]; its axes are taken as they are, as ROS does."""
    from xml.etree import ElementTree

    found = ElementTree.parse(file).find("{*}asset/{*}unit")
    return 1.0 if found is None else float(found.get("meter", "1"))


def _color(scene: Any) -> Color | None:
    """Return the colour of most of a file's triangles, if it has any."""
    largest = max(scene.geometry.values(), key=lambda one: len(one.faces))
    visual: Any = largest.visual
    if not getattr(visual, "defined", False):
        return None
    if visual.kind == "texture":  # the colours of pictures are not read, those of a COLLADA file's materials are
        if getattr(visual.material, "baseColorFactor", None) is None:
            return None
        found = visual.material.main_color
    else:
        found = visual.to_color().main_color
    red, green, blue, alpha = (float(x) / 255 for x in np.ravel(found)[:4])
    return (red, green, blue, alpha)


def _of_mjcf(file: Path, index: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a mesh as MuJoCo has compiled it: scaled, and moved to its reference."""
    model = _compiled(file, file.stat().st_mtime_ns)
    corner, corners = int(model.mesh_vertadr[index]), int(model.mesh_vertnum[index])
    face, faces = int(model.mesh_faceadr[index]), int(model.mesh_facenum[index])
    found = np.array(model.mesh_face[face : face + faces], np.int64)
    return np.array(model.mesh_vert[corner : corner + corners], float), found


@lru_cache(maxsize=4)
def _compiled(file: Path, changed: int) -> Any:
    try:
        return read_mjcf(file).model
    except RobotError as error:
        raise ValueError(str(error)) from None


def _thinned(mesh: Triangles, share: float) -> Triangles:
    """Return a mesh with a share of its triangles (Garland and Heckbert 1997, quadric error metrics)."""
    most = max(FEWEST, int(share * len(mesh.faces)))
    if len(mesh.faces) <= most:
        return mesh
    import fast_simplification

    faces = mesh.faces.astype(np.int32)
    vertices, fewer, *_ = fast_simplification.simplify(mesh.vertices, faces, target_count=most)
    proper = _proper(fewer)
    return Triangles(np.asarray(vertices, float), proper, mesh.placement, mesh.color) if len(proper) else mesh
