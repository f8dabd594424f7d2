"""What a URDF or MJCF file lets one see of a robot that has meshes: mesh files and primitives, body by body.

Physics knows nothing of meshes, so that they are no part of a `Robot`; its file is read again when it is drawn.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from ce_gym.model import RobotError
from ce_gym.model.description import Robot, Shape
from ce_gym.model.formats.mjcf.balls import balls_in_loops
from ce_gym.model.formats.mjcf.bodies import read_bodies
from ce_gym.model.formats.mjcf.equalities import locked_joints
from ce_gym.model.formats.mjcf.source import MjcfSource, placement, read_mjcf
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
_PLAIN = (0.5, 0.5, 0.5, 1.0)  # a geom's colour where its material's counts


@dataclass(frozen=True)
class MeshFile:
    """A mesh of a file.

    Attributes:
        file: A file of one of `KINDS`, or the MJCF file that has the mesh.
        index: Number of the mesh in an MJCF file.
        scale: Factors along its axes.
        placement: Pose in the frame of its body.
        color: Red, green, blue, alpha in 0..1; None for the file's own.
    """

    file: Path
    index: int = 0
    scale: Vec3 = (1.0, 1.0, 1.0)
    placement: Placement = ORIGIN
    color: Color | None = None


Visual = MeshFile | Shape


def visuals_of(robot: Robot) -> dict[str, tuple[Visual, ...]]:
    """Return what is seen of those bodies of a robot that have meshes, by name; nothing if its file is gone."""
    source = Path(robot.source)
    if not robot.source or not source.is_file():
        return {}
    names = frozenset(body.name for body in robot.bodies)
    found = _read(source, source.stat().st_mtime_ns, robot.floating, names)
    return {name: seen for name, seen in found.items() if name in names}


@lru_cache(maxsize=32)
def _read(source: Path, changed: int, floating: bool, names: frozenset[str]) -> dict[str, tuple[Visual, ...]]:
    """Read a file as it was at the time `changed`.

    Warns:
        UserWarning: Meshes that it names are not there.
    """
    try:
        if source.suffix.lower() in (".yaml", ".yml"):
            data = read_yaml(source).data
            source = source.parent / str(data.get("urdf") or data.get("mjcf"))
        items = list(_of_mjcf(source) if source.suffix.lower() == ".xml" else _of_urdf(source, floating, names))
    except (RobotError, OSError) as error:  # the robot itself was read, perhaps from another state of the file
        warnings.warn(f"{source}: meshes are not drawn: {one_line(error)}", stacklevel=2)
        return {}
    bodies = {body: tuple(one for name, one in items if name == body) for body, _ in items}
    return {body: seen for body, seen in bodies.items() if any(isinstance(one, MeshFile) for one in seen)}


def _of_urdf(path: Path, floating: bool, names: Collection[str]) -> Iterator[tuple[str, Visual]]:
    graph, undrawn = UrdfGraph(path), dict[str, list[str]]()
    frames, colors = (
        read_tree(graph, "floating" if floating else "fixed", tied=names).frames,
        read.colors_of(graph.file, graph.robot),
    )
    for link, element in graph.links.items():
        body, frame = frames[link]
        for visual in element.findall("visual") if body else ():
            where = f"link {link!r}"
            try:
                seen = _seen(graph.file, where, visual, colors)
            except FileNotFoundError as missing:
                undrawn.setdefault("not there", []).append(str(missing))
            except _OtherKind as other:
                undrawn.setdefault("of a kind that is not read", []).append(str(other))
            except RobotError as error:
                warnings.warn(f"{error}: its mesh is not drawn", stacklevel=2)
            else:
                if seen is not None and body is not None:
                    yield body, replace(seen, placement=compose(frame, seen.placement))
    for problem, names in undrawn.items():
        told = f"{len(names)} meshes are {problem}, such as {names[0]!r}; expected {', '.join(KINDS)} files"
        warnings.warn(f"{path}: {told}: shapes are drawn", stacklevel=2)


class _OtherKind(Exception):
    """A file that is there, but not of one of `KINDS`."""


def _seen(file: str, where: str, visual: Any, colors: dict[str, Color]) -> Visual | None:
    """Return a mesh or a primitive of a <visual>, in the frame of its link.

    Raises:
        FileNotFoundError: A mesh is not there.
        _OtherKind: It is of a kind that is not read.
        RobotError: The element is malformed.
    """
    mesh = visual.find("geometry/mesh")
    if mesh is None:
        return read.shape(file, where, visual, colors)
    name = mesh.get("filename", "")
    found = resolved(name, Path(file).parent)
    if found is None:
        raise FileNotFoundError(name)
    if found.suffix.lower() not in KINDS:
        raise _OtherKind(name)
    color, place = _own_color(visual, colors, where, file), read.placement(file, where, visual)
    return MeshFile(found, scale=_scale(file, where, mesh), placement=place, color=color)


def _scale(file: str, where: str, mesh: Any) -> Vec3:
    """Return the factors along the axes of a mesh; one number counts for all of them."""
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
    """Return the file that a URDF in a folder names; None if it is not there.

    Of the address of a package or model, the folder of that name is that of the URDF or above it, or lies beside one of
    these. Characters such as spaces may be written as `%20`, as addresses have them.
    """
    places = (place for spelled in (name, unquote(name)) for place in _places(spelled, folder))
    return next((one for one in places if "\0" not in str(one) and one.is_file()), None)


def _places(name: str, folder: Path) -> list[Path]:
    """Return where a file may be."""
    kind, colons, rest = name.partition("://")
    if not colons:
        return [folder / name.removeprefix("file:")]
    if kind == "file":
        return [Path(rest.removeprefix("localhost"))]
    if kind not in ("package", "model"):
        return []
    package, _, inside = rest.partition("/")
    above = [folder.resolve(), *folder.resolve().parents]
    return [one / inside for one in above if one.name == package] + [one / package / inside for one in above]


def _of_mjcf(path: Path) -> Iterator[tuple[str, Visual]]:
    source = read_mjcf(path)
    model, kinds = source.model, source.mujoco.mjtGeom
    frames = read_bodies(source, locked_joints(source), balls_in_loops(source)).frames
    types = {kinds.mjGEOM_BOX: "box", kinds.mjGEOM_SPHERE: "sphere"}
    types |= {kinds.mjGEOM_CAPSULE: "capsule", kinds.mjGEOM_CYLINDER: "cylinder"}
    for geom in range(model.ngeom):
        body, frame = frames[model.geom_bodyid[geom]]
        kind = kinds(int(model.geom_type[geom]))
        if body is None or model.geom_group[geom] >= SEEN_GROUPS:
            continue
        pose, color = compose(frame, placement(model.geom_pos[geom], model.geom_quat[geom])), _geom_color(source, geom)
        if kind == kinds.mjGEOM_MESH:
            yield body, MeshFile(path, int(model.geom_dataid[geom]), placement=pose, color=color)
        elif kind in types:
            a, b, c = (float(x) for x in model.geom_size[geom])
            size = {"box": (2 * a, 2 * b, 2 * c), "sphere": (a,)}.get(types[kind], (a, 2 * b))
            yield body, Shape(types[kind], size, pose, color)  # type: ignore[arg-type]


def _geom_color(source: MjcfSource, geom: int) -> Color:
    model = source.model
    color, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material >= 0 and np.allclose(color, _PLAIN):
        color = model.mat_rgba[material]
    red, green, blue, alpha = (float(x) for x in color)
    return (red, green, blue, alpha)
