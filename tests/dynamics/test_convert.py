"""Coordinates of Pinocchio, of MuJoCo and in another order: their dynamics agree with ours after conversion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ball_joints import random_state, with_balls
from pinocchio_peer import Peer

from ce_gym.convert import JointOrder, MuJoCo, Pinocchio
from ce_gym.dynamics import Model
from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import assets_folder, load_robot

pytestmark = [
    pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning"),
    pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning"),
]
Array = np.ndarray
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1.5" iyz="0" izz="0.7"/></inertial>'
CART = f"""<robot name="cart">
<link name="base">{INERTIAL}</link><link name="wheel">{INERTIAL}</link><link name="slide">{INERTIAL}</link>
<link name="twin">{INERTIAL}</link><link name="lidar"/>
<joint name="spin" type="continuous"><parent link="base"/><child link="wheel"/><origin xyz="0 .1 .2"/></joint>
<joint name="idle" type="continuous"><parent link="base"/><child link="lidar"/></joint>
<joint name="push" type="prismatic"><parent link="wheel"/><child link="slide"/><axis xyz="0 1 0"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="follow" type="prismatic"><parent link="slide"/><child link="twin"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="push" multiplier="-2" offset="0.1"/></joint>
</robot>"""


def state(model: Model, batch: tuple[int, ...] = ()) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(0)
    q = model.standing_q + rng.uniform(-0.5, 0.5, (*batch, model.nq))
    for i, _ in model.robot.layout.turns:
        q[..., i : i + 4] = rng.normal(size=(*batch, 4))
        q[..., i : i + 4] /= np.linalg.norm(q[..., i : i + 4], axis=-1, keepdims=True)
    return q, rng.normal(size=(*batch, model.nv)), rng.normal(size=(*batch, model.nv))


def assert_same(ours, theirs) -> None:
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12 * max(1.0, np.abs(other).max()))


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
@pytest.mark.parametrize("robot", ["mini_cheetah", "tello", "mit_humanoid_leg", "balls"])
def test_there_and_back(robot: str, batch: tuple[int, ...]):
    pytest.importorskip("pinocchio")
    mujoco = pytest.importorskip("mujoco")
    description = with_balls(True) if robot == "balls" else load_robot(robot)
    model, given = Model(description), state(Model(description), batch)
    names = [name for name in model.spanning_names if name != "base"][::-1]
    for coordinates in (
        Pinocchio(model, Peer(description).model),
        MuJoCo(model, mujoco.MjModel.from_xml_string(to_mjcf(description, "exact"))),
        JointOrder(model, names),
    ):
        q, v, tau = given
        assert_same(coordinates.to_model(*coordinates.from_model(q, v, tau)), (q, v, tau))
        assert_same(coordinates.to_model(*coordinates.from_model(q, tau=tau)[:1]), (q,))
        _, velocities, forces = coordinates.from_model(q, v, tau)
        power = np.einsum("...i,...i->...", velocities, forces)
        np.testing.assert_allclose(power, np.einsum("...i,...i->...", v, tau), atol=1e-12)


@pytest.mark.parametrize("mimic", [True, False])
@pytest.mark.parametrize("floating", [True, False])
def test_pinocchio_reads_the_same_file(tmp_path: Path, floating: bool, mimic: bool):
    """Links are where Pinocchio puts them, and bias forces agree: a continuous joint, one without mass, a <mimic>."""
    pin = pytest.importorskip("pinocchio")
    (tmp_path / "cart.urdf").write_text(CART)
    model = Model(load_robot(tmp_path / "cart.urdf", floating=floating))
    roots = [pin.JointModelFreeFlyer()] if floating else []
    peer = pin.buildModelFromUrdf(str(tmp_path / "cart.urdf"), *roots, mimic=mimic)
    coordinates, data = Pinocchio(model, peer), peer.createData()
    q, v, _ = state(model)
    q_pin, v_pin = coordinates.from_model(q, v)
    pin.framesForwardKinematics(peer, data, q_pin)
    for name in set(model.frame_names):
        np.testing.assert_allclose(
            model.frame_pose(q, name)[0], data.oMf[peer.getFrameId(name)].translation, atol=1e-12
        )
        np.testing.assert_allclose(model.frame_pose(q, name)[1], data.oMf[peer.getFrameId(name)].rotation, atol=1e-12)
    bias = coordinates.to_model(q_pin, tau=pin.nonLinearEffects(peer, data, q_pin, v_pin))[1]
    np.testing.assert_allclose(bias, model.bias_force(q, v), atol=1e-12)
    for name, size in (("q", peer.nq), ("v", peer.nv), ("tau", peer.nv)):
        with pytest.raises(ValueError, match=rf"{name} has shape \(99,\); expected \(\.\.\., {size}\)"):
            coordinates.to_model(**{"q": q_pin, name: np.zeros(99)})


def test_pinocchio_and_a_quadruped():
    """The frames of a shipped file, its feet included, and bias forces without rotors."""
    pin = pytest.importorskip("pinocchio")
    file = assets_folder() / "go1" / "go1.urdf"
    peer = pin.buildModelFromUrdf(str(file), pin.JointModelFreeFlyer())
    model, data = Model(load_robot(file, floating=True)), peer.createData()
    coordinates, (q, v, _) = Pinocchio(model, peer), state(model)
    q_pin, v_pin = coordinates.from_model(q, v)
    pin.framesForwardKinematics(peer, data, q_pin)
    assert {"imu_link", "FL_foot"} <= set(model.frame_names)
    for name in model.frame_names:
        place = data.oMf[peer.getFrameId(name)]
        np.testing.assert_allclose(model.frame_pose(q, name)[0], place.translation, atol=1e-12)
    bias = coordinates.to_model(q_pin, tau=pin.nonLinearEffects(peer, data, q_pin, v_pin))[1]
    np.testing.assert_allclose(bias, model.bias_force(q, v), atol=1e-10)


@pytest.mark.parametrize("robot", ["mini_cheetah", "mit_humanoid_leg", "balls"])
def test_mujoco_s_bias_forces(robot: str):
    """MuJoCo's bias is at zero acceleration in the world; ours adds the turning of the base's axes."""
    mujoco = pytest.importorskip("mujoco")
    from ce_gym.export.mujoco_model import load

    description = with_balls(True) if robot == "balls" else load_robot(robot)
    model = Model(description)
    peer = load(description, "exact")
    peer.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    coordinates, data, (q, v, _) = MuJoCo(model, peer), mujoco.MjData(peer), state(model)
    data.qpos[:], data.qvel[:] = coordinates.from_model(q, v)
    mujoco.mj_forward(peer, data)
    for name in model.body_names:
        np.testing.assert_allclose(model.frame_pose(q, name)[0], data.body(name).xpos, atol=1e-10)
    vdot = np.zeros(model.nv)
    if model.robot.floating:
        vdot[3:6] = -np.cross(v[:3], v[3:6])
    bias = coordinates.to_model(data.qpos, tau=data.qfrc_bias)[1]
    np.testing.assert_allclose(bias, model.inverse_dynamics(q, v, vdot), atol=1e-9 * np.abs(bias).max())


@pytest.mark.parametrize("robot", ["mini_cheetah", "balls"])
def test_mujoco_s_momentum(robot: str):
    """Centre of mass, momentum, and their Jacobians; the rotors are bodies in MuJoCo."""
    mujoco = pytest.importorskip("mujoco")
    from ce_gym.export.mujoco_model import load

    description = with_balls(True) if robot == "balls" else load_robot(robot)
    model, peer = Model(description), load(description, "exact")
    coordinates, data, (q, v, _) = MuJoCo(model, peer), mujoco.MjData(peer), state(model)
    data.qpos[:], data.qvel[:] = coordinates.from_model(q, v)
    mujoco.mj_forward(peer, data)
    mujoco.mj_subtreeVel(peer, data)
    to_qvel = np.array([coordinates.from_model(q, unit)[1] for unit in np.eye(model.nv)]).T
    angular, center = np.zeros((2, 3, peer.nv))
    mujoco.mj_angmomMat(peer, data, angular, 1)
    mujoco.mj_jacSubtreeCom(peer, data, center, 1)
    momentum = np.concatenate([data.subtree_angmom[1], peer.body_mass.sum() * data.subtree_linvel[1]])
    assert_same(
        (model.center_of_mass(q), model.center_of_mass_velocity(q, v), model.centroidal_momentum(q, v)),
        (data.subtree_com[1], data.subtree_linvel[1], momentum),
    )
    assert_same(
        (model.centroidal_momentum_matrix(q)[:3], model.center_of_mass_jacobian(q)),
        (angular @ to_qvel, center @ to_qvel),
    )


@pytest.mark.parametrize("names", ["joint_names", "joint_links"])
def test_another_order(names: str):
    model = Model("go1")
    q, v, tau = state(model)
    q_file, v_file, tau_file = JointOrder(model, getattr(model, names)[::-1]).from_model(q, v, tau)
    for ours, other, base in ((q, q_file, 7), (v, v_file, 6), (tau, tau_file, 6)):
        np.testing.assert_array_equal(other, [*ours[:base], *ours[base:][::-1]])


def test_other_robots_are_refused(tmp_path: Path):
    pin = pytest.importorskip("pinocchio")
    (tmp_path / "cart.urdf").write_text(CART)
    peer = pin.buildModelFromUrdf(str(tmp_path / "cart.urdf"))
    with pytest.raises(ValueError, match="Pinocchio has no joint that moves 'base'; expected all joints of Model"):
        Pinocchio(Model(load_robot(tmp_path / "cart.urdf")), peer)
    with pytest.raises(ValueError, match="joints='wing'; expected a joint of mini_cheetah:"):
        JointOrder(Model("mini_cheetah"), ["wing"])
    robot = with_balls(False)
    model, other = Model(robot), Peer(robot)
    assert Pinocchio(model, other.model).from_model(*random_state(robot, 0))[0].shape == (other.model.nq,)
