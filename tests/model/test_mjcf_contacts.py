"""MJCF import: contacts, actuators, pose and looks; what cannot be represented is said, in one warning."""

from __future__ import annotations

import subprocess
import sys
import warnings

import numpy as np
import pytest
from mjcf_files import ANKLE, CHAIN, GEOMS, RODS, ROUGH, mjcf

from ce_gym.dynamics import Model
from ce_gym.model import LossyImportWarning, RobotError, load_robot

mujoco = pytest.importorskip("mujoco")


def test_contacts_actuators_pose_and_looks(write):
    actuator = '<position joint="hip" kp="5" kv="0.5" gear="3" forcerange="-4 2"/>'
    key = '<keyframe><key qpos="7 8 0.43 1 0 0 0 0.25" ctrl="0"/></keyframe>'
    start = '<mujoco model="m"><compiler angle="radian" autolimits="true"/>'
    text = f"{start}{GEOMS}<actuator>{actuator}</actuator>{key}</mujoco>"
    robot = load_robot(write(text))
    groups = {sphere.name: sphere.group for sphere in robot.contacts}
    assert groups == {f"hull_corner{i}": "torso" for i in range(1, 9)} | {"shin_top": "limb", "shin_bottom": "foot"}
    toe = next(sphere for sphere in robot.contacts if sphere.name == "shin_bottom")
    assert (toe.body, toe.radius) == ("leg", 0.02)
    np.testing.assert_allclose(toe.position, (0, 0, -0.4), atol=1e-12)
    corner = next(sphere for sphere in robot.contacts if sphere.name == "hull_corner1")
    np.testing.assert_allclose(corner.position, (0.2, 0.1, 0.05), atol=1e-12)
    assert robot.material.friction == 0.6
    joint = robot.body("leg").joint
    assert (joint.position, joint.damping, joint.torque) == ((-1.0, 2.0), 0.3, 12.0)
    assert (robot.gains.kp, robot.gains.kd) == ((("leg", 45.0),), (("leg", 4.5),))
    assert (robot.pose.height, robot.pose.joints) == (0.43, (("leg", 0.25),))
    assert [shape.type for shape in robot.body("trunk").shapes] == ["box", "sphere"]
    assert robot.body("leg").shapes[0].size == pytest.approx((0.02, 0.4))
    assert robot.gravity == (0.0, 0.0, -9.81)


@pytest.mark.parametrize(
    ("mask", "rest", "touching"),
    [
        ("", "", {"shin_top", "shin_bottom"}),
        ("", '<contact><exclude body1="world" body2="leg"/></contact>', set()),
        ('contype="0" conaffinity="0"', "", set()),
        ('contype="2" conaffinity="2"', "", set()),
        (
            'contype="0" conaffinity="0"',
            '<contact><pair geom1="floor" geom2="shin"/></contact>',
            {"shin_top", "shin_bottom"},
        ),
    ],
)
def test_only_what_mujoco_lets_touch_the_ground_is_a_contact(write, mask, rest, touching):
    geoms = GEOMS.replace('name="shin"', f'name="shin" {mask}')
    robot = load_robot(write(f"<mujoco>{geoms}{rest}</mujoco>"))
    assert {sphere.name for sphere in robot.contacts if sphere.body == "leg"} == touching


FOOTED = """<mujoco><option><flag override="{override}"/></option>
<default><default class="rubber"><geom friction="1.3" priority="1"/></default></default>
<worldbody><geom name="floor" type="plane" size="0 0 1" {floor}/>{world}<body name="trunk" pos="0 0 0.39"><freejoint/>
<geom name="hull" type="box" size=".1 .1 .05" {hull}/><body name="leg"><joint axis="0 1 0"/>
<geom name="foot" type="sphere" pos="0 0 -.37" size=".03" mass=".1" {foot}/></body></body></worldbody>
<contact>{contact}</contact></mujoco>"""
SECOND_FLOOR = '<body name="tiles"><geom type="plane" size="0 0 1" {}/></body>'


def footed(floor="", foot="", hull="", world="", contact="", override="disable") -> str:
    return FOOTED.format(floor=floor, foot=foot, hull=hull, world=world, contact=contact, override=override)


def mujocos_friction(text: str) -> float:
    """Return the largest sliding friction of MuJoCo's own contacts of the foot, 0 if they are frictionless."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    foot = model.geom("foot").id
    touching = [contact for contact in data.contact if foot in contact.geom]
    assert touching
    return max(float(contact.friction[0]) if contact.dim > 1 else 0.0 for contact in touching)


@pytest.mark.parametrize(
    "figures",
    [
        {},
        {"foot": 'friction="0.6"'},
        {"foot": 'friction="1.6"'},
        {"foot": 'friction="0.6" priority="1"'},
        {"foot": 'friction="0.6" priority="-1"'},
        {"foot": 'class="rubber"', "floor": 'friction="2"'},
        {"foot": 'class="rubber" friction="0.2"', "floor": 'friction="2" priority="1"'},
        {"foot": 'friction="0.6"', "floor": 'friction="0.3" priority="2"'},
        {"foot": 'friction="0.6"', "floor": 'friction="0.3"', "hull": 'friction="3" priority="5"'},
        {"foot": 'condim="1"', "floor": 'condim="1"'},
        {"foot": 'condim="1"', "floor": 'condim="4"'},
        {"foot": 'condim="1" priority="1"', "floor": 'condim="6"'},
        {"foot": 'friction="0"', "floor": 'friction="0"'},
        {"contact": '<pair geom1="foot" geom2="floor" friction="0.25 0.25 0 0 0"/>', "foot": 'priority="1"'},
        {"contact": '<pair geom1="floor" geom2="foot" condim="1"/>', "foot": 'contype="0" conaffinity="0"'},
        {"contact": '<pair geom1="floor" geom2="foot"/>', "foot": 'friction="0.6"', "floor": 'friction="0.3"'},
        {"contact": '<pair geom1="foot" geom2="floor"/><exclude body1="leg" body2="world"/>', "foot": 'friction="2"'},
        {"world": SECOND_FLOOR.format('friction="2"'), "contact": '<exclude body1="tiles" body2="leg"/>'},
        {"world": SECOND_FLOOR.format('friction="0.3"'), "floor": 'friction="0.4"', "foot": 'friction="0.5"'},
        {"world": SECOND_FLOOR.format('priority="1" friction="1.3"'), "foot": 'friction="0.5"'},
        {"world": SECOND_FLOOR.format('contype="2" conaffinity="2" friction="3"'), "foot": 'friction="0.5"'},
        {"override": "enable", "foot": 'friction="0.6" priority="1"'},
    ],
    ids=lambda figures: " ".join(figures),
)
@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_feet_have_the_friction_of_mujocos_contacts(write, figures):
    text = footed(**figures)
    assert load_robot(write(text)).material.friction == pytest.approx(mujocos_friction(text), abs=1e-12)


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_feet_have_the_friction_of_mujocos_contacts_whatever_the_figures(write):
    rng = np.random.default_rng(0)

    def figures() -> str:
        friction, priority, condim = rng.uniform(0.1, 2), rng.integers(-1, 2), rng.choice((1, 3, 4, 6))
        return f'friction="{friction}" priority="{priority}" condim="{condim}" solmix="{rng.uniform(0, 1)}"'

    for _ in range(30):
        text = footed(floor=figures(), foot=figures(), hull=figures())
        assert load_robot(write(text)).material.friction == pytest.approx(mujocos_friction(text), abs=1e-12)


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_without_ground_in_the_file_feet_have_their_own_friction(write):
    world = '<geom name="floor" type="plane" size="0 0 1" />'
    for own, friction in (("", 1.0), ('friction="0.6"', 0.6), ('friction="0.6" condim="1"', 0.6)):
        robot = load_robot(write(footed(foot=own).replace(world, "")))
        assert robot.material.friction == friction


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_what_touches_the_ground_is_no_rotor(write):
    """A wheel that is coupled to another is tied and symmetric as rotors are, but it is outside."""
    wheel = '<body name="{0}"><joint name="{0}"/><geom type="sphere" size=".1"/></body>'
    world = f'<geom type="plane" size="1 1 1"/>{wheel.format("left")}{wheel.format("right")}'
    tie = '<equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0"/></equality>'
    robot = load_robot(write(f"<mujoco><worldbody>{world}</worldbody>{tie}</mujoco>"))
    assert [body.kind for body in robot.bodies] == ["link", "link"]
    assert len(robot.contacts) == 2
    assert Model(robot).contact_points([0.1], [2.0])[0].shape == (2, 3)


@pytest.mark.parametrize(
    ("geom", "count", "reach"),
    [
        ('type="cylinder" size="0.05 0.2"', 8, 0.2),
        ('type="ellipsoid" size="0.05 0.06 0.2"', 6, 0.2),
        ('type="mesh" mesh="wedge"', 4, 0.1),
    ],
)
def test_points_of_geoms_are_on_their_surface(write, geom, count, reach):
    wedge = '<asset><mesh name="wedge" vertex="0 0 0.1  0.1 0 -0.1  -0.1 0.05 -0.1  -0.1 -0.05 -0.1"/></asset>'
    leg = f'<body name="leg" pos="0 0 -0.4"><joint axis="0 1 0"/><geom name="g" {geom}/></body>'
    world = f'<worldbody><body name="b" pos="0 0 1"><freejoint/><geom size="0.1"/>{leg}</body></worldbody>'
    path = write(f"<mujoco>{wedge}{world}</mujoco>")
    robot = load_robot(path)
    spheres = [sphere for sphere in robot.contacts if sphere.body == "leg"]
    assert len(spheres) == count
    assert {sphere.radius for sphere in spheres} == {0.0}
    model = Model(robot)
    points = model.contact_points(model.standing_q, np.zeros(7))[0][-count:]
    assert points[:, 2].min() == pytest.approx(0.6 - reach, abs=1e-6)
    assert {sphere.group for sphere in spheres} == {"foot", "limb"}


def test_what_several_limbs_hang_on_is_torso(write):
    """A chest above a pelvis without geoms: falling on the chest must end an episode."""
    arms = "".join(
        f'<body name="{side}" pos="0 {y} 0"><joint axis="0 1 0"/><geom size="0.05" pos="0 0 -0.2"/></body>'
        for side, y in (("left", 0.2), ("right", -0.2))
    )
    chest = f'<body name="chest" pos="0 0 0.3"><joint axis="0 0 1"/><geom size="0.1"/>{arms}</body>'
    leg = '<body name="leg"><joint axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.8"/></body>'
    inertial = '<inertial pos="0 0 0" mass="5" diaginertia="0.1 0.1 0.1"/>'
    world = f'<worldbody><body name="pelvis" pos="0 0 1"><freejoint/>{inertial}{chest}{leg}</body></worldbody>'
    robot = load_robot(write(f"<mujoco>{world}</mujoco>"))
    groups = {sphere.body: set() for sphere in robot.contacts}
    for sphere in robot.contacts:
        groups[sphere.body].add(sphere.group)
    assert groups == {"chest": {"torso"}, "left": {"limb"}, "right": {"limb"}, "leg": {"limb", "foot"}}


def test_a_reference_pose_beyond_its_limits_is_moved_and_stands(write):
    text = GEOMS.replace('range="-1 2"', 'range="1 2"')
    start = '<mujoco><compiler angle="radian" autolimits="true"/>'
    with pytest.warns(LossyImportWarning, match="beyond its limits, of leg"):
        robot = load_robot(write(f"{start}{text}</mujoco>"))
    assert robot.pose.joints == (("leg", 1.0),)
    assert robot.pose.height == pytest.approx(0.4 * np.cos(1.0) + 0.02, abs=1e-9)


def test_physics_that_the_file_switches_off(write):
    robot = load_robot(write(f'<mujoco><option><flag gravity="disable" contact="disable"/></option>{GEOMS}</mujoco>'))
    assert robot.gravity == (0.0, 0.0, 0.0)
    assert robot.contacts == ()


@pytest.mark.filterwarnings("error::ce_gym.LossyImportWarning")
@pytest.mark.parametrize(
    "actuator",
    [
        '<motor joint="hip" ctrlrange="-3 3" gear="2"/>',
        '<position joint="hip" kp="9" ctrlrange="-1 2" forcerange="-5 5"/>',
        '<position joint="hip" kp="9" inheritrange="1"/>',
        '<position joint="hip" kp="9" gear="2" ctrlrange="-2 4"/>',
    ],
)
def test_what_is_represented_is_not_said(write, actuator):
    load_robot(write(hopper(actuator)))


@pytest.mark.parametrize("flag", ["frictionloss", "limit", "spring", "damper", "constraint"])
def test_figures_that_a_flag_switches_off_are_zero(write, flag):
    world = CHAIN.replace('name="a"', 'name="a" frictionloss="1" range="-1 1" stiffness="2" damping="3"')
    fields = ("friction", "position", "stiffness", "damping")
    off = {"frictionloss": {0}, "limit": {1}, "spring": {2}, "damper": {3}, "constraint": {0, 1}}[flag]
    try:
        robot = load_robot(write(mjcf(world, extra=f'<option><flag {flag}="disable"/></option>')))
    except RobotError:
        pytest.skip("this MuJoCo has no such flag")
    joint = robot.body("arm").joint
    values = [(1.0, 0.0), ((-1.0, 1.0), (-np.inf, np.inf)), (2.0, 0.0), (3.0, 0.0)]
    assert [getattr(joint, field) for field in fields] == [pair[i in off] for i, pair in enumerate(values)]


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_an_equality_that_a_flag_switches_off_is_none(write):
    equality = '<joint joint1="f" joint2="a" polycoef="0 1 0 0 0"/>'
    off = '<option><flag equality="disable"/></option>'
    assert len(load_robot(write(mjcf(CHAIN, equality))).independent) == 4
    robot = load_robot(write(mjcf(CHAIN, equality, extra=off)))
    assert (len(robot.independent), robot.constraints) == (5, ())


HIP = 'name="hip" axis="0 1 0" range="-1 2"'
LATER = '<?xml version="1.0"?>'  # marks what only later versions of MuJoCo have


def hopper(actuator="", option="", **changes) -> str:
    """The hopper with more attributes of its joints and geoms."""
    text = GEOMS.replace("<freejoint/>", f'<joint name="base" type="free" {changes.get("base", "")}/>')
    text = text.replace(HIP, f"{HIP} {changes.get('hip', '')}").replace(
        'name="shin"', f'name="shin" {changes.get("shin", "")}'
    )
    start = f'<compiler angle="radian"/>{option}'
    return f"<mujoco>{start}{text}<actuator>{actuator}</actuator>{changes.get('rest', '')}</mujoco>"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (hopper(base='damping="1"'), "damping of the free joint base"),
        (hopper(hip='margin="0.1"'), "margin of the limit of joint hip"),
        (hopper(hip='solreflimit="0.01 1"'), "compliance (solreflimit, solimplimit) of the limit of joint hip"),
        (
            hopper(hip='frictionloss="1" solreffriction=".01 1"'),
            "compliance (solreffriction, solimpfriction) of the dry",
        ),
        (LATER + hopper(hip='stiffness="1" springyield="0.2"'), "yielding (springyield) of the spring of joint hip"),
        (hopper(hip='actuatorfrcrange="-3 2"'), "the nearer one of the two limits actuatorfrcrange of joint hip"),
        (LATER + hopper(shin='adhesion="1"'), "adhesion of geom shin"),
        (LATER + hopper(shin='surfacevel="1 0 0"'), "moving surface (surfacevel) of geom shin"),
        (
            hopper('<motor name="m" joint="hip" forcerange="-3 2"/>'),
            "the nearer one of the two limits forcerange of actuator m",
        ),
        (
            hopper('<motor name="m" joint="hip" ctrlrange="0 2"/>'),
            "the nearer one of the two limits ctrlrange of actuator m",
        ),
        (hopper('<position name="m" joint="hip" kp="9" ctrlrange="0 2"/>'), "ctrlrange of actuator m, narrower"),
        (
            hopper('<position name="m" joint="hip" kp="9" gear="2" ctrlrange="-1 2"/>'),
            "ctrlrange of actuator m, narrower",
        ),
        (LATER + hopper('<motor name="m" joint="hip" delay=".01" nsample="5"/>'), "delay of actuator m"),
        (
            hopper('<general name="m" joint="hip" biastype="affine" biasprm="1 -2 0" gainprm="2"/>'),
            "constant force (first",
        ),
        (
            hopper('<motor name="m" joint="hip"/>', '<option actuatorgroupdisable="0"/>'),
            "actuatorgroupdisable of actuator m",
        ),
        (hopper('<motor joint="hip"/>', '<option><flag actuation="disable"/></option>'), '<flag actuation="disable"/>'),
        (hopper(rest='<keyframe><key qvel="1 0 0 0 0 0 0"/></keyframe>'), "the velocity (qvel) of the reference pose"),
        (hopper(option='<option viscosity="1"/>'), "viscosity of the medium"),
        (mjcf(CHAIN.replace('name="a"', 'name="a" stiffness="3 1"')), "nonlinear part of the spring of joint a"),
        (
            f"<mujoco>{GEOMS}</mujoco>".replace("<freejoint/>", '<joint name="f" type="free" frictionloss="3"/>'),
            "friction of joint f",
        ),
        (mjcf(CHAIN.replace('name="arm"', 'name="arm" gravcomp="1"')), "gravity compensation of body arm"),
        (mjcf(CHAIN, extra='<option wind="1 0 0"/>'), "wind"),
        (mjcf(CHAIN, '<joint name="e" joint1="f" joint2="a" active="false"/>'), "equality e, which is not active"),
        (mjcf(ANKLE, '<tendon name="e" tendon1="l_rod" tendon2="r_rod"/>', RODS), "equality e"),
        (mjcf(CHAIN, actuator='<adhesion name="m" body="arm" ctrlrange="0 1"/>'), "actuator m"),
        (mjcf(CHAIN, actuator='<general name="m" joint="a" dyntype="filter" dynprm="0.1"/>'), "activation dynamics"),
        (mjcf(CHAIN, actuator='<velocity name="m" joint="a" kv="1"/>'), "velocity actuators"),
        (mjcf(CHAIN, "", '<fixed name="t" stiffness="2"><joint joint="a" coef="1"/></fixed>'), "tendon t"),
        (mjcf(CHAIN + '<geom name="g" type="box" size="1 1 1"/>'), "obstacle g"),
        (mjcf(CHAIN.replace('name="a"', 'name="a" armature="1"')), "the gear ratio behind the armature of arm"),
        (mjcf(CHAIN.replace('name="a"', 'name="a" range="1 2"')), "beyond its limits, of arm"),
        (
            f"<mujoco>{GEOMS}</mujoco>".replace('name="shin"', 'name="shin" condim="6"'),
            "torsional and rolling friction",
        ),
        (f"<mujoco>{GEOMS}</mujoco>".replace('name="shin"', 'name="shin" margin="0.01"'), "margin and gap of contacts"),
        (f"<mujoco>{GEOMS}</mujoco>".replace('name="shin"', 'name="shin" solref=".01 1"'), "compliance of contacts"),
        (
            f'<mujoco>{GEOMS}<contact><pair geom1="floor" geom2="shin" friction=".5 .4 0 0 0"/></contact></mujoco>',
            "smaller one of two sliding frictions",
        ),
        (
            f'<mujoco>{GEOMS}<contact><pair geom1="hull" geom2="shin"/></contact></mujoco>'.replace(
                'name="hull"', 'name="hull" contype="0"'
            )
            .replace(
                '<body name="leg"',
                "<body><joint/><geom size='.1' mass='1' contype='0' conaffinity='0'/><body name=\"leg\"",
            )
            .replace("</body></body></worldbody>", "</body></body></body></worldbody>"),
            "contact between bodies of the robot",
        ),
        (
            f"<mujoco>{GEOMS.replace(ROUGH, ROUGH.replace('0.6', '0.9'))}</mujoco>",
            "friction other than 0.6: 0.9 of hull_corner1 and 7 more",
        ),
    ],
    ids=lambda value: value[:40] if not value.startswith("<") else "",
)
def test_what_cannot_be_represented_is_said_once(write, text, what):
    try:
        mujoco.MjModel.from_xml_string(text)
    except ValueError:
        assert text.startswith(LATER)
        pytest.skip("this MuJoCo has no such attribute")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        robot = load_robot(write(text))
    messages = [str(w.message) for w in caught if issubclass(w.category, LossyImportWarning)]
    assert len(messages) == 1
    assert what in messages[0]
    assert "\n" not in messages[0]
    assert any(what in note for note in robot.notes)


def test_without_mujoco_the_error_says_what_to_install(write):
    path = write(mjcf(CHAIN))
    code = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from ce_gym.model import RobotError, load_robot\n"
        f"try: load_robot({str(path)!r})\nexcept RobotError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert "pip install 'ce_gym[mjcf]'" in done.stdout
