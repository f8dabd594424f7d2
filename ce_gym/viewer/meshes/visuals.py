"""Mesh files and primitives of each body of a URDF or MJCF file.

A `Robot` has no meshes, since physics does not use them; the viewer reads the robot's file again.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote

import numpy as np

from ce_gym.model import RobotError
from ce_gym.model.description import Robot, Shape
from ce_gym.model.formats.mjcf.balls import balls_in_loops
from ce_gym.model.formats.mjcf.bodies import read_bodies
from ce_gym.model.formats.mjcf.equalities import locked_joints
from ce_gym.model.formats.mjcf.source import MjcfSource, placement, read_mjcf
from ce_gym.model.formats.mjcf.touching import solid
from ce_gym.model.formats.placement import compose
from ce_gym.model.formats.reading import read_yaml
from ce_gym.model.formats.text_file import one_line
from ce_gym.model.formats.urdf import elements as read
from ce_gym.model.formats.urdf.graph import UrdfGraph
from ce_gym.model.formats.urdf.tree import read_tree
from ce_gym.model.frames import ORIGIN, Placement, Vec3

Color = tuple[float, float, float, float]

KINDS = (".stl", ".obj", ".dae", ".ply", ".glb", ".gltf")
SEEN_GROUPS = 3  # MuJoCo's viewer shows geoms of the groups 0, 1 and 2; collision geoms usually are in group 3
_PLAIN = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour, for which the material's colour counts


@dataclass(frozen=True)
class MeshFile:
    """A mesh in a file.

    Attributes:
        file: A file of one of `KINDS`, or the MJCF file of the mesh.
        index: Number of the mesh in an MJCF file.
        scale: Factors along its axes.
        placement: Pose in the frame of its body.
        color: Red, green, blue, alpha in 0..1; None for the colour in the file.
    """

    file: Path
    index: int = 0
    scale: Vec3 = (1.0, 1.0, 1.0)
    placement: Placement = ORIGIN
    color: Color | None = None


Visual = MeshFile | Shape
Tag = Literal["visual", "collision"]


@dataclass(frozen=True)
class LinkShape:
    """A mesh or primitive of a link.

    Attributes:
        link: Name of the link, also of a link on a fixed joint.
        body: Name of the body that carries the link.
        item: The mesh or primitive, in the frame of the body.
    """

    link: str
    body: str
    item: Visual


def visuals_of(robot: Robot) -> dict[str, tuple[Visual, ...]]:
    """Return meshes and primitives of the bodies with meshes, by name; an empty mapping without the robot's file."""
    source = Path(robot.source)
    if not robot.source or not source.is_file():
        return {}
    names = frozenset(body.name for body in robot.bodies)
    shapes = _read(source, source.stat().st_mtime_ns, robot.floating, names, "visual")
    visuals = {name: tuple(shape.item for shape in shapes if shape.body == name) for name in names}
    return {name: items for name, items in visuals.items() if any(isinstance(item, MeshFile) for item in items)}


def link_shapes(robot: Robot, tag: Tag) -> tuple[LinkShape, ...]:
    """Return the meshes and primitives of all links that are drawn ("visual") or that touch ("collision")."""
    source = Path(robot.source)
    return _read(source, source.stat().st_mtime_ns, robot.floating, frozenset(body.name for body in robot.bodies), tag)


@lru_cache(maxsize=32)
def _read(source: Path, modified: int, floating: bool, names: frozenset[str], tag: Tag) -> tuple[LinkShape, ...]:
    """Read a file in its version of the time `modified`.

    Warns:
        UserWarning: Mesh files are missing, or of another kind.
    """
    try:
        if source.suffix.lower() in (".yaml", ".yml"):
            data = read_yaml(source).data
            source = source.parent / str(data.get("urdf") or data.get("mjcf"))
        if source.suffix.lower() == ".xml":
            return tuple(_read_mjcf(source, tag))
        return tuple(_read_urdf(source, floating, names, tag))
    except (RobotError, OSError) as error:  # the file may have changed since the robot was read
        warnings.warn(f"{source}: meshes are not drawn: {one_line(error)}", stacklevel=2)
        return ()


def _read_urdf(path: Path, floating: bool, names: Collection[str], tag: Tag) -> Iterator[LinkShape]:
    graph = UrdfGraph(path)
    frames = read_tree(graph, "floating" if floating else "fixed", tied=names).frames
    colors = read.colors_of(graph.file, graph.robot)
    missing: list[str] = []
    for link, element in graph.links.items():
        body, frame = frames[link]
        for visual in element.findall(tag) if body else ():
            try:
                item = _visual(graph.file, f"link {link!r}", visual, colors)
            except FileNotFoundError as error:
                missing.append(str(error))
            except RobotError as error:
                warnings.warn(f"{error}: its mesh is not drawn", stacklevel=2)
            else:
                if item is not None and body is not None:
                    yield LinkShape(link, body, replace(item, placement=compose(frame, item.placement)))
    if missing:
        problem = f"{len(missing)} meshes are missing or of another kind, such as {missing[0]!r}"
        warnings.warn(f"{path}: {problem}; expected {', '.join(KINDS)} files: shapes are drawn", stacklevel=2)


def _visual(file: str, where: str, visual: Any, colors: dict[str, Color]) -> Visual | None:
    """Return a mesh or a primitive of a <visual>, in the frame of its link.

    Raises:
        FileNotFoundError: A mesh file is missing, or of another kind.
        RobotError: The element is malformed.
    """
    mesh = visual.find("geometry/mesh")
    if mesh is None:
        return read.shape(file, where, visual, colors)
    name = mesh.get("filename", "")
    path = resolved(name, Path(file).parent)
    if path is None or path.suffix.lower() not in KINDS:
        raise FileNotFoundError(name)
    color, pose = _own_color(visual, colors, where, file), read.placement(file, where, visual)
    return MeshFile(path, scale=_scale(file, where, mesh), placement=pose, color=color)


def _scale(file: str, where: str, mesh: Any) -> Vec3:
    """Return the factors along the axes of a mesh; a single number is the factor of all three axes."""
    words = mesh.get("scale", "").split()
    if len(words) < 2:
        factor = read.number(file, where, mesh if words else None, "scale", 1.0)
        return (factor, factor, factor)
    x, y, z = read.numbers(file, where, mesh, "scale", 3)
    return (x, y, z)


def _own_color(visual: Any, colors: dict[str, Color], where: str, file: str) -> Color | None:
    material = visual.find("material")
    if material is None:
        return None
    color = material.find("color")
    return colors.get(material.get("name", "")) if color is None else read.numbers(file, where, color, "rgba", 4)  # type: ignore[return-value]


def resolved(name: str, folder: Path) -> Path | None:
    """Return the path of a file named in a URDF in `folder`; None without such a file.

    The folder of a package or model is the URDF's folder, a folder above, or a neighbour of these. `%20` stands for a
    space, as in addresses.
    """
    candidates = (path for spelled in (name, unquote(name)) for path in _candidates(spelled, folder))
    return next((path for path in candidates if "\0" not in str(path) and path.is_file()), None)


def _candidates(name: str, folder: Path) -> list[Path]:
    """Return the possible paths of a file."""
    kind, colons, rest = name.partition("://")
    if not colons:
        return [folder / name.removeprefix("file:")]
    if kind == "file":
        return [Path(rest.removeprefix("localhost"))]
    if kind not in ("package", "model"):
        return []
    package, _, inside = rest.partition("/")
    above = [folder.resolve(), *folder.resolve().parents]
    return [path / inside for path in above if path.name == package] + [path / package / inside for path in above]


def _read_mjcf(path: Path, tag: Tag) -> Iterator[LinkShape]:
    source = read_mjcf(path)
    model, kinds = source.model, source.mujoco.mjtGeom
    frames = read_bodies(source, locked_joints(source), balls_in_loops(source)).frames
    types = {kinds.mjGEOM_BOX: "box", kinds.mjGEOM_SPHERE: "sphere"}
    types |= {kinds.mjGEOM_CAPSULE: "capsule", kinds.mjGEOM_CYLINDER: "cylinder"}
    for geom in range(model.ngeom):
        body, frame = frames[model.geom_bodyid[geom]]
        link, kind = source.name("body", model.geom_bodyid[geom]), kinds(int(model.geom_type[geom]))
        seen = model.geom_group[geom] < SEEN_GROUPS if tag == "visual" else solid(source, geom)
        if body is None or not seen:
            continue
        pose, color = compose(frame, placement(model.geom_pos[geom], model.geom_quat[geom])), _geom_color(source, geom)
        if kind == kinds.mjGEOM_MESH:
            yield LinkShape(link, body, MeshFile(path, int(model.geom_dataid[geom]), placement=pose, color=color))
        elif kind in types:
            a, b, c = (float(x) for x in model.geom_size[geom])
            size = {"box": (2 * a, 2 * b, 2 * c), "sphere": (a,)}.get(types[kind], (a, 2 * b))
            yield LinkShape(link, body, Shape(types[kind], size, pose, color))  # type: ignore[arg-type]


def _geom_color(source: MjcfSource, geom: int) -> Color:
    model = source.model
    color, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material >= 0 and np.allclose(color, _PLAIN):
        color = model.mat_rgba[material]
    red, green, blue, alpha = (float(x) for x in color)
    return (red, green, blue, alpha)
