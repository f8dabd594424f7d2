"""Reads mesh files as triangles, few enough for a page."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from ce_gym.model import RobotError
from ce_gym.model.description import Robot, Shape
from ce_gym.model.formats.mjcf.source import read_mjcf
from ce_gym.model.formats.text_file import check_regular
from ce_gym.model.frames import ORIGIN, Placement
from ce_gym.viewer.meshes.visuals import Color, Visual, visuals_of

MOST = 40_000  # triangles of all robots of a page, which keep the page below 5 MB
FEWEST = 80  # triangles of a simplified mesh
LARGEST = 2**27  # mesh file [bytes]

Mesh = tuple[NDArray[np.float64], NDArray[np.int64], Color | None]
"""Vertices [m], shape (n, 3), faces, shape (m, 3), and colour of a file."""


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
    """Return meshes and shapes of the bodies with readable meshes, by name.

    Meshes are simplified to at most `most` triangles together, in proportion to the triangles of their files.

    Warns:
        UserWarning: A mesh cannot be read, or a package for meshes is not installed.
    """
    full = {name: read_meshes(visuals) for name, visuals in visuals_of(robot).items()}
    count = sum(len(item.faces) for items in full.values() for item in items if isinstance(item, Triangles))
    share = min(1.0, most / max(count, 1))
    return {
        name: tuple(_simplified(item, share) if isinstance(item, Triangles) else item for item in items)
        for name, items in full.items()
        if any(isinstance(item, Triangles) for item in items)
    }


def read_meshes(visuals: Iterable[Visual]) -> list[Shape | Triangles]:
    """Return primitives and readable meshes.

    Warns:
        UserWarning: A mesh cannot be read, or a package for meshes is not installed.
    """
    items: list[Shape | Triangles] = []
    for visual in visuals:
        if isinstance(visual, Shape):
            items.append(visual)
            continue
        try:
            vertices, faces, color = _load(visual.file, visual.file.stat().st_mtime_ns, visual.index)
        except ImportError as error:
            warnings.warn(f'meshes are not drawn: pip install "ce_gym[viewer]" ({error})', stacklevel=2)
            continue
        except Exception as error:  # damaged files raise errors of many kinds
            warnings.warn(f"{visual.file}: mesh is not drawn: {' '.join(str(error).split())[:200]}", stacklevel=2)
            continue
        if np.prod(np.sign(visual.scale)) < 0:
            faces = faces[:, ::-1]  # a mirrored triangle faces inwards
        color = visual.color or color or Shape.color
        items.append(Triangles(vertices * np.array(visual.scale), faces, visual.placement, color))
    return items


@lru_cache(maxsize=256)
def _load(file: Path, modified: int, index: int) -> Mesh:
    """Return the mesh of a file in its version of the time `modified`.

    Raises:
        ImportError: A package for meshes is not installed.
        ValueError: The file is too large, unsafe, or without triangles.
    """
    if file.suffix.lower() == ".xml":
        return *_load_mjcf(file, index), None
    import trimesh

    if file.stat().st_size > LARGEST:
        raise ValueError(f"{file.stat().st_size} bytes; expected at most {LARGEST}")
    kind = file.suffix[1:].lower()
    is_collada, is_gltf = kind == "dae", kind in ("glb", "gltf")
    if is_collada and b"<!DOCTYPE" in file.read_bytes():  # entities can read other files or grow without bound
        raise ValueError("there is a <!DOCTYPE>; expected none")
    if is_gltf:
        _check_gltf(file)
    resolver: Any = _Resolver(file)
    # Materials of .obj files are in other files.
    scene: Any = trimesh.load_scene(str(file), file_type=kind, resolver=resolver, skip_materials=not is_gltf)
    mesh = scene.to_mesh()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    scale, faces = _collada_unit(file) if is_collada else 1.0, _proper(mesh.faces)
    if not len(faces) or not np.isfinite(mesh.vertices).all():
        raise ValueError("expected triangles with finite corners")
    return scale * np.array(mesh.vertices, float), faces, _color(scene)


class _Resolver:
    """Gives trimesh the further files of a mesh file, such as buffers of a .gltf, from its folder or below."""

    def __init__(self, mesh: Path) -> None:
        self.folder = mesh.parent.resolve()

    def get(self, name: str) -> bytes:
        """Return the bytes of a file.

        Raises:
            ValueError: The file is elsewhere, not regular, or too large.
        """
        path = next((path for path in (self.folder / name, self.folder / unquote(name)) if path.is_file()), None)
        if path is None or not path.resolve().is_relative_to(self.folder):
            raise ValueError(f"{name!r} is not in the folder of the mesh")
        check_regular(str(path), path.stat(), "a regular file", LARGEST)
        return path.read_bytes()

    __getitem__ = get

    def namespaced(self, namespace: str) -> _Resolver:
        """Return the resolver of a subfolder."""
        return _Resolver(self.folder / namespace / "mesh")


def _check_gltf(file: Path) -> None:
    """Check that a .glb or .gltf file declares no more numbers than its file size allows.

    Raises:
        ValueError: It does, or it is not glTF.
    """
    content = file.read_bytes()
    if content[:4] == b"glTF":  # header of 12 bytes, then length and kind of the first chunk, which is JSON
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    tree: Any = json.loads(content)
    accessors = tree.get("accessors", []) if isinstance(tree, dict) else []
    if sum(int(accessor.get("count", 0)) for accessor in accessors) > LARGEST // 4:
        raise ValueError(f"more numbers than a file of {LARGEST} bytes has")


def _proper(faces: Any) -> NDArray[np.int64]:
    """Return the triangles with three different corners."""
    a, b, c = np.transpose(faces)
    return np.asarray(faces, np.int64)[(a != b) & (b != c) & (c != a)]


def _collada_unit(file: Path) -> float:
    """Return the unit of a COLLADA file [m]. Its axes are not turned, as in ROS."""
    from xml.etree import ElementTree

    unit = ElementTree.parse(file).find("{*}asset/{*}unit")
    return 1.0 if unit is None else float(unit.get("meter", "1"))


def _color(scene: Any) -> Color | None:
    """Return the colour of a file's largest mesh, or None."""
    largest = max(scene.geometry.values(), key=lambda mesh: len(mesh.faces))
    visual: Any = largest.visual
    if not getattr(visual, "defined", False):
        return None
    if visual.kind != "texture":
        rgba = visual.to_color().main_color
    elif getattr(visual.material, "baseColorFactor", None) is not None:
        rgba = visual.material.main_color
    else:
        return None
    red, green, blue, alpha = (float(x) / 255 for x in np.ravel(rgba)[:4])
    return (red, green, blue, alpha)


def _load_mjcf(file: Path, index: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a mesh as compiled by MuJoCo: scaled, and moved to its reference."""
    model = _compile_mjcf(file, file.stat().st_mtime_ns)
    corner, corners = int(model.mesh_vertadr[index]), int(model.mesh_vertnum[index])
    face, faces = int(model.mesh_faceadr[index]), int(model.mesh_facenum[index])
    vertices = np.array(model.mesh_vert[corner : corner + corners], float)
    return vertices, np.array(model.mesh_face[face : face + faces], np.int64)


@lru_cache(maxsize=4)
def _compile_mjcf(file: Path, modified: int) -> Any:
    try:
        return read_mjcf(file).model
    except RobotError as error:
        raise ValueError(str(error)) from None


def _simplified(mesh: Triangles, share: float) -> Triangles:
    """Return a mesh with a share of its triangles (Garland and Heckbert 1997, quadric error metrics)."""
    most = max(FEWEST, int(share * len(mesh.faces)))
    if len(mesh.faces) <= most:
        return mesh
    import fast_simplification

    vertices, faces, *_ = fast_simplification.simplify(mesh.vertices, mesh.faces.astype(np.int32), target_count=most)
    proper = _proper(faces)
    return Triangles(np.asarray(vertices, float), proper, mesh.placement, mesh.color) if len(proper) else mesh
