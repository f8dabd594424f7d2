"""MJCF export: MuJoCo loads it, and its own mass matrix and bias forces are those of our models at every level."""

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from ce_gym.convert import JointOrder
from ce_gym.dynamics.model import Model
from ce_gym.export.joint_ties import joint_ties
from ce_gym.export.mjcf import mass_properties, quaternion, to_mjcf, valid_inertia
from ce_gym.model import Constraint, Frame, LinearConstraint, Placement, RobotError, load_robot
from ce_gym.model.mechanism import LEVELS, build_mechanism

ROBOTS = ("mini_cheetah", "mit_humanoid_leg")
pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


def random_state(model, rng):
    q, v, tau = rng.uniform(-1, 1, model.nq), rng.uniform(-2, 2, model.nv), rng.uniform(-10, 10, model.nv)
    if model.robot.floating:
        q[3:7] /= np.linalg.norm(q[3:7])
    return q, v, tau


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", ROBOTS)
def test_mujoco_has_the_same_dynamics(name, level):
    pytest.importorskip("mujoco")
    import mujoco_dynamics

    from ce_gym.export.mujoco_model import load

    robot = load_robot(name)
    model, peer = Model(robot, level), load(robot, level)
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, v, tau = random_state(model, rng)
        M, vdot = model.mass_matrix(q), model.forward_dynamics(q, v, tau)
        assert np.abs(mujoco_dynamics.mass_matrix(peer, robot, q) - M).max() <= 1e-9 * np.abs(M).max()
        theirs = mujoco_dynamics.forward_dynamics(peer, robot, q, v, tau)
        assert np.abs(theirs - vdot).max() <= 1e-9 * np.abs(vdot).max()


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", ROBOTS)
def test_every_level_has_the_same_mass(name, level):
    mujoco = pytest.importorskip("mujoco")
    robot = load_robot(name)
    peer = mujoco.MjModel.from_xml_string(to_mjcf(robot, level))
    assert peer.body_mass.sum() == pytest.approx(robot.total_mass, abs=1e-10)


@pytest.mark.parametrize("level", ["exact", "armature"])
def test_the_robot_stands_in_mujoco(level):
    mujoco = pytest.importorskip("mujoco")
    robot = load_robot("mini_cheetah")
    peer = mujoco.MjModel.from_xml_string(to_mjcf(robot, level, timestep=0.002, integrator="Euler"))
    data = mujoco.MjData(peer)
    mujoco.mj_resetDataKeyframe(peer, data, 0)
    assert data.qpos[2] == robot.pose.height
    for _ in range(250):
        mujoco.mj_step(peer, data)
    feet = {contact.name for contact in robot.contacts if contact.group == "foot"}
    touching = {peer.geom(g).name for pair in data.contact.geom for g in pair} - {"ground"}
    assert touching == feet
    assert 0.8 * robot.pose.height < data.qpos[2] < robot.pose.height


def test_only_contact_spheres_collide_and_only_with_the_ground():
    robot = load_robot("mini_cheetah")
    spheres = {contact.name for contact in robot.contacts}
    for geom in ET.fromstring(to_mjcf(robot)).iter("geom"):
        wanted = (
            ("1", "0") if geom.get("name") in spheres else ("0", "1") if geom.get("name") == "ground" else ("0", "0")
        )
        assert (geom.get("contype"), geom.get("conaffinity")) == wanted


def test_gears_are_joint_equalities_and_belts_are_tendons():
    root = ET.fromstring(to_mjcf(load_robot("mit_humanoid_leg"), "exact", solref=(0.01, 1.0)))
    gears = {e.get("joint1"): e.get("polycoef") for e in root.findall("equality/joint")}
    assert gears["hip_ry_rotor"].split()[1] == "6.0"
    assert [e.get("tendon1") for e in root.findall("equality/tendon")] == ["ankle_rotor"]
    coefficients = {j.get("joint"): j.get("coef") for j in root.findall("tendon/fixed[@name='ankle_rotor']/joint")}
    assert coefficients == {"ankle_rotor": "1.0", "knee_link_joint": "-12.0", "ankle_link_joint": "-12.0"}
    assert all(e.get("solref") == "0.01 1.0" for e in root.find("equality"))


def test_armature_is_the_diagonal_of_the_reflected_inertia():
    root = ET.fromstring(to_mjcf(load_robot("mit_humanoid_leg"), "armature"))
    armature = {
        joint.get("name"): float(joint.get("armature")) for joint in root.iter("joint") if joint.get("armature")
    }
    assert armature["knee_link_joint"] == pytest.approx(12**2 * (0.0005548 + 0.00016841), rel=1e-12)
    assert armature["ankle_link_joint"] == pytest.approx(12**2 * 0.00016841, rel=1e-12)
    none = ET.fromstring(to_mjcf(load_robot("mit_humanoid_leg"), "none"))
    assert not any(joint.get("armature") for joint in none.iter("joint"))


HOP = """<mujoco model="hop"><worldbody><geom type="plane" size="0 0 1"/><body name="trunk" pos="0 0 .5"><freejoint/>
<geom type="box" size=".12 .08 .04" mass="3"/><body name="leg"><joint name="hip" axis="0 1 0" armature="{}"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass=".6"/></body></body></worldbody>
<actuator><position joint="hip" kp="40" gear="{}"/></actuator></mujoco>"""


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
@pytest.mark.parametrize("level", LEVELS[:3])
@pytest.mark.parametrize("gear", [1.0, -3.0, 50.0, 2e4])
@pytest.mark.parametrize("armature", [1e-6, 1e-3, 0.02, 10.0])
def test_armature_survives_a_round_trip(armature, gear, level, tmp_path):
    """The file's own joint inertia, that of MuJoCo's equalities written again, and that read again."""
    mujoco = pytest.importorskip("mujoco")
    import mujoco_dynamics

    path = tmp_path / "hop.xml"
    path.write_text(HOP.format(armature, gear))
    compiled = mujoco.MjModel.from_xml_path(str(path))
    data, M = mujoco.MjData(compiled), np.zeros((7, 7))
    mujoco.mj_forward(compiled, data)
    mujoco.mj_fullM(compiled, data, M)
    robot = load_robot(path)
    q = Model(robot, level).standing_q
    path.write_text(to_mjcf(robot, level))
    again = Model(load_robot(path), level)
    written = mujoco_dynamics.mass_matrix(mujoco.MjModel.from_xml_path(str(path)), robot, q)
    for found in (written[6, 6], again.mass_matrix(again.standing_q)[6, 6]):
        assert found - (M[6, 6] - armature) == pytest.approx(armature, rel=1e-6, abs=1e-12)


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
@pytest.mark.parametrize("name", ["go1", "tello", "mit_humanoid_leg"])
def test_names_of_joints_and_frames_survive_a_round_trip(name, tmp_path):
    pytest.importorskip("mujoco")
    robot, pose = load_robot(name), Placement((0.1, -0.2, 0.3), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    further = (Frame("sensor", robot.independent[-1], pose), Frame("marker", None, pose))
    robot = dataclasses.replace(robot, frames=(*robot.frames, *further))
    (tmp_path / "robot.xml").write_text(to_mjcf(robot, ground=robot.floating))
    again, ours = load_robot(tmp_path / "robot.xml"), Model(robot)
    assert {again.joint_name(body): body for body in again.independent} == {
        robot.joint_name(body): body for body in robot.independent
    }
    assert any(robot.joint_name(body) != body for body in robot.independent)
    theirs, rng = Model(again), np.random.default_rng(0)
    q = ours.standing_q + rng.uniform(-0.05, 0.05, ours.nq) * (np.arange(ours.nq) >= 7)
    order = JointOrder(ours, theirs.joint_links)
    (q_again,) = order.from_model(q)
    for frame in robot.frames:
        for found, expected in zip(theirs.frame_pose(q_again, frame.name), ours.frame_pose(q, frame.name), strict=True):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_offsets_of_constraints_are_kept():
    robot = load_robot("mit_humanoid_leg")
    shifted: tuple[Constraint, ...] = tuple(
        dataclasses.replace(c, offset=0.3 * dict(c.coefficients)["hip_rz_rotor"]) if "hip_rz_rotor" in c.bodies else c
        for c in robot.constraints
    )
    robot = dataclasses.replace(robot, constraints=shifted)
    assert joint_ties(build_mechanism(robot))["hip_rz_rotor"].offset == pytest.approx(0.3)
    equality = next(e for e in ET.fromstring(to_mjcf(robot)).iter("joint") if e.get("joint1") == "hip_rz_rotor")
    assert float(equality.get("polycoef").split()[0]) == pytest.approx(0.3)


def test_impossible_inertia_is_raised_as_little_as_possible():
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    impossible = rotation @ np.diag([0.1, 0.2, 0.4]) @ rotation.T
    moments = np.linalg.eigvalsh(valid_inertia(impossible))
    np.testing.assert_allclose(moments, [0.15, 0.25, 0.4], rtol=1e-8)
    assert moments[0] + moments[1] > moments[2]
    possible = np.diag([0.2, 0.3, 0.4])
    assert valid_inertia(possible) is possible


def test_mass_properties_invert_a_spatial_inertia():
    from ce_gym.model.mechanism import spatial_inertia

    body = load_robot("mini_cheetah").body("FL_hip_link")
    mass, com, inertia = mass_properties(spatial_inertia(body))
    assert mass == pytest.approx(body.inertial.mass)
    np.testing.assert_allclose(com, body.inertial.com, atol=1e-15)
    np.testing.assert_allclose(inertia, body.inertial.inertia, atol=1e-15)


def test_quaternion_at_half_turns():
    for axis in np.eye(3):
        half_turn = 2.0 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(quaternion(half_turn)), [0, *axis], atol=1e-15)


def test_errors_are_one_line():
    robot = load_robot("mit_humanoid_leg")
    with pytest.raises(RobotError, match="transmission 'rigid'"):
        to_mjcf(robot, "rigid")
    tie = LinearConstraint("tie", (("knee_link", 1.0), ("ankle_link", -1.0)))
    twice = dataclasses.replace(
        robot, independent=robot.independent[:-1], constraints=(*robot.constraints[:-1], tie, tie)
    )
    with pytest.raises(RobotError, match="do not determine") as caught:
        joint_ties(build_mechanism(twice))
    assert "\n" not in str(caught.value)
