"""A YAML file over an MJCF file, links that are rotors, and the motor library."""

from __future__ import annotations

import numpy as np
import pytest
from mjcf_files import GEOMS, lump

from ce_gym.dynamics import Model
from ce_gym.model import RobotError, assets_folder, load_robot
from ce_gym.model.formats.motor_library import motor_table, motor_types

LEG = GEOMS.replace('name="hip"', 'name="hip" armature="0.01"')
KEY = '<keyframe><key qpos="0 0 0.43 1 0 0 0 0.25"/></keyframe>'
MOTOR = '<actuator><position joint="hip" kp="5" forcerange="-4 4"/></actuator>'
START = '<mujoco model="m"><compiler angle="radian" autolimits="true"/>'


@pytest.fixture
def over(tmp_path):
    """Write a YAML file over an MJCF file, and load it."""
    pytest.importorskip("mujoco")

    def load(yaml: str, body: str = LEG, rest: str = KEY + MOTOR):
        (tmp_path / "m.xml").write_text(f"{START}{body}{rest}</mujoco>")
        (tmp_path / "robot.yaml").write_text("mjcf: m.xml\n" + yaml)
        return load_robot(tmp_path / "robot.yaml")

    return load


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_what_the_yaml_does_not_say_is_the_mjcf_files(over):
    robot = over("name: mine\ngains: {kd: 0.3}\npose: {joints: {leg: 0.5}}\n")
    assert (robot.name, robot.pose.height, robot.pose.joints) == ("mine", 0.43, (("leg", 0.5),))
    assert (robot.gains.kp, robot.gains.kd) == ((("leg", 5.0),), (("leg", 0.3),))
    assert {contact.group for contact in robot.contacts} == {"torso", "limb", "foot"}
    assert robot.source.endswith("robot.yaml")
    toes = over("contacts: {toe: {body: leg, position: [0, 0, -0.4], radius: 0.02}}\n").contacts
    assert [contact.name for contact in toes] == ["toe"]


def test_gears_of_armature(over):
    """With a ratio, the armature is a rotor at `exact`: mass matrices differ there and nowhere else."""
    with pytest.warns(UserWarning, match="the gear ratio behind the armature of leg"):
        unknown = over("name: mine\n")
    known = over('gears: {"l*": -8}\n')
    (gear,) = known.constraints
    assert dict(gear.coefficients) == {"leg_rotor": 1.0, "leg": 8.0}
    q = Model(known).standing_q
    for level in ("armature", "coupled", "none"):
        np.testing.assert_allclose(Model(known, level).mass_matrix(q), Model(unknown, level).mass_matrix(q), atol=1e-12)
    coupling = (Model(known).mass_matrix(q) - Model(unknown).mass_matrix(q))[1, 6]
    assert coupling == pytest.approx(-0.01 / 8, rel=1e-4), "the momentum of the rotor, about y of the base"


def test_a_rotor_takes_the_place_of_the_armature(over):
    text = "rotors: {spin: {ratios: [leg]}}\nmotors: {spin: {use: mit_mini_cheetah, torque: 2.5}}\n"
    robot = over(text)
    assert [body.name for body in robot.rotors()] == ["spin"]
    M = {level: Model(robot, level).mass_matrix(Model(robot).standing_q) for level in ("armature", "none")}
    assert M["armature"][6, 6] - M["none"][6, 6] == pytest.approx(6.3e-5 * 36, rel=1e-9)
    np.testing.assert_allclose(
        M["none"][:6, :6],
        Model(over("gears: {leg: 9}\n"), "none").mass_matrix(Model(robot).standing_q)[:6, :6],
        atol=1e-12,
        err_msg="the carrier's published inertia counts the rotor",
    )
    (motor,) = robot.motors
    assert (motor.torque, motor.velocity) == (2.5, 240.0)


def test_a_body_without_joint_that_is_a_rotor(over):
    wheel = f'<body name="wheel" pos="0 0.1 0">{lump(0.1, 0.0)}</body></body></body></worldbody>'
    body = GEOMS.replace(
        "</body></body></worldbody>", wheel.replace("</body></body></worldbody>", "", 1) + "</body></body></worldbody>"
    )
    welded = over("name: mine\n", body)
    rotor = over("rotors: {wheel: {axis: [0, 1, 0], ratios: {leg: 5}}}\n", body)
    assert rotor.total_mass == pytest.approx(welded.total_mass)
    assert rotor.body("wheel").parent == "leg"
    assert rotor.body("leg").inertial.mass == pytest.approx(welded.body("leg").inertial.mass - 0.1)


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("urdf: x.urdf\n", "urdf or mjcf is 'both': expected exactly one of them"),
        ("base: floating\n", "base is 'floating': expected no `base`"),
        ("gears: {lag: 8}\n", "gears is 'lag': expected the name of a joint .*did you mean 'leg'"),
        ('gears: {"x*": 8}\n', r"gears is 'x\*': expected a pattern that fits a name"),
        ("gears: {leg: 0}\n", "gears.leg is 0.0: expected a number other than 0"),
        ("rotors: {spin: {ratios: [leg]}}\n", "rotors.spin.mass is missing"),
        ("rotors: {spin: {ratios: [leg], inertia: 1e-5}}\n", "rotors.spin.ratios is .'leg'.: expected a mapping"),
        ("rotors: {spin: {ratios: {leg: 8}, inertia: 1}}\n", "rotors on 'trunk' is 'spin': expected less inertia"),
        ("rotors: {spin: {ratios: {leg: 8}, inertia: 1e-5, mass: 1}}\n", "rotors.spin.mass is 1: expected none"),
        ("motors: {spin: {use: unitree_7520}}\n", "motors.spin.use is 'unitree_7520': .*did you mean 'unitree_"),
    ],
)
def test_one_line_says_what_is_wrong(over, text, message):
    with pytest.raises(RobotError, match=message):
        over(text)


def test_the_library_gives_what_its_sources_publish():
    library = motor_types()
    output = {name: round(motor.torque * motor.ratio, 2) for name, motor in library.items()}
    assert output["unitree_7520_14"] == 88.0
    assert output["unitree_go_m8010_6"] == 23.7
    reflected = {name: motor.inertia * motor.ratio**2 for name, motor in library.items()}
    assert reflected["unitree_5020"] == pytest.approx(0.00361, abs=1e-5)
    assert reflected["unitree_7520_22"] == pytest.approx(0.02510, abs=1e-5)
    assert all(len(motor.source) > 20 for motor in library.values())
    assert motor_table().count("\n") == len(library) + 1
    assert (assets_folder() / "motors.yaml").is_file()


def test_a_link_on_a_fixed_joint_that_is_a_rotor():
    robot = load_robot("go1")
    rotor = robot.body("FL_calf_rotor")
    assert (rotor.kind, rotor.parent, rotor.inertial.mass) == ("rotor", "FL_thigh", 0.089)
    assert rotor.placement.position == (0.0, -0.03235, 0.0)
