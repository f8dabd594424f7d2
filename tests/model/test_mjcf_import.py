"""MJCF import: the mass matrix, accelerations and constraints of an imported file are MuJoCo's own."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from mjcf_files import ANKLE, BARS, CHAIN, CONNECT, RODS, SEVEN, lump, mjcf, parallel

from ce_gym.dynamics import Model
from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import LinearConstraint, LoopConstraint, LossyImportWarning, RobotError, RodConstraint, load_robot

mujoco = pytest.importorskip("mujoco")
from mujoco_peer import TOLERANCE, Peer, compare  # noqa: E402

from ce_gym.model.formats.mjcf.robot import robot_from_mjcf  # noqa: E402

pytestmark = [
    pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning"),
    pytest.mark.filterwarnings("error::ce_gym.LossyImportWarning"),
    pytest.mark.filterwarnings("ignore:[^;]*left out. the gear ratio behind[^;]*$:ce_gym.LossyImportWarning"),
]


@pytest.mark.parametrize("level", ["armature", "coupled"])
@pytest.mark.parametrize("base", ["", "<freejoint/>"])
def test_trees_with_armature(write, base, level):
    chain = CHAIN.replace('"w2"', '"w2" armature="0.1"').replace('name="s"', 'name="s" armature="2"')
    chain = chain.replace('name="f"', 'name="f" armature="0.3"')
    tilt = "" if base else 'euler="0.1 0.2 0.3"'
    trunk = f'<body name="trunk" pos="0 0 1" {tilt}>{base}{lump(5)}{chain}</body>'
    path = write(mjcf(trunk, actuator='<motor joint="f" gear="30"/>'))
    robot = load_robot(path)
    assert robot.floating == bool(base)
    compare(path, robot, level)


def test_what_is_read_of_a_tree(write):
    robot = load_robot(write(mjcf(CHAIN)))
    assert [body.name for body in robot.bodies] == ["arm", "slider", "w1", "wrist", "finger"]
    assert robot.independent == ("arm", "slider", "w1", "wrist", "finger")
    assert robot.body("w1").inertial.mass == 0.0, "a massless link between two joints of one body"
    assert robot.body("wrist").inertial.mass == pytest.approx(0.8), "the plate is welded to it"
    assert dict(robot.pose.joints)["arm"] == 0.4, "ref is the coordinate at which the file was drawn"


def test_dry_friction_of_joints_comes_in_and_goes_out(write):
    chain = CHAIN.replace('name="a"', 'name="a" frictionloss="0.7"').replace('name="s"', 'name="s" frictionloss="3"')
    robot = load_robot(write(mjcf(chain)))
    again = load_robot(write(to_mjcf(robot, "none")))
    for each in (robot, again):
        assert [each.body(name).joint.friction for name in ("arm", "slider", "finger")] == [0.7, 3.0, 0.0]


@pytest.mark.parametrize(
    ("equality", "tendon", "dependent"),
    [
        ('<joint joint1="f" joint2="a" polycoef="0.2 -3 0 0 0"/>', "", {"finger"}),
        ('<joint joint1="f" polycoef="0.3 0 0 0 0"/>', "", set()),
        (
            '<joint joint1="f" polycoef="0.3 0 0 0 0"/><tendon tendon1="t" polycoef="0.1 0 0 0 0"/>',
            '<fixed name="t"><joint joint="f" coef="2"/><joint joint="a" coef="1"/><joint joint="s" coef="3"/></fixed>',
            None,
        ),
        (
            '<tendon tendon1="t" tendon2="u" polycoef="0.1 2 0 0 0"/>',
            '<fixed name="t"><joint joint="f" coef="2"/><joint joint="a" coef="1"/></fixed>'
            '<fixed name="u"><joint joint="a" coef="1"/><joint joint="w1" coef="-3"/></fixed>',
            None,
        ),
    ],
)
def test_linear_equalities(write, equality, tendon, dependent):
    path = write(mjcf(CHAIN, equality, tendon))
    robot = load_robot(path)
    moving = {body.name for body in robot.bodies}
    if dependent is not None:
        assert moving - set(robot.independent) == dependent
    assert all(isinstance(tie, LinearConstraint) for tie in robot.constraints)
    if "joint2" in equality or "tendon2" in equality:
        assert len(robot.independent) == 4
        compare(path, robot)
    else:
        assert "finger" not in moving, "a joint held still is a weld"
        held = Held(path, robot, Model(robot, "coupled"))
        held.check()


class Held(Peer):
    """A file in which joint f is held still: MuJoCo still has its coordinate."""

    def joints(self):
        return [name for name in super().joints() if name != "finger"]

    def check(self):
        q, v = np.full(self.model.nq, 0.2), np.full(self.model.nv, 0.5)
        q_span, v_span = self.model.spanning(q, v)
        columns = [self.model.spanning_names.index(name) for name in self.joints()]
        self.set(np.append(q_span[columns], 0.3), np.append(v_span[columns], 0.0))
        assert self.gap() < 1e-12
        tau = np.linspace(-1, 1, self.model.nv)
        ours, theirs = self.model.forward_dynamics(q, v, tau), self.acceleration(q, v, tau)
        assert np.abs(ours - theirs).max() <= TOLERANCE * np.abs(theirs).max()


@pytest.mark.parametrize(("actuated", "dependent"), [("a", "finger"), ("f", "arm")])
@pytest.mark.parametrize("polynomial", ["0.1 1 0 0 0", "0.1 1 0.3 -0.2 0.1"])
def test_the_joint_with_the_actuator_is_independent(write, actuated, dependent, polynomial):
    equality = f'<joint joint1="f" joint2="a" polycoef="{polynomial}"/>'
    path = write(mjcf(CHAIN, equality, actuator=f'<motor joint="{actuated}"/>'))
    robot = load_robot(path)
    assert {body.name for body in robot.bodies} - set(robot.independent) == {dependent}
    compare(path, robot, spread=0.1)


def test_a_tendon_without_play_couples_its_joints(write):
    """As the equality that holds it at the middle of its range, 0.3."""
    tendon = '<fixed name="t" {}><joint joint="a" coef="2"/><joint joint="f" coef="1"/></fixed>'
    with pytest.warns(LossyImportWarning, match="play of tendon t"):
        robot = load_robot(write(mjcf(CHAIN, "", tendon.format('range="0.299 0.301"'))))
    assert [type(tie) for tie in robot.constraints] == [LinearConstraint]
    at_pose = 2 * 0.4  # `ref` of joint a, which an equality counts from
    twin = write(mjcf(CHAIN, f'<tendon tendon1="t" polycoef="{0.3 - at_pose} 0 0 0 0"/>', tendon.format("")))
    compare(twin, robot)


def test_names_made_for_equalities_are_of_no_other(write):
    equality = '<joint name="finger_to_arm" joint1="w1" joint2="s"/><joint joint1="f" joint2="a"/>'
    first, second = (tie.name for tie in load_robot(write(mjcf(CHAIN, equality))).constraints)
    assert first == "finger_to_arm"
    assert second.startswith("finger_to_arm")
    assert second != first


def test_gears_written_as_rotor_bodies_are_rotors(write):
    disc = '<inertial mass="0.2" pos="0 0 0" diaginertia="1e-3 1e-3 2e-3"/>'
    world = (
        f'<body name="disc" pos="0 0.1 0"><joint name="d"/>{disc}</body>'
        f'<body name="arm"><joint name="a"/>{lump()}</body>'
    )
    path = write(mjcf(world, '<joint joint1="a" joint2="d" polycoef="0 0.1 0 0 0"/>', actuator='<motor joint="a"/>'))
    robot = load_robot(path)
    assert [body.name for body in robot.rotors()] == ["disc"]
    assert robot.independent == ("arm",)
    compare(path, robot, "exact")


@pytest.mark.parametrize(
    "equality",
    [
        CONNECT,
        '<connect name="pin" site1="tip" site2="top"/>',
        '<weld name="w" body1="rod" body2="handle"/>',
        '<weld name="pin" body1="rod" body2="rocker" anchor="0 0 0.4" torquescale="0"/>',
    ],
)
def test_closed_loops(write, equality):
    handle = f'<body name="handle" pos="0 0 0.4"><joint name="handle" axis="0 1 0"/>{lump(0.1)}</body>'
    world = BARS.replace('<site name="top"', handle + '<site name="top"') if "handle" in equality else BARS
    path = write(mjcf(world, equality, actuator='<motor joint="crank"/>'))
    robot = load_robot(path)
    assert robot.independent == ("crank",)
    assert all(isinstance(tie, LoopConstraint) for tie in robot.constraints)
    compare(path, robot, "exact")


@pytest.mark.parametrize(("tie", "error"), [("connect", 1e-9), ("weld", 1e-7), ("connect", 3e-6)])
def test_parallel_rods_repeat_each_other_within_the_digits_of_a_file(write, tie, error):
    path = write(parallel(tie, error))
    robot = load_robot(path)
    assert robot.independent == ("crank",)
    assert any("of rod_2 and " in note and "adds only" in note for note in robot.notes)
    compare(path, robot, spread=0.2, rounding=10 * error)


def test_rods_that_contradict_each_other_leave_no_freedom(write):
    with pytest.warns(LossyImportWarning, match="actuator"):
        robot = load_robot(write(parallel("connect", 1e-3)))
    with pytest.raises(RobotError, match=r"the loop of .*, rod_1, rod_2, .*no freedom.* agree to 1e-5"):
        Model(robot)


def test_a_welded_tip_leaves_one_freedom_of_seven(write):
    path = write(mjcf(SEVEN, '<weld body1="b6"/>'))
    robot = load_robot(path)
    assert len(robot.independent) == 1
    compare(path, robot, "exact", spread=0.05)


def test_tendons_of_fixed_length_are_rods(write):
    equalities = '<tendon tendon1="l_rod"/><tendon tendon1="r_rod"/>'
    path = write(mjcf(ANKLE, equalities, RODS, '<motor joint="pitch"/><motor joint="roll"/>'))
    robot = load_robot(path)
    assert robot.independent == ("cross", "foot"), "driven joints are independent"
    assert [type(tie) for tie in robot.constraints] == [RodConstraint] * 2
    compare(path, robot, "exact", spread=0.1)


def test_exact_knows_more_than_mujoco_only_where_the_ratio_is_known(write):
    joint = '<joint name="f" axis="0.6 0 0.8" armature="0.05"/>'
    world = CHAIN.replace('<joint name="f" axis="0.6 0 0.8"/>', joint)
    path = write(mjcf(world))
    unknown, known = robot_from_mjcf(path), robot_from_mjcf(path, gear_ratios={"fing*": -20.0})
    q = np.full(5, 0.3)
    reference = Model(unknown, "armature").mass_matrix(q)
    assert np.abs(Model(known, "armature").mass_matrix(q) - reference).max() < 1e-12
    assert np.abs(Model(unknown, "exact").mass_matrix(q) - reference).max() < 1e-6
    assert np.abs(Model(known, "exact").mass_matrix(q) - reference).max() > 1e-3
    assert known.total_mass == pytest.approx(unknown.total_mass)
    geared = load_robot(write(mjcf(world, actuator='<motor joint="f" gear="-20"/>')))
    assert geared.constraints == known.constraints
    with pytest.raises(RobotError, match="gears is 'g'"):
        robot_from_mjcf(path, gear_ratios={"g": 20.0})
    with pytest.raises(RobotError, match=r"gears\.finger is 0\.0"):
        robot_from_mjcf(path, gear_ratios={"finger": 0.0})


def test_a_rotor_that_does_not_fit_its_carrier_is_said_and_left_at_the_limit(write):
    world = CHAIN.replace('name="f"', 'name="f" armature="5"')
    path = write(mjcf(world, actuator='<motor joint="f" gear="2"/>'))
    with pytest.warns(LossyImportWarning, match="gear ratio at finger"):
        robot = load_robot(path)
    compare(path, robot, "armature")


def test_armature_of_tendons_and_motors(write):
    tendon = '<fixed name="t" armature="0.4"><joint joint="f" coef="2"/><joint joint="w1" coef="-1"/></fixed>'
    try:
        path = write(mjcf(CHAIN, "", tendon, '<motor joint="a" gear="5" armature="0.002"/>'))
        mujoco.MjModel.from_xml_path(str(path))
    except ValueError:
        pytest.skip("this MuJoCo has no such attribute")
    compare(path, load_robot(path), "coupled")


@pytest.mark.parametrize("name", ["mini_cheetah", "mit_humanoid_leg"])
@pytest.mark.parametrize("level", ["armature", "coupled", "exact"])
def test_round_trip(write, name, level):
    """Exported and imported again: the same mass matrix, of MuJoCo's compiled file and of the import."""
    original = load_robot(name)
    path = write(to_mjcf(original, level, ground=original.floating))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LossyImportWarning)
        robot = load_robot(path)
    compare(path, robot, level)
    groups = {sphere.group for sphere in original.contacts}
    assert {sphere.group for sphere in robot.contacts} == {"limb" if name == "knee" else name for name in groups}
    radii, centres = ({c.name: getattr(c, key) for c in original.contacts} for key in ("radius", "position"))
    assert {c.name: c.radius for c in robot.contacts} == pytest.approx(radii, abs=1e-3), "MuJoCo has no points"
    assert {c.name: c.position for c in robot.contacts} == {n: pytest.approx(x, abs=1e-12) for n, x in centres.items()}
    assert dict(robot.gains.kp) == dict(original.gains.kp)
    assert dict(robot.pose.joints) == pytest.approx(
        dict.fromkeys(original.independent, 0.0) | dict(original.pose.joints)
    )
    if name == "mit_humanoid_leg":  # MuJoCo refuses Mini Cheetah's published inertia
        q = np.array([dict(original.pose.joints).get(j, 0.0) for j in robot.independent])
        ours = Model(robot, level).mass_matrix(q)
        order = [robot.independent.index(j) for j in original.independent]
        theirs = Model(original, level).mass_matrix(q[order])
        assert np.abs(ours[np.ix_(order, order)] - theirs).max() <= TOLERANCE * np.abs(theirs).max()


def test_joints_that_follow_from_others_keep_their_stops(tmp_path):
    text = """<mujoco><worldbody><body name="a"><joint name="a" axis="0 1 0" range="-60 60"/><geom size="0.1" mass="1"/>
      <body name="b" pos="0 0 -0.3"><joint name="b" axis="0 1 0" range="-80 80"/><geom size="0.1" mass="1"/></body>
      </body></worldbody><equality><joint joint1="b" joint2="a" polycoef="0 -1 0 0 0"/></equality></mujoco>"""
    (tmp_path / "tied.xml").write_text(text)
    robot = load_robot(tmp_path / "tied.xml")
    assert robot.independent == ("a",)
    assert robot.body("b").joint.position == pytest.approx(np.radians((-80.0, 80.0)))


def test_a_sprung_joint_that_a_tendon_moves_is_not_passive(tmp_path):
    """The actuator on the tendon of one joint is that joint's."""
    file = tmp_path / "tendon.xml"
    file.write_text(
        """<mujoco model="tendon"><worldbody>
        <body name="arm"><joint name="hinge" axis="0 1 0" stiffness="3"/><geom size="0.02"/>
        <body name="hand" pos="0 0 -0.2"><joint name="wrist" axis="0 1 0"/><geom size="0.02"/></body></body></worldbody>
        <tendon><fixed name="cable"><joint joint="hinge" coef="1"/></fixed></tendon>
        <actuator><position tendon="cable" kp="20"/><position joint="wrist" kp="5"/></actuator></mujoco>"""
    )
    robot = load_robot(file)
    assert robot.body("arm").joint.torque != 0.0
