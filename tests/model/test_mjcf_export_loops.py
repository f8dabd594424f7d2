"""MJCF export of closed loops: MuJoCo's own mass matrix, bias forces and equality Jacobian give our accelerations."""

import dataclasses
import warnings
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.dynamics.standing import standing_pose
from ce_gym.export.joint_ties import joint_ties
from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import (
    Body,
    FunctionConstraint,
    Inertial,
    Joint,
    LinearConstraint,
    LoopConstraint,
    Placement,
    Pose,
    Robot,
    RobotError,
    RodConstraint,
    load_robot,
    register_constraint,
)
from ce_gym.model.mechanism import LEVELS, build_mechanism

TOLERANCE = 1e-9
STIFF = {"solref": (0.002, 1.0), "solimp": (0.9999, 0.9999, 0.001, 0.5, 2.0)}


def body(name, parent, position, axis=(0.0, 0.0, 1.0), kind="link", joint="revolute", rotation=None):
    inertial = Inertial(1.0, (0.1, 0.02, 0.01), ((0.02, 0.001, 0.0), (0.001, 0.03, 0.0), (0.0, 0.0, 0.04)))
    if kind == "rotor":
        inertial = Inertial(0.1, (0.0, 0.0, 0.0), ((1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 2e-3)))
    return Body(
        name, kind, parent, Placement(position, *([rotation] if rotation else [])), Joint(joint, axis), inertial
    )


def slider_crank() -> Robot:
    """A rod from a crank to a slider, both on a swing, and another to the world; a belt drives a rotor on the swing."""
    tilted = ((0.6, 0.0, 0.8), (0.0, 1.0, 0.0), (-0.8, 0.0, 0.6))
    bodies = (
        body("swing", None, (0.0, 0.0, 0.5), (0.0, 0.6, 0.8)),
        body("crank", "swing", (0.1, 0.0, 0.0), (0.0, 0.0, 1.0), rotation=tilted),
        body("slider", "swing", (0.4, 0.05, 0.1), (1.0, 0.0, 0.0), joint="prismatic"),
        body("follower", None, (0.0, 0.6, 0.4), (1.0, 0.0, 0.0)),
        body("motor", "swing", (0.0, 0.1, 0.0), (0.0, 0.0, 1.0), "rotor", rotation=tilted),
        body("wheel", "swing", (0.0, -0.1, 0.0), (0.0, 0.0, 1.0), "rotor"),
    )
    ties = (
        RodConstraint("push", "crank", "slider", (0.0, 0.1, 0.0), (0.0, 0.02, 0.03), 0.35),
        RodConstraint("link", "swing", "follower", (0.0, 0.2, 0.1), (0.0, -0.1, 0.2), 0.4),
        LinearConstraint("belt", (("motor", 1.0), ("crank", -5.0), ("slider", -20.0)), 0.3),
        LinearConstraint("gear", (("wheel", 1.0), ("slider", -30.0))),
    )
    pose = Pose(joints=(("swing", 0.1), ("crank", 0.2)))
    return Robot("slider_crank", bodies, ties, ("swing", "crank"), pose=pose, assembly=(("slider", 0.0),))


def ball_loop() -> Robot:
    """A spatial four-bar: crank and rocker about skew axes, a coupler with a ball joint at its end."""
    tilted = (0.2 / 1.05**0.5, 0.1 / 1.05**0.5, 1.0 / 1.05**0.5)
    bodies = (
        body("crank", None, (0.0, 0.0, 0.0)),
        body("pitch", "crank", (0.1, 0.0, 0.0), (0.0, 1.0, 0.0)),
        body("coupler", "pitch", (0.0, 0.0, 0.0)),
        body("rocker", None, (0.45, 0.1, 0.05), tilted),
    )
    ball = LoopConstraint("ball", "ball", "coupler", "rocker", Placement((0.5, 0.0, 0.0)), Placement((0.3, 0.0, 0.0)))
    pose, assembly = Pose(joints=(("crank", 0.7),)), (("coupler", 0.0), ("rocker", 1.5))
    return Robot("ball_loop", bodies, (ball,), ("crank",), pose=pose, assembly=assembly)


def world_loop() -> Robot:
    """The rocker of a four-bar turns on a pin of the world that is not a joint of the tree; all about a tilted axis."""
    axis = (0.0, 0.6, 0.8)
    bodies = (
        body("crank", None, (0.0, 0.0, 0.0), axis),
        body("coupler", "crank", (0.15, 0.0, 0.0), axis),
        body("rocker", "coupler", (0.3, 0.0, 0.0), axis),
    )
    ends = Placement((0.25, 0.0, 0.0)), Placement((0.3, 0.0, 0.0))
    pin = LoopConstraint("pin", "revolute", "rocker", None, *ends, axis)
    assembly = (("coupler", 0.3), ("rocker", -2.0))
    return Robot("world_loop", bodies, (pin,), ("crank",), pose=Pose(joints=(("crank", 0.7),)), assembly=assembly)


def spatial_loop() -> Robot:
    """Seven joints in a row whose last link turns on a pin of the world: both points of the pin are needed."""
    axes = ((0.0, 0.0, 1.0), (0.8, 0.0, 0.6), (0.0, 1.0, 0.0), (0.6, 0.8, 0.0), (1.0, 0.0, 0.0), (0.0, 0.6, 0.8))
    axes = (*axes, (0.8, 0.6, 0.0))
    bodies = tuple(
        body(f"b{i}", f"b{i - 1}" if i else None, (0.1, 0.05 * (-1) ** i, 0.2), axis) for i, axis in enumerate(axes)
    )
    names = tuple(b.name for b in bodies)
    origins, rotations = Model(Robot("row", bodies, (), names)).body_poses(np.zeros(7))
    point, turn = np.array([0.1, 0.2, 0.3]), rotations[-1]
    at = Placement(tuple(origins[-1] + turn @ point), tuple(map(tuple, turn)))
    pin = LoopConstraint("pin", "revolute", "b6", None, Placement(tuple(point)), at, (0.6, 0.0, 0.8))
    return Robot("spatial_loop", bodies, (pin,), ("b3", "b4"))


MADE = {"slider_crank": slider_crank, "ball_loop": ball_loop, "world_loop": world_loop, "spatial_loop": spatial_loop}
SHIPPED = ("tello", "cassie", "four_bar", "six_bar", "planar_leg_linkage")
# The diagonal of the reflected inertia varies with the pose:
VARYING = ("tello", "cassie", "slider_crank")
CASES = [
    pytest.param(name, level, id=f"{name}-{level}")
    for name in (*SHIPPED, *MADE)
    for level in LEVELS
    if not (name in VARYING and level == "armature")
]


def robot_called(name: str) -> Robot:
    return MADE[name]() if name in MADE else load_robot(name)


def states(model: Model, count: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random states around the reference pose, and forces."""
    rng = np.random.default_rng(3)
    q = model.standing_q + rng.uniform(-0.15, 0.15, (count, model.nq))
    if model.robot.floating:
        q[:, 3:7] = rng.normal(size=(count, 4))
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    return q, rng.normal(0, 2, (count, model.nv)), rng.normal(0, 5, (count, model.nv))


class Peer:
    """MuJoCo's compiled model, with joints addressed as in our spanning coordinates."""

    def __init__(self, robot: Robot, level: str) -> None:
        import mujoco

        from ce_gym.export.mujoco_coordinates import joint_rows
        from ce_gym.export.mujoco_model import load

        self.mujoco, self.model = mujoco, load(robot, level)
        self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.data, self.floating = mujoco.MjData(self.model), robot.floating
        rows = joint_rows(self.model)
        self.joints = [*rows][1 if robot.floating else 0 :]
        spanning = [b.name for b in robot.bodies if b.joint.type != "free"]
        self.columns = [spanning.index(name) for name in self.joints]
        self.scales = np.ones(len(self.joints))
        for i, (name, tie) in enumerate((name, joint_ties(build_mechanism(robot))[name]) for name in self.joints):
            if robot.body(name).kind == "rotor" and self.model.dof_armature[rows[name][1]]:
                self.scales[i] = max(map(abs, tie.ratios.values()))

    def rotation(self, q):
        matrix = np.empty(9)
        self.mujoco.mju_quat2Mat(matrix, q[3:7])
        return matrix.reshape(3, 3)

    def positions(self, q_span):
        joints = q_span[7 * self.floating :][self.columns] / self.scales
        return np.concatenate([q_span[:7], joints]) if self.floating else joints

    def rates(self, q, x_span, product=0.0):
        """Velocities or forces: base linear part first, in the world."""
        if not self.floating:
            return x_span[self.columns] / self.scales
        linear = self.rotation(q) @ (x_span[3:6] + product)
        return np.concatenate([linear, x_span[:3], x_span[6:][self.columns] / self.scales])

    def rows(self, qpos):
        """The equalities at a configuration: violation [m or rad], and Jacobian."""
        self.data.qpos[:] = qpos
        self.mujoco.mj_fwdPosition(self.model, self.data)
        kept = self.data.efc_type[: self.data.nefc] == self.mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return self.data.efc_pos[kept].copy(), self.data.efc_J.reshape(-1, self.model.nv)[: self.data.nefc][kept].copy()

    def moved(self, qpos, qvel, dt):
        qpos = qpos.copy()
        self.mujoco.mj_integratePos(self.model, qpos, qvel, dt)
        return qpos

    def acceleration(self, qpos, qvel, tau, freedoms):
        """Solve `M a + h = tau + J^T f, J a + Jdot v = 0`, redundant rows and all."""
        h = 2e-4
        at = {s: self.rows(self.moved(qpos, qvel, s * h))[1] @ qvel for s in (-2, -1, 1, 2)}
        product = (at[-2] - 8 * at[-1] + 8 * at[1] - at[2]) / (12 * h)  # Jdot v, to fourth order
        violation, J = self.rows(qpos)
        assert np.abs(violation).max() < 1e-12
        assert np.abs(J @ qvel).max() < 1e-10 * max(1.0, np.abs(qvel).max())
        self.data.qvel[:] = qvel
        self.mujoco.mj_forward(self.model, self.data)
        M = np.zeros((self.model.nv, self.model.nv))
        self.mujoco.mj_fullM(self.model, self.data, M)
        met = np.linalg.lstsq(J, -product, rcond=1e-8)[0]
        _, singular, right = np.linalg.svd(J)
        free = right[int((singular > 1e-8 * singular[0]).sum()) :].T
        assert free.shape[1] == freedoms
        force = free.T @ (tau - self.data.qfrc_bias - M @ met)
        return met + free @ np.linalg.solve(free.T @ M @ free, force)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "level"), CASES)
def test_mujoco_has_the_same_dynamics(name, level):
    """With forces on all joints that MuJoCo has, dependent ones and rotors too; ours come through `actuator_matrix`."""
    pytest.importorskip("mujoco")
    robot = robot_called(name)
    model, peer = Model(robot, level), Peer(robot, level)
    base = 6 if robot.floating else 0
    for q, v, tau in zip(*states(model), strict=True):
        q_span, v_span = model.spanning(q, v)
        effort = np.random.default_rng(4).normal(0, 2, len(peer.joints))
        on_joints = np.zeros(len(v_span))
        on_joints[[*range(base), *(base + i for i in peer.columns)]] = [*tau[:base], *(effort * peer.scales**2)]
        ours = model.actuator_matrix(q, peer.joints).T @ effort
        ours[:base] += tau[:base]
        vdot = model.spanning_acceleration(q, v, model.forward_dynamics(q, v, ours))
        expected = peer.rates(q, vdot, np.cross(v[:3], v[3:6]) if base else 0.0)
        found = peer.acceleration(
            peer.positions(q_span), peer.rates(q, v_span), peer.rates(q, on_joints), freedoms=model.nv
        )
        assert np.abs(found - expected).max() <= TOLERANCE * max(1.0, np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize(("name", "level"), CASES)
def test_round_trip(name, level, tmp_path):
    """Exported and imported again: the same forward dynamics."""
    pytest.importorskip("mujoco")
    original = robot_called(name)
    (tmp_path / "robot.xml").write_text(to_mjcf(original, level, ground=original.floating))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = load_robot(tmp_path / "robot.xml")
    assert set(robot.independent) == set(original.independent)
    ours, theirs = Model(original, level), Model(robot, level)
    assert len(theirs.guess) == len(ours.guess), "what is closed by a formula stays so"
    base = (7, 6) if original.floating else (0, 0)
    order = [original.independent.index(name) for name in robot.independent]
    to_q, to_v = ([*range(n), *(n + i for i in order)] for n in base)
    for q, v, tau in zip(*states(ours), strict=True):
        vdot = ours.forward_dynamics(q, v, tau)[to_v]
        again = theirs.forward_dynamics(q[to_q], v[to_v], tau[to_v])
        assert np.abs(again - vdot).max() <= TOLERANCE * max(1.0, np.abs(vdot).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SHIPPED, *MADE])
def test_the_file_starts_assembled(name):
    """MuJoCo's initial configuration and the keyframe are our reference pose, loops closed, coordinates and all."""
    mujoco = pytest.importorskip("mujoco")
    robot = robot_called(name)
    model, peer = Model(robot), Peer(robot, "exact")
    q_span, _ = model.spanning(model.standing_q, np.zeros(model.nv))
    mujoco.mj_resetDataKeyframe(peer.model, peer.data, 0)
    np.testing.assert_allclose(peer.data.qpos, peer.positions(q_span), atol=1e-12)
    for qpos in (peer.model.qpos0, peer.data.qpos.copy()):
        assert np.abs(peer.rows(qpos)[0]).max() < 1e-12
    pose = standing_pose(model.mechanism).q
    assert [pose[joint] for joint in model.spanning_names] == pytest.approx(q_span[7 * robot.floating :], abs=1e-12)


@pytest.mark.parametrize(("name", "level"), [("four_bar", "exact"), ("slider_crank", "exact"), ("tello", "coupled")])
def test_mujoco_moves_as_we_do(name, level):
    """A tenth of a second without control: MuJoCo's soft equalities hold, and the joints move where ours do."""
    mujoco = pytest.importorskip("mujoco")
    from ce_gym.export.mujoco_coordinates import joint_rows

    robot = dataclasses.replace(robot_called(name), contacts=())
    model = Model(robot, level)
    dt, steps = 2e-4, 500
    peer = mujoco.MjModel.from_xml_string(
        to_mjcf(robot, level, timestep=dt, solref=(2 * dt, 1.0), solimp=STIFF["solimp"])
    )
    peer.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    data = mujoco.MjData(peer)
    mujoco.mj_resetDataKeyframe(peer, data, 0)
    base = (7, 6) if robot.floating else (0, 0)
    q, v = model.standing_q.copy(), np.zeros(model.nv)
    v[base[1] :] = np.linspace(0.5, 1.0, model.nv - base[1])
    _, v_span = model.spanning(q, v)
    rows = joint_rows(peer)
    for i, joint in enumerate(model.spanning_names):
        if joint in rows:
            data.qvel[rows[joint][1]] = v_span[base[1] + i]
    start = q.copy()
    damping = np.array([robot.body(j).joint.damping for j in model.joint_links])
    for _ in range(steps):
        mujoco.mj_step(peer, data)
        tau = np.concatenate([np.zeros(base[1]), -damping * v[base[1] :]])
        v = v + dt * model.forward_dynamics(q, v, tau)
        q[base[0] :] += dt * v[base[1] :]
        if robot.floating:  # joints do not feel where a falling base is, only how it is turned
            q[3:7] += dt / 2 * np.array([-q[4:7] @ v[:3], *(q[3] * v[:3] + np.cross(q[4:7], v[:3]))])
            q[3:7] /= np.linalg.norm(q[3:7])
    theirs = np.array([data.qpos[rows[joint][0]] for joint in model.joint_links])
    travelled = np.abs(q - start)[base[0] :].max()
    assert travelled > 0.03
    assert np.abs(theirs - q[base[0] :]).max() < 0.02 * travelled
    equality = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    assert np.abs(data.efc_pos[: data.nefc][equality]).max() < 1e-3


def with_light_rotors(factor: float) -> Robot:
    """The slider crank with rotors that have no mass, behind gears whose ratios are larger by a factor."""
    robot, rotors = slider_crank(), ("motor", "wheel")
    bodies, ties = list(robot.bodies), list(robot.constraints)
    for i, each in enumerate(bodies):
        if each.name in rotors:
            inertia = tuple(tuple(x / factor**2 for x in row) for row in each.inertial.inertia)
            bodies[i] = dataclasses.replace(each, inertial=Inertial(0.0, (0.0, 0.0, 0.0), inertia))
    for i, tie in enumerate(ties):
        if isinstance(tie, LinearConstraint):
            pairs = tuple((name, x if name in rotors else factor * x) for name, x in tie.coefficients)
            ties[i] = LinearConstraint(tie.name, pairs, factor * tie.offset)
    return dataclasses.replace(robot, bodies=tuple(bodies), constraints=tuple(ties))


@pytest.mark.slow
@pytest.mark.parametrize("level", ["exact", "coupled"])
@pytest.mark.parametrize("factor", [30.0, 100.0, 1e5, 1e7])
def test_rotors_too_light_for_mujoco_keep_their_reflected_inertia(factor, level, tmp_path):
    """What they couple to their carrier besides goes with 1 / ratio; the file holds it up to 1 / 1e5."""
    pytest.importorskip("mujoco")
    robot = with_light_rotors(factor)
    model, peer = Model(robot, level), Peer(robot, level)
    (tmp_path / "robot.xml").write_text(to_mjcf(robot, level, ground=False))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        again = Model(load_robot(tmp_path / "robot.xml"), level)
    tolerance = 1e-5 if level == "exact" else 1e-9
    for q, v, tau in zip(*states(model), strict=True):
        vdot = model.forward_dynamics(q, v, tau)
        assert np.abs(again.forward_dynamics(q, v, tau) - vdot).max() <= tolerance * max(1.0, np.abs(vdot).max())
        q_span, v_span = model.spanning(q, v)
        force = np.zeros(len(v_span))
        force[[model.spanning_names.index(name) for name in robot.independent]] = tau
        theirs = peer.acceleration(peer.positions(q_span), peer.rates(q, v_span), peer.rates(q, force), 2)
        ours = peer.rates(q, model.spanning_acceleration(q, v, vdot))
        kept = [i for i, name in enumerate(peer.joints) if robot.body(name).kind == "link"]
        assert np.abs(theirs - ours)[kept].max() <= tolerance * max(1.0, np.abs(ours[kept]).max())


def test_loops_are_connects_and_rods_are_spatial_tendons():
    root = ET.fromstring(to_mjcf(load_robot("four_bar"), **STIFF))
    assert [e.get("name") for e in root.findall("equality/connect")] == ["pin_1", "pin_2"]
    assert all(e.get("solref") == "0.002 1.0" for e in root.find("equality"))
    assert len(ET.fromstring(to_mjcf(ball_loop())).findall("equality/connect")) == 1
    root = ET.fromstring(to_mjcf(slider_crank()))
    rods = root.findall("tendon/spatial")
    assert [[site.get("site") for site in rod] for rod in rods] == [
        ["push_first", "push_second"],
        ["link_first", "link_second"],
    ]
    assert [e.get("tendon1") for e in root.findall("equality/tendon")] == ["motor", "push", "link"]


def test_rotors_inside_loops_are_armature_of_dependent_joints():
    root = ET.fromstring(to_mjcf(slider_crank(), "coupled"))
    armature = {joint.get("name"): joint.get("armature") for joint in root.iter("joint") if joint.get("armature")}
    assert armature == {"slider": repr(30.0**2 * 2e-3), "motor": repr(2e-3 * 20.0**2)}, (
        "two branches drive the motor: it stays"
    )
    assert "wheel" not in {element.get("name") for element in root.iter("body")}
    root = ET.fromstring(to_mjcf(load_robot("tello"), "coupled"))
    belts = root.findall("tendon/fixed")
    assert [belt.get("name") for belt in belts] == [
        f"{s}-knee-ankle-rotor-{i}" for s in ("left", "right") for i in "12"
    ]
    assert all(belt.get("armature") for belt in belts)
    assert not any("rotor" in element.get("name", "") for element in root.iter("body"))


def changed(i: int, **changes) -> dict:
    """The slider-crank with one of its constraints changed."""
    ties = slider_crank().constraints
    return {"constraints": (*ties[:i], dataclasses.replace(ties[i], **changes), *ties[i + 1 :])}


CAM = FunctionConstraint("cam", "export_cam", ("crank",), ("slider",))


@pytest.mark.parametrize(
    ("change", "level", "message"),
    [
        (
            {},
            "armature",
            "reflects from rotor 'motor' through 'slider' varies: expected transmission 'exact', 'coupled'",
        ),
        (
            {"constraints": (CAM, *slider_crank().constraints[1:])},
            "exact",
            "'cam' is of a kind that MJCF does not have",
        ),
        (
            {"independent": ("swing", "wheel")},
            "coupled",
            "rotor 'wheel', which 'coupled' omits, is an independent",
        ),
        (changed(0, first="wheel"), "none", "constraint 'push' ends on rotor 'wheel', which 'none' omits"),
        (changed(1, length=9.0), "exact", "tied by .*link.*, does not close at the standing pose, "),
        ({"constraints": slider_crank().constraints[:3]}, "exact", "do not determine"),
    ],
)
def test_errors_are_one_line(change, level, message):
    register_constraint("export_cam", lambda q: [0.1 * q[0]])
    with pytest.raises(RobotError, match=message) as caught:
        to_mjcf(dataclasses.replace(slider_crank(), **change), level)
    assert "\n" not in str(caught.value)
