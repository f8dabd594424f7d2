"""Meshes of robot files: their corners, their simplification, and the shapes drawn without them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import load_robot
from ce_gym.model.description import Shape
from ce_gym.viewer import Rollout
from ce_gym.viewer.meshes.triangles import MOST, Triangles, drawn_meshes
from ce_gym.viewer.page.html import page
from ce_gym.viewer.page.robot import body_paths, extent, robot_commands
from ce_gym.viewer.raytrace.mesh import mesh_of

for package in ("collada", "fast_simplification", "meshcat"):
    pytest.importorskip(package)
trimesh = pytest.importorskip("trimesh")

CORNERS = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
SOLID = trimesh.Trimesh(CORNERS, FACES, process=False)
STL = SOLID.export(file_type="stl_ascii")
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
TURNED = '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
COLLISION = '<collision><geometry><box size="1 1 1"/></geometry></collision>'


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


def only_mesh(file: Path) -> Triangles:
    """The only shape of the robot of a file."""
    robot = load_robot(file) if file.suffix == ".xml" else load_robot(file, floating=True)
    (shape,) = drawn_meshes(robot)["base"]
    assert isinstance(shape, Triangles)
    return shape


def assert_corners(shape: Triangles, expected: np.ndarray) -> None:
    """Compare corners in the frame of the body, in any order."""
    found = shape.vertices @ np.array(shape.placement.rotation).T + shape.placement.position
    found, expected = (points[np.lexsort(points.round(6).T)] for points in (found, expected))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def volume(shape: Triangles) -> float:
    """Volume of a closed mesh [m^3], positive if its triangles face outwards."""
    a, b, c = shape.vertices[shape.faces].swapaxes(0, 1)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


MOVED = CORNERS @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] + [1, 2, 3]


@pytest.mark.parametrize(
    ("name", "where", "text"),
    [
        ("../meshes/one.STL", "my_robot/meshes/one.STL", STL),
        ("package://my_robot/meshes/one.obj", "my_robot/meshes/one.obj", SOLID.export(file_type="obj")),
        ("package://parts/one.dae", "parts/one.dae", dae(CORNERS, 0.01)),
    ],
)
def test_meshes_of_a_urdf_have_the_pose_of_their_visual(name: str, where: str, text: str, tmp_path: Path) -> None:
    file = urdf(tmp_path, f'<mesh filename="{name}"/>')
    (tmp_path / where).parent.mkdir(exist_ok=True)
    (tmp_path / where).write_text(text)
    shape = only_mesh(file)
    assert len(shape.faces) == 4
    assert_corners(shape, MOVED)
    color = (0.0, 0.2, 1.0, 1.0) if name.endswith(".dae") else Shape.color
    np.testing.assert_allclose(shape.color, color, atol=1 / 255)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("scale", [(2, 1, 3), (1, -1, 1)])
def test_meshes_of_an_mjcf_have_the_pose_of_their_geom(scale: tuple[int, int, int], tmp_path: Path) -> None:
    """A corner `v` of the file is at `p + s (v - r)`: scale `s`, reference `r` of the mesh, place `p` of the geom."""
    pytest.importorskip("mujoco")
    (tmp_path / "parts").mkdir()
    SOLID.export(tmp_path / "parts" / "one.obj")
    file = tmp_path / "one.xml"
    file.write_text(
        '<mujoco><compiler meshdir="parts"/><asset><material name="red" rgba="1 0 0 1"/>'
        f'<mesh name="one" file="one.obj" scale="{scale[0]} {scale[1]} {scale[2]}" refpos="0.1 0 0"/></asset>'
        '<worldbody><body name="base"><freejoint/><geom type="box" size="1 1 1" group="3"/>'
        '<geom type="mesh" mesh="one" pos="1 2 3" group="2" material="red"/></body></worldbody></mujoco>'
    )
    shape = only_mesh(file)  # without the box, which is a collision geom
    assert shape.color == (1.0, 0.0, 0.0, 1.0)
    assert_corners(shape, (CORNERS - [0.1, 0, 0]) * scale + [1, 2, 3])
    assert volume(shape) == pytest.approx(0.001 * abs(np.prod(scale)), rel=1e-5)


def test_texture_coordinates_without_a_picture_give_no_colour(tmp_path: Path) -> None:
    """Some tools write them into every OBJ file."""
    file = urdf(tmp_path, '<mesh filename="one.obj"/>')
    lines = SOLID.export(file_type="obj").replace("f ", "vt 0 0\nf ", 1).splitlines()
    faces = [" ".join(["f", *(f"{i}/1" for i in line.split()[1:])]) if line[:2] == "f " else line for line in lines]
    (file.parent / "one.obj").write_text("\n".join(faces) + "\n")
    assert only_mesh(file).color == Shape.color


@pytest.fixture(scope="module")
def round_robot(tmp_path_factory: pytest.TempPathFactory):
    file = urdf(tmp_path_factory.mktemp("round"), '<mesh filename="ball.obj" scale="0.5 0.5 0.5"/>')
    trimesh.creation.icosphere(subdivisions=5).export(file.parent / "ball.obj")
    return load_robot(file, floating=True)


def test_meshes_are_simplified_and_keep_their_form(round_robot) -> None:
    (full,) = drawn_meshes(round_robot)["base"]
    (shape,) = drawn_meshes(round_robot, most=600)["base"]
    assert isinstance(shape, Triangles)
    assert 300 < len(shape.faces) <= 600 < len(full.faces) <= MOST
    np.testing.assert_allclose(np.linalg.norm(shape.vertices, axis=1), 0.5, atol=0.02)
    assert volume(shape) == pytest.approx(4 / 3 * np.pi / 8, rel=0.03)


def test_pages_and_pictures_draw_them(round_robot) -> None:
    commands = list(robot_commands(round_robot, "/robot", triangles=600))
    (mesh,) = [command for command in commands if command["type"] == "set_object"]
    assert mesh["object"]["geometries"][0]["type"] == "BufferGeometry"
    solid = mesh_of(commands, dict.fromkeys(body_paths(round_robot, "/robot").values(), 0))
    np.testing.assert_allclose(np.linalg.norm(solid.vertices - [1, 2, 3], axis=1), 0.5, atol=0.02)
    outward = np.einsum("ij,ij->i", solid.normals, (solid.vertices - [1, 2, 3]) / 0.5)
    assert np.median(np.abs(outward)) > 0.98
    box = extent(round_robot, np.zeros((1, 3)), np.eye(3)[None])
    np.testing.assert_allclose(box, [[0, 0, 0], [1.5, 2.5, 3.5]], atol=0.01)  # with the origin of the body
    model = Model(round_robot)
    q, v = np.tile(model.standing_q, (5, 1)), np.zeros((5, model.nv))
    rollout = Rollout(round_robot.source, "exact", 0.02, 0.02 * np.arange(5), q, v)
    assert len(page([rollout], models=[model])) < 5e6


@pytest.mark.parametrize("kind", ["stl", "obj", "ply", "glb", "gltf", "GLB", "PLY"])
@pytest.mark.parametrize("scale", ["1 1 1", "1 -1 1", "-1 -1 1", "-2 -1 -1", "0.5", "-1"])
def test_triangles_face_outwards_at_any_scale(kind: str, scale: str, tmp_path: Path) -> None:
    """A box of 0.001 m^3 at (0.3, 0.2, 0.1); glTF files have it behind a reflection."""
    is_gltf, mirror = "gl" in kind.lower(), np.diag([1.0, -1.0, 1.0, 1.0])
    solid, scene = trimesh.creation.box((0.2, 0.1, 0.05)), trimesh.Scene()
    solid.apply_translation((0.3, -0.2 if is_gltf else 0.2, 0.1))
    scene.add_geometry(solid, transform=mirror if is_gltf else None)
    file = urdf(tmp_path, f'<mesh filename="one.{kind}" scale="{scale}"/>')
    if kind == "gltf":
        for name, data in scene.export(file_type="gltf").items():
            (file.parent / name.replace("model", "one")).write_bytes(data)
    else:
        (scene if is_gltf else solid).export(file.parent / f"one.{kind}", file_type=kind.lower())
    shape, factors = only_mesh(file), np.array([float(x) for x in scale.split()]) * np.ones(3)
    assert volume(shape) == pytest.approx(0.001 * abs(np.prod(factors)), rel=1e-5)
    np.testing.assert_allclose(shape.vertices.mean(0), np.array([0.3, 0.2, 0.1]) * factors, atol=1e-6)


MISSING = r"one.urdf: 1 meshes are missing or of another kind, such as .*; expected .stl, .obj, .dae, .ply, .glb, .gltf"
BAD_STL = bytes(80) + b"\x09\0\0\0" + bytes(60)
BAD_PLY = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n"
LARGE_GLTF = b'{"asset": {"version": "2.0"}, "accessors": [{"count": 1000000000000}]}'
OUTSIDE_GLTF = b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "../../secret"}]}'


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bad.stl", b"", "bad.stl: mesh is not drawn"),
        ("bad.stl", b"solid nothing\nendsolid\n", "bad.stl: mesh is not drawn"),
        ("bad.stl", STL.replace("vertex 0", "vertex nan", 1).encode(), "bad.stl: mesh is not drawn"),
        ("bad.stl", BAD_STL, "bad.stl: mesh is not drawn"),
        ("bad.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 2\n", "bad.obj: mesh is not drawn"),
        ("bad.ply", BAD_PLY, "bad.ply: mesh is not"),
        ("bad.dae", b"<!DOCTYPE x>" + dae(CORNERS, 1.0).encode(), "there is a <!DOCTYPE>; expected none"),
        ("bad.glb", b"glTF\2\0\0\0", "bad.glb: mesh is not drawn"),
        ("bad.gltf", LARGE_GLTF, "more numbers than"),
        ("bad.gltf", OUTSIDE_GLTF, "not in the folder"),
        ("bad.step", b"ISO-10303-21;", MISSING),
        ("one.urdf", None, MISSING),
        ("missing.stl", None, MISSING),
        ("package://other/one.stl", None, MISSING),
        ("http://host/one.stl", None, MISSING),
        ('good.stl" scale="1 2', None, "scale"),
    ],
)
def test_a_bad_mesh_hides_only_itself(
    name: str, content: bytes | None, message: str, alone: bool, tmp_path: Path
) -> None:
    """Alone, it is replaced by the collision box."""
    bad = f'<mesh filename="{name}"/>'
    good = f'<visual>{TURNED}<geometry><mesh filename="good.stl"/></geometry></visual>'
    file = urdf(tmp_path, bad, "" if alone else good)
    (tmp_path / "secret").write_bytes(b"x")
    (file.parent / "good.stl").write_text(STL)
    if content is not None:
        (file.parent / name).write_bytes(content)
    robot = load_robot(file, floating=True)
    with pytest.warns(UserWarning, match=message) as caught:
        meshes = drawn_meshes(robot)
    (warning,) = [str(item.message) for item in caught if item.category is UserWarning]
    assert "\n" not in warning
    if alone:
        (shape,) = [command for command in robot_commands(robot, "/robot") if command["type"] == "set_object"]
        assert shape["object"]["geometries"][0]["type"] == "BoxGeometry"
    else:
        (mesh,) = meshes["base"]
        assert isinstance(mesh, Triangles)
        assert_corners(mesh, MOVED)


@pytest.mark.parametrize(
    "name",
    [
        "a part.stl", "a%20part.stl", "100%.stl", "{folder}/a part.stl", "file://{folder}/a part.stl",
        "file://{folder}/a%20part.stl", "file://localhost{folder}/a%20part.stl", "file:{folder}/a%20part.stl",
        "package://my_robot/urdf/a%20part.stl", "model://my_robot/urdf/a part.stl",
    ],
)  # fmt: skip
def test_paths_with_spaces_and_addresses(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "my_robot" / "urdf"
    file = urdf(tmp_path, f'<mesh filename="{name.format(folder=folder)}"/>')
    for spelled in ("a part.stl", "100%.stl"):
        (folder / spelled).write_text(STL)
    assert only_mesh(file)
