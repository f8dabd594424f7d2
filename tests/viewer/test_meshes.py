"""Meshes of a robot's own files: where their corners are, how many are left, and what is drawn without them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import LossyImportWarning, load_robot
from ce_gym.model.description import Shape
from ce_gym.viewer import Rollout
from ce_gym.viewer.meshes.triangles import MOST, Triangles, read_meshes
from ce_gym.viewer.page.html import page
from ce_gym.viewer.page.robot import body_paths, extent, robot_commands
from ce_gym.viewer.raytrace.mesh import mesh_of

for package in ("trimesh", "collada", "fast_simplification", "meshcat"):
    pytest.importorskip(package)

CORNERS = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
TURNED = '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
COLLISION = '<collision><geometry><box size="1 1 1"/></geometry></collision>'


def stl(corners: np.ndarray = CORNERS) -> str:
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {} {} {}\n".format(*corners[i]) for i in face)
        + "endloop\nendfacet\n"
        for face in FACES
    )
    return f"solid one\n{facets}endsolid one\n"


def obj(corners: np.ndarray, faces: np.ndarray) -> str:
    lines = ["v {} {} {}".format(*corner) for corner in corners]
    return "\n".join(lines + ["f {} {} {}".format(*(1 + np.array(face))) for face in faces]) + "\n"


def dae(corners: np.ndarray, meter: float) -> str:
    numbers = " ".join(map(str, (corners / meter).ravel()))
    return f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="part" meter="{meter}"/><up_axis>Z_UP</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="c"><lambert><diffuse><color>0 0.2 1 1</color></diffuse>
</lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">{numbers}</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4" material="s"><input semantic="VERTEX" source="#v" offset="0"/>
<p>{" ".join(str(i) for face in FACES for i in face)}</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g">
<bind_material><technique_common><instance_material symbol="s" target="#m"/></technique_common>
</bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def urdf(folder: Path, mesh: str, more: str = "") -> Path:
    """A robot of one link in the folder `urdf` of a package, whose mesh is moved and turned by a quarter about z."""
    file = folder / "my_robot" / "urdf" / "one.urdf"
    file.parent.mkdir(parents=True)
    visual = f"<visual>{TURNED}<geometry>{mesh}</geometry></visual>"
    file.write_text(f'<robot name="one"><link name="base">{INERTIAL}{visual}{COLLISION}{more}</link></robot>')
    return file


def points_of(shape: Triangles) -> np.ndarray:
    """The corners in the frame of the body, in an order of their own."""
    found = shape.vertices @ np.array(shape.placement.rotation).T + shape.placement.position
    return found[np.lexsort(found.round(6).T)]


def sorted_points(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.round(6).T)]


MOVED = sorted_points(CORNERS @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] + [1, 2, 3])


@pytest.mark.parametrize(
    ("name", "where", "text"),
    [
        ("../meshes/one.STL", "my_robot/meshes/one.STL", stl()),
        ("package://my_robot/meshes/one.obj", "my_robot/meshes/one.obj", obj(CORNERS, np.array(FACES))),
        ("package://parts/one.dae", "parts/one.dae", dae(CORNERS, 0.01)),
    ],
)
def test_meshes_of_a_urdf_are_where_it_says(name: str, where: str, text: str, tmp_path: Path) -> None:
    file = urdf(tmp_path, f'<mesh filename="{name}"/>')
    (tmp_path / where).parent.mkdir(exist_ok=True)
    (tmp_path / where).write_text(text)
    (shape,) = read_meshes(load_robot(file, floating=True))["base"]
    assert isinstance(shape, Triangles)
    assert len(shape.faces) == 4
    np.testing.assert_allclose(points_of(shape), MOVED, atol=1e-6)
    np.testing.assert_allclose(
        shape.color, (0.0, 0.2, 1.0, 1.0) if name.endswith(".dae") else Shape.color, atol=1 / 255
    )


def test_meshes_of_an_mjcf_are_where_it_says(tmp_path: Path) -> None:
    """A corner `v` of the file is at `p + s (v - r)`: scale `s`, reference `r` of the mesh, place `p` of the geom."""
    pytest.importorskip("mujoco")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "one.obj").write_text(obj(CORNERS, np.array(FACES)))
    file = tmp_path / "one.xml"
    file.write_text(
        '<mujoco><compiler meshdir="parts"/><asset><material name="red" rgba="1 0 0 1"/>'
        '<mesh name="one" file="one.obj" scale="2 1 3" refpos="0.1 0 0"/></asset>'
        '<worldbody><body name="base"><freejoint/><geom type="box" size="1 1 1" group="3"/>'
        '<geom type="mesh" mesh="one" pos="1 2 3" group="2" material="red"/></body></worldbody></mujoco>'
    )
    with pytest.warns(LossyImportWarning):
        robot = load_robot(file)
    (shape,) = read_meshes(robot)["base"]  # not the box, which only touches
    assert isinstance(shape, Triangles)
    assert shape.color == (1.0, 0.0, 0.0, 1.0)
    expected = sorted_points((CORNERS - [0.1, 0, 0]) * [2, 1, 3] + [1, 2, 3])
    np.testing.assert_allclose(points_of(shape), expected, atol=1e-6)


def test_places_in_a_picture_that_is_not_there_are_no_colour(tmp_path: Path) -> None:
    """As some tools write every OBJ file."""
    file = urdf(tmp_path, '<mesh filename="one.obj"/>')
    lines = obj(CORNERS, np.array(FACES)).replace("f ", "vt 0 0\nf ", 1).splitlines()
    faces = [" ".join(["f", *(f"{i}/1" for i in line.split()[1:])]) if line[0] == "f" else line for line in lines]
    (file.parent / "one.obj").write_text("\n".join(faces) + "\n")
    (shape,) = read_meshes(load_robot(file, floating=True))["base"]
    assert isinstance(shape, Triangles)
    assert shape.color == Shape.color


def ball(rows: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A unit sphere of two triangles for each of 2 rows x rows rectangles of latitude and longitude."""
    latitude, longitude = np.linspace(-np.pi / 2, np.pi / 2, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1)
    a, b = np.meshgrid(latitude, longitude, indexing="ij")
    corners = np.stack([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)], -1).reshape(-1, 3)
    first = (np.arange(rows)[:, None] * (2 * rows + 1) + np.arange(2 * rows)).ravel()
    up = first + 2 * rows + 1
    return corners, np.concatenate([np.stack(t, 1) for t in ((first, first + 1, up), (up, first + 1, up + 1))])


@pytest.fixture(scope="module")
def round_robot(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("round")
    file = urdf(folder, '<mesh filename="ball.obj" scale="0.5 0.5 0.5"/>')
    (file.parent / "ball.obj").write_text(obj(*ball()))
    return load_robot(file, floating=True)


def test_meshes_are_thinned_and_keep_their_form(round_robot) -> None:
    (all_of_it,) = read_meshes(round_robot)["base"]
    (shape,) = read_meshes(round_robot, most=600)["base"]
    assert isinstance(shape, Triangles)
    assert 300 < len(shape.faces) <= 600 < len(all_of_it.faces) <= MOST
    np.testing.assert_allclose(np.linalg.norm(shape.vertices, axis=1), 0.5, atol=0.02)
    a, b, c = shape.vertices[shape.faces].swapaxes(0, 1)
    assert abs(np.einsum("ij,ij->", a, np.cross(b, c)) / 6) == pytest.approx(4 / 3 * np.pi / 8, rel=0.03)


def test_pages_and_pictures_draw_them(round_robot, tmp_path: Path) -> None:
    commands = list(robot_commands(round_robot, "/robot", triangles=600))
    (mesh,) = [one for one in commands if one["type"] == "set_object"]
    assert mesh["object"]["geometries"][0]["type"] == "BufferGeometry"
    solid = mesh_of(commands, dict.fromkeys(body_paths(round_robot, "/robot").values(), 0))
    np.testing.assert_allclose(np.linalg.norm(solid.vertices - [1, 2, 3], axis=1), 0.5, atol=0.02)
    outward = np.einsum("ij,ij->i", solid.normals, (solid.vertices - [1, 2, 3]) / 0.5)
    assert np.median(np.abs(outward)) > 0.98
    low, high = extent(round_robot, np.zeros((1, 3)), np.eye(3)[None])
    np.testing.assert_allclose([low, high], [[0, 0, 0], [1.5, 2.5, 3.5]], atol=0.01)  # the origin of the body as well
    model = Model(round_robot)
    times = 0.02 * np.arange(5)
    q, v = np.tile(model.standing_q, (5, 1)), np.zeros((5, model.nv))
    rollout = Rollout(round_robot.source, "exact", 0.02, times, q, v)
    assert len(page([rollout], models=[model])) < 5e6


@pytest.mark.parametrize("text", ["", "solid nothing\nendsolid\n", "<!DOCTYPE x>" + dae(CORNERS, 1.0)])
def test_what_cannot_be_read_is_drawn_by_shapes(text: str, tmp_path: Path) -> None:
    name = "one.dae" if "COLLADA" in text else "one.stl"
    file = urdf(tmp_path, f'<mesh filename="{name}"/>')
    (file.parent / name).write_text(text)
    robot = load_robot(file, floating=True)
    with pytest.warns(UserWarning, match="mesh is not drawn") as told:
        assert read_meshes(robot) == {}
    assert "\n" not in str(told[0].message)


def volume(shape: Triangles) -> float:
    """Volume of a closed mesh [m^3], positive if its triangles face outwards."""
    a, b, c = shape.vertices[shape.faces].swapaxes(0, 1)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize("kind", ["stl", "obj", "ply", "glb", "gltf", "GLB", "PLY"])
@pytest.mark.parametrize("scale", ["1 1 1", "1 -1 1", "-1 -1 1", "-2 -1 -1", "0.5", "-1"])
def test_triangles_face_outwards_whatever_the_scale(kind: str, scale: str, tmp_path: Path) -> None:
    """A box of 0.001 m^3 at (0.3, 0.2, 0.1) that its file has behind a reflection where it can, read with a scale."""
    trimesh = pytest.importorskip("trimesh")
    solid, mirror = trimesh.creation.box((0.2, 0.1, 0.05)), np.diag([1.0, -1.0, 1.0, 1.0])
    solid.apply_translation((0.3, -0.2 if "gl" in kind.lower() else 0.2, 0.1))
    scene = trimesh.Scene()
    scene.add_geometry(solid, transform=mirror if "gl" in kind.lower() else None)
    file = urdf(tmp_path, f'<mesh filename="one.{kind}" scale="{scale}"/>')
    if kind == "gltf":
        for name, data in scene.export(file_type="gltf").items():
            (file.parent / name.replace("model", "one")).write_bytes(data)
    else:
        (scene if kind.lower() == "glb" else solid).export(file.parent / f"one.{kind}", file_type=kind.lower())
    (shape,) = read_meshes(load_robot(file, floating=True))["base"]
    assert isinstance(shape, Triangles)
    factors = np.array([float(x) for x in scale.split()]) * np.ones(3)
    assert volume(shape) == pytest.approx(0.001 * abs(np.prod(factors)), rel=1e-5)
    np.testing.assert_allclose(shape.vertices.mean(0), np.array([0.3, 0.2, 0.1]) * factors, atol=1e-6)


def test_meshes_that_an_mjcf_mirrors_face_outwards(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("mujoco")
    trimesh.creation.box((0.2, 0.1, 0.05)).export(tmp_path / "one.stl")
    file = tmp_path / "one.xml"
    file.write_text(
        '<mujoco><asset><mesh name="one" file="one.stl" scale="1 -1 1"/></asset><worldbody><body name="base">'
        '<freejoint/><geom type="mesh" mesh="one"/></body></worldbody></mujoco>'
    )
    (shape,) = read_meshes(load_robot(file))["base"]
    assert isinstance(shape, Triangles)
    assert volume(shape) == pytest.approx(0.001, rel=1e-5)


NANS = stl().replace("vertex 0", "vertex nan", 1)


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("bad.stl", b"", "bad.stl: mesh is not drawn"),
        ("bad.stl", NANS.encode(), "bad.stl: mesh is not drawn"),
        ("bad.stl", bytes(80) + b"\x09\0\0\0" + bytes(60), "bad.stl: mesh is not drawn"),
        ("bad.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 2\n", "bad.obj: mesh is not drawn"),
        ("bad.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n", "bad.ply: mesh is not"),
        ("bad.glb", b"glTF\2\0\0\0", "bad.glb: mesh is not drawn"),
        ("bad.gltf", b'{"asset": {"version": "2.0"}, "accessors": [{"count": 1000000000000}]}', "more numbers than"),
        ("bad.gltf", b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "../../secret"}]}', "not in the folder"),
        (
            "bad.step",
            b"ISO-10303-21;",
            "1 meshes are missing or of another kind, such as 'bad.step'; expected .stl, .obj",
        ),
        ("other.stl", b"", "1 meshes are missing or of another kind, such as 'bad.stl'"),
        ("good.stl", stl().encode(), "scale"),
    ],
)
def test_a_bad_mesh_hides_only_itself(name: str, content: bytes, what: str, tmp_path: Path) -> None:
    scale = ' scale="1 2"' if what == "scale" else ""
    asked = "bad.stl" if name == "other.stl" else name
    more = f'<visual><geometry><mesh filename="{asked}"{scale}/></geometry></visual>'
    file = urdf(tmp_path, '<mesh filename="good.stl"/>', more)
    (tmp_path / "secret").write_bytes(b"x")
    (file.parent / name).write_bytes(content)
    (file.parent / "good.stl").write_text(stl())
    with pytest.warns(UserWarning, match=what) as told:
        (shape,) = read_meshes(load_robot(file, floating=True))["base"]
    assert isinstance(shape, Triangles)
    assert len([one for one in told if one.category is UserWarning]) == 1
    np.testing.assert_allclose(points_of(shape), MOVED, atol=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        "a part.stl",
        "a%20part.stl",
        "100%.stl",
        "{folder}/a part.stl",
        "file://{folder}/a part.stl",
        "file://{folder}/a%20part.stl",
        "file://localhost{folder}/a%20part.stl",
        "file:{folder}/a%20part.stl",
        "package://my_robot/urdf/a%20part.stl",
        "model://my_robot/urdf/a part.stl",
    ],
)
def test_paths_with_spaces_and_addresses(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "my_robot" / "urdf"
    file = urdf(tmp_path, f'<mesh filename="{name.format(folder=folder)}"/>')
    for each in ("a part.stl", "100%.stl"):
        (folder / each).write_text(stl())
    assert len(read_meshes(load_robot(file, floating=True))["base"]) == 1


@pytest.mark.parametrize("name", ["missing.stl", "package://other/one.stl", "http://host/one.stl", "one.urdf"])
def test_what_is_not_there_is_drawn_by_shapes(name: str, tmp_path: Path) -> None:
    robot = load_robot(urdf(tmp_path, f'<mesh filename="{name}"/>'), floating=True)
    with pytest.warns(
        UserWarning, match=r"one.urdf: 1 meshes are .*, such as .*; expected .stl, .obj, .dae, .ply, .glb, .gltf files"
    ):
        assert read_meshes(robot) == {}
    (shape,) = [one for one in robot_commands(robot, "/robot") if one["type"] == "set_object"]
    assert shape["object"]["geometries"][0]["type"] == "BoxGeometry"
