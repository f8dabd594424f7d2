"""URDF files as vendors write them: dialects for motors, namespaces, encodings, missing and rounded inertia, notes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ce_gym
from ce_gym.__main__ import main
from ce_gym.envs.custom import zero_limits
from ce_gym.model import LossyImportWarning, RobotError, load_robot
from ce_gym.new_robot.robot_file import write_new_robot

PUP = Path(__file__).parents[1] / "data" / "own_robot" / "pup.urdf"
I = 0.02
"""Of the arm about its axis [kg m^2]."""


def inertial(mass: float, moment: float) -> str:
    inertia = f'<inertia ixx="{moment}" ixy="0" ixz="0" iyy="{moment}" iyz="0" izz="{moment}"/>'
    return f'<inertial><mass value="{mass}"/>{inertia}</inertial>'


def arm(more: str = "", joint: str = "", root: str = "") -> str:
    return (
        f'<robot name="arm"{root}><link name="world"/><link name="upper">{inertial(1.5, I)}</link>'
        f'<link name="lower">{inertial(0.7, 0.01)}</link>'
        '<joint name="shoulder" type="revolute"><parent link="world"/><child link="upper"/><axis xyz="0 0 1"/>'
        f'<limit lower="-1" upper="1" effort="9" velocity="3"/>{joint}</joint>'
        '<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.3 0 0"/>'
        f'<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="9" velocity="3"/></joint>{more}</robot>'
    )


@pytest.fixture
def load(tmp_path: Path):
    def read(text: str, encoding: str = "utf-8", name: str = "arm.urdf") -> ce_gym.Robot:
        file = tmp_path / name
        file.write_bytes(text.encode(encoding))
        return load_robot(file)

    return read


def diagonal(robot: ce_gym.Robot) -> np.ndarray:
    model = ce_gym.Model(robot, transmission="armature")
    return np.diag(model.mass_matrix(model.standing_q))


TRANSMISSIONS = {
    "actuator": "<joint name='{j}'/><actuator name='m'><mechanicalReduction>{n}</mechanicalReduction>"
    "<motorInertia>{i}</motorInertia></actuator>",
    "joint": "<joint name='{j}'><mechanicalReduction>{n}</mechanicalReduction></joint><motorInertia>{i}</motorInertia>",
    "drake": "<joint name='{j}'/><actuator name='m'><drake:gear_ratio value='{n}'/>"
    "<drake:rotor_inertia value='{i}'/></actuator>",
}


@pytest.mark.parametrize("kind", TRANSMISSIONS)
@pytest.mark.parametrize(("joint", "ratio"), [("shoulder", 30.0), ("elbow", -12.5)])
def test_transmissions_with_inertia_become_rotors(load, kind: str, joint: str, ratio: float):
    """At `armature` the joint has ratio^2 J more; the rotor's inertia at rest was in the carrier's already."""
    motor = TRANSMISSIONS[kind].format(j=joint, n=ratio, i=4e-5)
    robot = load(arm(f"<transmission name='t'>{motor}</transmission>"))
    more = diagonal(robot) - diagonal(load(arm()))
    place = ["shoulder", "elbow"].index(joint)
    assert more[place] == pytest.approx(ratio**2 * 4e-5 - (4e-5 if joint == "elbow" and place == 0 else 0), rel=1e-9)
    assert len(list(robot.rotors())) == 1
    assert not robot.notes


def test_every_actuator_of_a_transmission_is_a_motor(load):
    """A ratio of 1 at the joint, which ROS writes by default, says nothing beside those of the actuators."""
    motor = "<actuator><mechanicalReduction>{}</mechanicalReduction><motorInertia>{}</motorInertia></actuator>"
    joint = "<joint name='shoulder'><mechanicalReduction>1</mechanicalReduction></joint>"
    motors = motor.format(10, 2e-5) + motor.format(-20, 3e-5)
    robot = load(arm(f"<transmission name='t'>{joint}{motors}</transmission>"))
    more = diagonal(robot) - diagonal(load(arm()))
    assert more[0] == pytest.approx(10**2 * 2e-5 + 20**2 * 3e-5, rel=1e-9)
    with pytest.raises(RobotError, match=r"<mechanicalReduction> is 0.*: expected a ratio other"):
        load(arm(f"<transmission name='t'><joint name='elbow'/>{motor.format(0, 2e-5)}</transmission>"))


def test_notes_on_many_transmissions_are_one_line(load):
    one = "<transmission name='{}'><joint name='elbow'/><mechanicalReduction>9</mechanicalReduction></transmission>"
    (note,) = load(arm("".join(one.format(i) for i in range(7)))).notes
    assert note.endswith("in transmission '0', '1', '2' and 4 more")


def test_springs_of_gazebo_act_at_their_joint(load):
    spring = "<springStiffness>{}</springStiffness><springReference value='0.25'/>"
    robot = load(arm(f"<gazebo reference='elbow'>{spring.format(4)}<material>Gazebo/Red</material></gazebo>"))
    assert (robot.body("lower").joint.stiffness, robot.body("lower").joint.springref) == (4.0, 0.25)
    assert not robot.notes
    with pytest.raises(RobotError, match="gazebo 'elbow' <springStiffness value> is 'stiff'"):
        load(arm(f"<gazebo reference='elbow'>{spring.format('stiff')}</gazebo>"))


def test_inertia_that_raisim_adds_at_a_joint_is_kept_at_every_level(load):
    robot = load(arm(joint='<dynamics damping="0.1" rotor_inertia="0.05" stiffness="2.5"/>'))
    assert (diagonal(robot) - diagonal(load(arm())))[0] == pytest.approx(0.05, rel=1e-6)
    exact = ce_gym.Model(robot).mass_matrix(np.zeros(2))[0, 0]
    assert exact == pytest.approx(diagonal(robot)[0], rel=1e-6)
    assert robot.body("upper").joint.stiffness == 2.5


def test_a_yaml_file_goes_before_the_transmissions_of_its_urdf(load, tmp_path: Path):
    motor = TRANSMISSIONS["actuator"].format(j="shoulder", n=30, i=4e-5)
    load(arm(f"<transmission name='t'>{motor}</transmission>"))
    rotor = "xyz: [0, 0, 0], axis: [0, 0, 1], mass: 0.1, inertia: [1e-4, 0, 0, 1e-4, 0, 1e-4], ratios: {upper: 10}"
    yaml = f"urdf: arm.urdf\nrotors: {{m: {{parent: world, {rotor}}}}}\n"
    (tmp_path / "over.yaml").write_text(yaml)
    robot = load_robot(tmp_path / "over.yaml")
    assert [rotor.name for rotor in robot.rotors()] == ["m"]
    assert any("transmission 't'" in note for note in robot.notes)
    (tmp_path / "plain.yaml").write_text("urdf: arm.urdf\n")
    assert [rotor.name for rotor in load_robot(tmp_path / "plain.yaml").rotors()] == ["upper_rotor"]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("<transmission name='t'><joint name='elbow'/><mechanicalReduction>50</mechanicalReduction></transmission>",
         "<mechanicalReduction> without an inertia of the motor's rotor in transmission 't'"),
        ("<transmission name='t'><joint name='elbow'/><joint name='shoulder'/><motorInertia>1e-4</motorInertia>"
         "</transmission>", "<motorInertia>, which needs one joint of the file, in transmission 't'"),
        ("<gazebo reference='upper'><mu1>0.3</mu1><kp>1e5</kp></gazebo>", "<gazebo>: mu1, kp"),
        ("<gazebo reference='upper'><mu1>0.3</mu1></gazebo><gazebo reference='lower'><mu1>0.3</mu1></gazebo>",
         "<gazebo>: mu1 (2 times)"),
        ("<gazebo reference='upper'><springStiffness>3</springStiffness></gazebo>", "<gazebo>: springStiffness"),
        ("<mujoco><compiler meshdir='x' balanceinertia='true'/></mujoco>", "<mujoco>: compiler balanceinertia"),
        ("<transmission name='t'><joint name='elbow'><mechanicalReduction>3</mechanicalReduction></joint><actuator>"
         "<mechanicalReduction>5</mechanicalReduction><motorInertia>1e-4</motorInertia></actuator></transmission>",
         "<motorInertia> behind several ratios in transmission 't'"),
        ("<tendon name='x'/>", "<robot><tendon>"),
    ],
)  # fmt: skip
def test_words_that_are_left_out_are_noted(load, more: str, said: str):
    assert [said in note for note in load(arm(more)).notes] == [True]


def test_attributes_that_are_left_out_are_noted_with_their_number(load):
    text = arm().replace('velocity="3"', 'velocity="3" acceleration="40"')
    assert load(text).notes == ("left out: <limit acceleration> (2 times)",)
    assert load(arm(joint='<safety_controller k_velocity="1"/>')).notes == ("left out: <joint><safety_controller>",)


@pytest.mark.parametrize("root", [' xmlns="http://www.ros.org"', ' xmlns:xacro="http://ros.org/wiki/xacro"'])
def test_namespaces_change_nothing(load, root: str):
    assert load(arm(root=root)).bodies == load(arm()).bodies


@pytest.mark.parametrize(
    "encoding", ["iso-8859-1", "utf-16", "utf-16-le", "utf-8-sig", "utf-8", "gb18030", "shift_jis"]
)
def test_files_are_read_in_the_encoding_that_they_declare(load, encoding: str):
    declared = "utf-8" if encoding == "utf-8-sig" else encoding
    text = f'<?xml version="1.0" encoding="{declared}"?>' + arm().replace(
        "elbow", "肘" if encoding in ("gb18030", "shift_jis") else "Gelenk-Ü"
    )
    assert load(text, encoding).independent == ("upper", "lower")


def test_a_declared_encoding_that_cannot_be_is_put_right_or_refused(load):
    """A declaration that can be read byte by byte is not one of UTF-16, whatever it says."""
    text = '<?xml version="1.0" encoding="{}"?>' + arm()
    assert load(text.format("utf-16")).bodies == load(arm()).bodies
    for encoding in ("nonsense", "punycode", "ascii"):
        with pytest.raises(RobotError, match="cannot be read: expected text in the encoding that its"):
            load(text.format(encoding) + "<!-- Ü -->")


def test_an_undeclared_prefix_is_a_name_like_others(load):
    assert load(arm("<vendor:extra/>")).notes == ("left out: <robot><vendor:extra>",)


@pytest.mark.parametrize("more", ["<xacro:include filename='x'/>", "<link name='${prefix}hand'/>"])
def test_macros_that_were_not_expanded_are_refused(load, more: str):
    with pytest.raises(RobotError, match="expand it first: xacro"):
        load(arm(more))


def test_a_mimic_of_a_joint_that_does_not_move_is_fixed_at_its_offset(load):
    hand = (
        f"<link name='palm'>{inertial(0.2, 1e-3)}</link><joint name='wrist' type='fixed'><parent link='lower'/>"
        f"<child link='palm'/></joint><link name='finger'>{inertial(0.1, 1e-3)}</link>"
        "<joint name='knuckle' type='revolute'><parent link='palm'/><child link='finger'/><origin xyz='0.1 0 0'/>"
        "<axis xyz='0 0 1'/><limit lower='0' upper='1' effort='1' velocity='1'/><mimic joint='wrist' offset='{}'/>"
        "</joint>"
    )
    robot = load(arm(hand.format(0.5)))
    assert robot.independent == ("upper", "lower")
    assert robot.total_mass == pytest.approx(2.5)
    welded = hand.replace("type='revolute'", "type='fixed'").replace("<mimic joint='wrist' offset='{}'/>", "")
    welded = welded.replace("<origin xyz='0.1 0 0'/>", "<origin xyz='0.1 0 0' rpy='0 0 0.5'/>")
    expected = load(arm(welded), name="welded.urdf").body("lower").inertial
    np.testing.assert_allclose(robot.body("lower").inertial.inertia, expected.inertia, rtol=1e-12)


def test_a_mimic_with_a_multiplier_of_zero_is_fixed_at_its_offset(load):
    robot = load(arm(joint='<mimic joint="elbow" multiplier="0" offset="0.5"/>'))
    assert robot.independent == ("lower",)
    assert robot.body("lower").placement.position == pytest.approx((0.3 * np.cos(0.5), 0.3 * np.sin(0.5), 0.0))
    assert any("fixed at 0.5" in note for note in robot.notes)


TIP = (
    "<link name='tip'/><link name='pad'/>"
    "<joint name='wrist' type='{}'><parent link='lower'/><child link='tip'/><axis xyz='0 0 1'/></joint>"
    "<joint name='grip' type='prismatic'><parent link='tip'/><child link='pad'/>{}</joint>"
)


@pytest.mark.parametrize("kind", ["revolute", "floating"])
@pytest.mark.parametrize("mimic", ["", "<mimic joint='wrist'/>"])
def test_joints_that_move_no_mass_are_fixed_with_a_warning(load, tmp_path: Path, kind: str, mimic: str):
    """Pinocchio's mass matrix is singular there; that of the other joints is the same."""
    with pytest.warns(LossyImportWarning, match="'wrist' moves no mass: it is fixed at 0") as caught:
        robot = load(arm(TIP.format(kind, mimic)))
    assert len(caught) == 1
    assert robot.bodies == load(arm(), name="bare.urdf").bodies
    assert any("'grip'" in note for note in robot.notes)
    (tmp_path / "over.yaml").write_text("urdf: arm.urdf\n")
    with pytest.warns(LossyImportWarning, match="'wrist' moves no mass"):
        assert load_robot(tmp_path / "over.yaml").independent == ("upper", "lower")


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_joints_that_move_mass_or_say_that_it_is_0_stay(load):
    motor = TRANSMISSIONS["actuator"].format(j="wrist", n=30, i=4e-5)
    tip = TIP.format("revolute", "").replace("<link name='pad'/>", f"<link name='pad'>{inertial(0.1, 1e-4)}</link>")
    assert load(arm(f"{tip}<transmission name='t'>{motor}</transmission>")).independent[-2:] == ("tip", "pad")
    with pytest.raises(RobotError, match="link 'tip' mass is 0"):  # the file says that it is 0
        load(arm(TIP.format("revolute", "").replace("<link name='tip'/>", f"<link name='tip'>{inertial(0, 0)}</link>")))


def test_moving_links_without_inertial_have_no_mass(load):
    text = arm().replace(f'<link name="upper">{inertial(1.5, I)}</link>', '<link name="upper"/>')
    robot = load(text)
    assert robot.body("upper").inertial.mass == 0.0
    assert any("'upper'" in note for note in robot.notes)
    assert load(arm().replace(inertial(0.7, 0.01), inertial(0.7, 0.01))).total_mass == 2.2


def test_inertia_that_is_negative_by_rounding_is_zero(load):
    text = arm(f"<link name='cap'>{inertial(0.0, -5.4e-20)}</link><joint name='c' type='fixed'><parent link='lower'/>"
               "<child link='cap'/></joint>")  # fmt: skip
    np.testing.assert_array_equal(load(text).body("lower").inertial.inertia, load(arm()).body("lower").inertial.inertia)
    with pytest.raises(RobotError, match="positive semidefinite"):
        load(arm().replace(inertial(1.5, I), inertial(1.5, -1e-9)))


def test_a_new_file_gives_no_gains_to_joints_without_effort(tmp_path: Path):
    """Such joints are passive where others have an effort; names that mean something to YAML are quoted."""
    text = PUP.read_text().replace("fl_thigh", "fl thigh: 1").replace("fr_shank", "on")
    head, tail = text.split('effort="', 1)
    urdf = tmp_path / "pup.urdf"
    urdf.write_text(f'{head}effort="0{tail[tail.index(chr(34)) :]}')
    (tmp_path / "pup.yaml").write_text("name: another\nurdf: pup.urdf\n")
    out, robot, _ = write_new_robot(urdf, tmp_path / "mine.yaml")
    assert len(robot.passive) == 1
    assert robot.name == "pup"
    assert {"fl thigh: 1", "on"} <= {*robot.independent}
    assert f"effort is 0: {robot.passive[0]}." in out.read_text()


def test_inspect_prints_what_the_file_says_beyond_the_robot(load, tmp_path: Path, capsys):
    load(arm("<gazebo reference='upper'><mu1>0.3</mu1></gazebo>"))
    assert main(["inspect", str(tmp_path / "arm.urdf"), "--no-errors", "--no-standing"]) == 0
    assert "left out: <gazebo>: mu1\n" in capsys.readouterr().out


def test_efforts_of_zero_are_said(load):
    robot = load(arm().replace('effort="9" velocity="3"', 'effort="0" velocity="0"'))
    assert [line[:12] for line in zero_limits(robot)] == ["no torque: t", "no speed: th"]
    assert zero_limits(load(arm())) == []


def test_a_new_file_names_the_urdf_from_its_own_folder(tmp_path: Path):
    (tmp_path / "vendor parts").mkdir()
    (tmp_path / "mine").mkdir()
    urdf = tmp_path / "vendor parts" / "pup.urdf"
    urdf.write_text(PUP.read_text())
    out, robot, _ = write_new_robot(urdf, tmp_path / "mine" / "pup.yaml")
    assert '"../vendor parts/pup.urdf"' in out.read_text()
    assert load_robot(out).independent == robot.independent


def test_a_new_file_that_cannot_be_loaded_is_not_left_behind(tmp_path: Path, monkeypatch):
    urdf = tmp_path / "pup.urdf"
    urdf.write_text(PUP.read_text())
    monkeypatch.setattr("ce_gym.new_robot.robot_file._contacts", lambda *_: "contacts: 3")
    with pytest.raises(RobotError):
        write_new_robot(urdf)
    assert not urdf.with_suffix(".yaml").exists()
