"""What a URDF or MJCF file lets one see of a robot that has meshes: mesh files and primitives, body by body.

Physics knows nothing of meshes, so that they are no part of a `Robot`; its file is read again when it is drawn.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.model import RobotError
from ce_gym.model.description import Robot, Shape
from ce_gym.model.formats.mjcf.balls import balls_in_loops
from ce_gym.model.formats.mjcf.bodies import read_bodies
from ce_gym.model.formats.mjcf.equalities import locked_joints
from ce_gym.model.formats.mjcf.source import MjcfSource, placement, read_mjcf
from ce_gym.model.formats.placement import compose
from ce_gym.model.formats.reading import read_yaml
from ce_gym.model.formats.urdf import elements as read
from ce_gym.model.formats.urdf.graph import UrdfGraph
from ce_gym.model.formats.urdf.tree import read_tree
from ce_gym.model.frames import ORIGIN, Placement, Vec3

Color = tuple[float, float, float, float]

KINDS = (".stl", ".obj", ".dae")
SEEN_GROUPS = 3  # MuJoCo's viewer shows geoms of the groups 0, 1 and 2; collision geoms usually are in group 3
_PLAIN = (0.5, 0.5, 0.5, 1.0)  # a geom's colour where its material's counts


@dataclass(frozen=True)
class MeshFile:
    """A mesh of a file.

    Attributes:
        file: A .stl, .obj or .dae file, or the MJCF file that has the mesh.
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
    names = {body.name for body in robot.bodies}
    found = _read(source, source.stat().st_mtime_ns, robot.floating)
    return {name: seen for name, seen in found.items() if name in names}


@lru_cache(maxsize=32)
def _read(source: Path, changed: int, floating: bool) -> dict[str, tuple[Visual, ...]]:
    """Read a file as it was at the time `changed`.

    Warns:
        UserWarning: Meshes that it names are not there.
    """
    try:
        if source.suffix.lower() in (".yaml", ".yml"):
            data = read_yaml(source).data
            source = source.parent / str(data.get("urdf") or data.get("mjcf"))
        items = list(_of_mjcf(source) if source.suffix.lower() == ".xml" else _of_urdf(source, floating))
    except (RobotError, OSError):  # the robot itself was read, perhaps from another state of the file
        return {}
    bodies = {body: tuple(one for name, one in items if name == body) for body, _ in items}
    return {body: seen for body, seen in bodies.items() if any(isinstance(one, MeshFile) for one in seen)}


def _of_urdf(path: Path, floating: bool) -> Iterator[tuple[str, Visual]]:
    graph, missing = UrdfGraph(path), list[str]()
    frames, colors = (
        read_tree(graph, "floating" if floating else "fixed").frames,
        read.colors_of(graph.file, graph.robot),
    )
    for link, element in graph.links.items():
        body, frame = frames[link]
        for visual in element.findall("visual") if body else ():
            mesh, where = visual.find("geometry/mesh"), f"link {link!r}"
            seen = read.shape(graph.file, where, visual, colors) if mesh is None else _mesh(graph.file, where, visual)
            missing += [mesh.get("filename", "")] if mesh is not None and seen is None else []
            if seen is not None and body is not None:
                color = _own_color(visual, colors, where, graph.file) if mesh is not None else seen.color
                yield body, replace(seen, placement=compose(frame, seen.placement), color=color)
    if missing:
        told = f"{len(missing)} meshes are not there, such as {missing[0]!r}; expected {', '.join(KINDS)} files"
        warnings.warn(f"{path}: {told}: shapes are drawn", stacklevel=2)


def _mesh(file: str, where: str, visual: Any) -> MeshFile | None:
    mesh = visual.find("geometry/mesh")
    found = resolved(mesh.get("filename", ""), Path(file).parent)
    if found is None:
        return None
    scale = read.numbers(file, where, mesh, "scale", 3) if mesh.get("scale") else (1.0, 1.0, 1.0)
    return MeshFile(found, scale=(scale[0], scale[1], scale[2]), placement=read.placement(file, where, visual))


def _own_color(visual: Any, colors: dict[str, Color], where: str, file: str) -> Color | None:
    material = visual.find("material")
    if material is None:
        return None
    color = material.find("color")
    return colors.get(material.get("name", "")) if color is None else read.numbers(file, where, color, "rgba", 4)  # type: ignore[return-value]


def resolved(name: str, folder: Path) -> Path | None:
    """Return the file that a URDF in a folder names; None if it is not there or of another kind.

    Of the address of a package, the folder of that name is that of the URDF or above it, or lies beside one of these.
    """
    kind, colons, rest = name.partition("://")
    if not colons:
        places = [folder / name]
    elif kind == "package":
        package, _, inside = rest.partition("/")
        above = [folder.resolve(), *folder.resolve().parents]
        places = [one / inside for one in above if one.name == package] + [one / package / inside for one in above]
    else:
        places = [Path(rest)] if kind == "file" else []
    return next((one for one in places if one.suffix.lower() in KINDS and one.is_file()), None)


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
