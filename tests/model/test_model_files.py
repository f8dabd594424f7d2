"""What the loaders make of URDF and YAML: welded links, turned inertias, axes, bases, mimics, frames."""

import math

import numpy as np
import pytest

from ce_gym.model import LinearConstraint, RobotError, Shape, load_robot
from ce_gym.model.formats.placement import rotation_from_rpy
from ce_gym.model.formats.urdf.tree import read_urdf

BLOCK = '<inertial><mass value="{mass}"/><inertia ixx="{x}" ixy="0" ixz="0" iyy="{y}" iyz="0" izz="{z}"/>{o}</inertial>'


def block(mass=1.0, x=1.0, y=1.0, z=1.0, origin="") -> str:
    return BLOCK.format(mass=mass, x=x, y=y, z=z, o=f"<origin {origin}/>" if origin else "")


def link(name: str, content: str = "") -> str:
    return f'<link name="{name}">{content}</link>'


def joint(kind: str, parent: str, child: str, content: str = "") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{child}_joint" type="{kind}">{ends}{content}</joint>'


@pytest.fixture
def load_urdf(tmp_path):
    def load(*elements: str):
        path = tmp_path / "r.urdf"
        path.write_text(f'<robot name="r">{"".join(elements)}</robot>')
        return load_robot(path)

    return load


def test_yaml_says_what_urdf_cannot(write_robot):
    robot = load_robot(write_robot())
    assert [body.name for body in robot.bodies] == ["trunk", "thigh", "hip_rotor", "shank", "knee_rotor"]
    assert robot.name == "leg"
    assert robot.independent == ("thigh", "shank")
    assert robot.constraints[1] == LinearConstraint("knee_rotor", (("knee_rotor", 1.0), ("shank", -8.0)))
    assert (robot.motors[0].torque, robot.motors[0].velocity) == (3.0, math.inf)
    assert robot.gains.kp == (("thigh", 20.0), ("shank", 20.0))
    assert robot.gains.kd == (("thigh", 1.0), ("shank", 2.0))
    assert robot.body("thigh").joint.position == (-1.0, 2.0)
    assert robot.body("shank").joint.position == (-math.inf, math.inf)
    assert robot.floating


SPRUNG = (
    (
        '<origin xyz="0 0 -0.2"/><axis',
        '<origin xyz="0 0 -0.2"/><limit lower="-1" upper="1" effort="0" velocity="0"/><axis',
    ),
    ("gains:", "joint_stiffness: {shank: 30}\ngains:"),
)


def test_gains_are_of_joints_that_are_driven(write_robot):
    """One number is for all but a spring, which a pattern does not fit; a spring that has one is refused."""
    robot = load_robot(write_robot(*SPRUNG, ("kd: {thigh: 1, shank: 2}", 'kd: {"*": 1}')))
    assert (robot.passive, robot.gains.kp, robot.gains.kd) == (("shank",), (("thigh", 20.0),), (("thigh", 1.0),))
    with pytest.raises(RobotError, match=r"gains\.kd\.shank is 2\.0: expected no gain for a passive joint") as caught:
        load_robot(write_robot(*SPRUNG))
    assert "\n" not in str(caught.value)


def test_dry_friction_of_joints_is_the_urdf_s_where_the_yaml_is_silent(write_robot, load_urdf):
    plain = load_urdf(
        link("a", block()), link("b", block()), joint("continuous", "a", "b", '<dynamics friction="0.3"/>')
    )
    assert plain.body("b").joint.friction == 0.3
    frictions = [
        [
            load_robot(write_robot(("gains:", f"joint_friction: {given}\ngains:"))).body(name).joint.friction
            for name in ("thigh", "shank", "hip_rotor")
        ]
        for given in ("0.2", "{shank: 0.4}", "{'*': 0.1, thigh: 0.5}")
    ]
    assert frictions == [[0.2, 0.2, 0.0], [0.0, 0.4, 0.0], [0.5, 0.1, 0.0]]


def test_springs_of_joints(write_robot):
    springs = "joint_stiffness: {shank: 300}\njoint_springref: {shank: 1.2}\ngains:"
    robot = load_robot(write_robot(("gains:", springs)))
    assert [(robot.body(n).joint.stiffness, robot.body(n).joint.springref) for n in ("thigh", "shank")] == [
        (0.0, 0.0),
        (300.0, 1.2),
    ]
    for given, words in (
        ("{shank: -1}", "stiffness is -1.0: expected 0 or more"),
        ("{toe: 1}", "'toe': expected a link"),
    ):
        with pytest.raises(RobotError, match=words):
            load_robot(write_robot(("gains:", f"joint_stiffness: {given}\ngains:")))


def test_contact_on_a_welded_link_moves_to_the_body_that_carries_it(write_robot):
    toe = load_robot(write_robot()).contacts[0]
    assert (toe.body, toe.position) == ("shank", (0.0, 0.0, -0.3))


def test_rotor_on_a_welded_link_is_placed_on_the_body_that_carries_it(write_robot):
    robot = load_robot(write_robot(("parent: thigh", "parent: foot"), ("ratios: {shank: 8}", "ratios: {thigh: 8}")))
    rotor = robot.body("knee_rotor")
    assert (rotor.parent, rotor.placement.position) == ("shank", (0.0, 0.0, -0.3))
    assert [body.name for body in robot.bodies] == ["trunk", "thigh", "hip_rotor", "shank", "knee_rotor"]


def test_further_ties_and_chosen_independent_joints(write_robot):
    tie = "constraints:\n- {name: t, type: linear, coefficients: {shank: 2, thigh: -1}, offset: 0.5}\n"
    path = write_robot(("base: floating\n", f"base: floating\n{tie}"), (", shank: 2}}", "}}"))
    robot = load_robot(path)
    assert robot.constraints[-1] == LinearConstraint("t", (("shank", 2.0), ("thigh", -1.0)), 0.5)
    assert robot.independent == ("thigh",), "a tie solves for the body it names first"
    path = write_robot(
        ("base: floating\n", f"base: floating\n{tie}independent: [shank]\n"),
        ("kd: {thigh: 1, shank: 2}", "kd: 1"),
        ("{height: 0.52, joints: {thigh: 0.1}}", "{height: 0.52}"),
    )
    assert load_robot(path).independent == ("shank",)


def test_limits_in_a_yaml_file_go_before_those_of_the_urdf(write_robot):
    limits = "limits: {torque: 7, velocity: {knee: 5}, position: {hip: [-0.5, 0.5]}}\n"
    robot = load_robot(write_robot(("base: floating\n", f"base: floating\n{limits}")))
    hip, knee = robot.body("thigh").joint, robot.body("shank").joint
    assert (hip.torque, hip.velocity, hip.position) == (7.0, 20.0, (-0.5, 0.5))
    assert (knee.torque, knee.velocity, knee.position) == (7.0, 5.0, (-np.inf, np.inf))
    for wrong, message in (
        ("position: {hip: [1, 0]}", r"limits\.position\.hip is \[1\.0, 0\.0\]: expected the lower limit first"),
        ("torque: {toe: 1}", "limits is 'toe'"),
        ("speed: 1", "limits is 'speed'"),
    ):
        with pytest.raises(RobotError, match=message):
            load_robot(write_robot(("base: floating\n", f"base: floating\nlimits: {{{wrong}}}\n")))


def test_welded_links_merge_by_the_parallel_axis_theorem(load_urdf):
    """Two point-like masses at distance d: reduced mass m1 m2 / (m1 + m2) times d^2 about their common centre."""
    robot = load_urdf(
        link("a", block(mass=2.0, x=0.1, y=0.2, z=0.25)),
        link("b", block(mass=1.0, x=0.1, y=0.2, z=0.25)),
        joint("fixed", "a", "b", f'<origin xyz="0 0 0.3" rpy="0 0 {math.pi / 2}"/>'),
    )
    (body,) = robot.bodies
    assert body.joint.type == "free"
    assert body.inertial.mass == 3.0
    np.testing.assert_allclose(body.inertial.com, (0.0, 0.0, 0.1), atol=1e-16)
    lever = 2.0 * 1.0 / 3.0 * 0.3**2
    np.testing.assert_allclose(body.inertial.inertia, np.diag([0.3 + lever, 0.3 + lever, 0.5]), atol=1e-15)


def test_joints_beyond_a_welded_link_hang_on_the_body(load_urdf):
    half_turn = f'<origin xyz="0 1 0" rpy="0 0 {math.pi}"/>'
    robot = load_urdf(
        link("a", block()),
        link("w"),
        link("c", block()),
        joint("fixed", "a", "w", half_turn),
        joint("continuous", "w", "c", '<origin xyz="0.5 0 0"/><axis xyz="0 0 -2"/><limit lower="-1" upper="1"/>'),
    )
    child = robot.body("c")
    assert child.parent == "a"
    assert child.placement.position == (-0.5, 1.0, 0.0)
    assert child.placement.rotation == ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
    assert child.joint.axis == (0.0, 0.0, -1.0), "normalised, its sign kept"
    assert child.joint.position == (-math.inf, math.inf), "continuous has no limits"


def test_inertial_origin_turns_the_inertia(load_urdf):
    robot = load_urdf(link("a", block(x=1.0, y=2.0, z=2.5, origin=f'xyz="1 2 3" rpy="0 0 {math.pi / 2}"')))
    assert robot.bodies[0].inertial.com == (1.0, 2.0, 3.0)
    assert robot.bodies[0].inertial.inertia == ((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 2.5))


@pytest.mark.parametrize(
    ("root", "root_inertial", "kind", "bodies"),
    [
        ("base", block(), "revolute", [("base", "free"), ("tip", "revolute")]),
        ("base", "", "revolute", [("tip", "revolute")]),
        ("world", block(), "revolute", [("tip", "revolute")]),
        ("world", "", "floating", [("tip", "free")]),
        ("base_link", "", "fixed", [("base_link", "free")]),
        ("base", block(), "prismatic", [("base", "free"), ("tip", "prismatic")]),
    ],
)
def test_what_the_root_of_a_plain_urdf_means(load_urdf, root, root_inertial, kind, bodies):
    robot = load_urdf(link(root, root_inertial), link("tip", block()), joint(kind, root, "tip"))
    assert [(body.name, body.joint.type) for body in robot.bodies] == bodies


def test_yaml_may_fix_a_root_that_has_mass(write_robot):
    robot = load_robot(write_robot(("base: floating", "base: fixed")))
    assert not robot.floating
    assert robot.body("thigh").parent is None
    assert robot.total_mass == pytest.approx(2.0 + 1.0 + 0.2)


def test_mimic_becomes_a_constraint(load_urdf):
    robot = load_urdf(
        link("a", block()),
        *(link(name, block()) for name in "bc"),
        joint("revolute", "a", "b"),
        joint("revolute", "b", "c", '<mimic joint="b_joint" multiplier="-2" offset="0.1"/>'),
    )
    assert robot.constraints == (LinearConstraint("c_joint mimic", (("c", 1.0), ("b", 2.0)), 0.1),)
    assert robot.independent == ("b",)


def test_shapes_keep_their_colours_and_meshes_are_the_viewers(load_urdf):
    visuals = [
        '<visual><geometry><box size="1 2 3"/></geometry><material name="red"/></visual>',
        '<visual><origin xyz="0 0 1"/><geometry><cylinder radius="1" length="2"/></geometry></visual>',
        '<visual><geometry><mesh filename="x.obj"/></geometry></visual>',
        '<visual><geometry><sphere radius="1"/></geometry><material><color rgba="0 1 0 0.5"/></material></visual>',
    ]
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    robot = load_urdf(red, link("a", block() + "".join(visuals)))
    box, cylinder, sphere = robot.bodies[0].shapes
    assert box == Shape("box", (1.0, 2.0, 3.0), color=(1.0, 0.0, 0.0, 1.0))
    assert (cylinder.size, cylinder.placement.position) == ((1.0, 2.0), (0.0, 0.0, 1.0))
    assert (sphere.type, sphere.color) == ("sphere", (0.0, 1.0, 0.0, 0.5))
    assert robot.notes == ()


def test_links_may_be_listed_in_any_order(write_robot, tmp_path):
    write_robot()
    lines = (tmp_path / "leg.urdf").read_text().split("  <link")
    head, trunk, thigh, shank, foot_and_joints = lines
    foot, joints = foot_and_joints.split("\n", 1)
    (tmp_path / "leg.urdf").write_text("  <link".join([head, shank, trunk, f"{foot}\n", thigh + joints]))
    assert [body.name for body in read_urdf(tmp_path / "leg.urdf").bodies] == ["trunk", "thigh", "shank"]


@pytest.mark.parametrize("rpy", [(0.3, -0.4, 2.0), (math.pi, 0, 0), (0, math.pi / 2, 0), (math.pi, 0, -math.pi / 2)])
def test_rotations_are_proper_and_right_angles_exact(rpy):
    rotation = np.array(rotation_from_rpy(*rpy))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    if all(angle * 2 / math.pi == round(angle * 2 / math.pi) for angle in rpy):
        assert set(rotation.ravel()) <= {-1.0, 0.0, 1.0}
        assert not np.signbit(rotation[rotation == 0.0]).any()


def test_a_shape_without_extent_is_a_point_of_a_virtual_link(load_urdf):
    """Upkie's base is drawn as a box of size 0; a box that is flat is still a mistake."""
    visual = '<visual><geometry><box size="{}"/></geometry></visual>'
    assert load_urdf(link("b", block() + visual.format("0 0 0"))).bodies[0].shapes == ()
    with pytest.raises(RobotError, match="lengths above 0"):
        load_urdf(link("b", block() + visual.format("0 1 1")))
