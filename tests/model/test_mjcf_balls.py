"""Ball joints in MJCF: read in the tree and in loops, with MuJoCo's own equations; and written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_joints import moved, random_state, with_balls
from mjcf_files import lump, mjcf

from ce_gym.dynamics import Model
from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import load_robot

mujoco = pytest.importorskip("mujoco")
from ce_gym.export.mujoco_coordinates import Coordinates  # noqa: E402
from ce_gym.export.mujoco_twin import MujocoTwin  # noqa: E402

pytestmark = pytest.mark.filterwarnings("error::ce_gym.LossyImportWarning")

TREE = (
    f'<body name="trunk" pos="0 0 1"><freejoint/>{lump(5)}<body name="arm" pos=".1 .2 .3" euler=".1 .2 .3">'
    f'<joint name="shoulder" type="ball" pos=".05 .02 .01" damping="0.1" range="0 1.2"/>{lump()}'
    f'<body name="fore" pos=".3 0 0"><joint name="elbow" axis="0 1 0" ref="0.2"/>{lump(0.5)}'
    f'<body name="hand" pos=".2 0 .1"><joint name="twist" axis="1 0 0"/><joint name="wrist" type="ball" '
    f'pos=".05 .06 .01"/>{lump(0.2)}</body></body></body></body>'
)
KEY = '<keyframe><key qpos="0 0 1 1 0 0 0  .9 .1 .2 .1  .3  .1  1 0 0 .1"/></keyframe>'
# A four-bar in space: a rod with ball joints at both ends leads from a crank to a rocker about a skew axis.
FOUR_BAR = (
    f'<body name="crank"><joint name="crank" axis="0 1 0.2"/>{lump()}<body name="rod" pos="0 .05 .3">'
    f'<joint name="ball" type="ball"/>{lump(0.5)}</body></body>'
    f'<body name="rocker" pos=".6 .1 0"><joint name="rocker" axis=".1 1 0"/>{lump()}</body>'
)
ROUNDED = '<keyframe><key qpos="0.3 0.002 1 0.001 0 0 0.001"/></keyframe></mujoco>'
PIN = '<connect name="pin" body1="rod" body2="rocker" anchor=".62 .07 .1"/>'


class Beside:
    """A file in MuJoCo, moved as our bodies move."""

    def __init__(self, path):
        self.robot = load_robot(path)
        self.model, self.mj = Model(self.robot), mujoco.MjModel.from_xml_path(str(path))
        self.mj.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.data = mujoco.MjData(self.mj)

    def frame(self, body: int, q, v):
        """Rotation to the world and angular velocity of one of MuJoCo's bodies."""
        if not body:
            return np.eye(3), np.zeros(3)
        i = self.model.body_names.index(self.mj.body(body).name)
        return self.model.body_poses(q)[1][i], self.model.body_velocities(q, v)[0][i]

    def of(self, q, v):
        """MuJoCo's qpos and qvel."""
        (q_span, v_span), qpos, qvel = self.model.spanning(q, v), [], []
        for j in range(self.mj.njnt):
            body, kind = int(self.mj.jnt_bodyid[j]), self.mj.jnt_type[j]
            last = j == self.mj.body_jntadr[body] + self.mj.body_jntnum[body] - 1
            name = self.mj.body(body).name if last else self.mj.joint(j).name
            rows, speeds = self.robot.spanning_rows[name]
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                qpos += list(q_span[rows.start : rows.stop])
                R, spin = self.frame(body, q, v)
                qvel += [*(R @ v_span[3:6]), *(R.T @ spin)]
            elif kind == mujoco.mjtJoint.mjJNT_BALL and len(rows) == 4:
                qpos += list(q_span[rows.start : rows.stop])
                qvel += list(v_span[speeds.start : speeds.stop])
            elif kind == mujoco.mjtJoint.mjJNT_BALL:  # it has become hinges
                (R, spin), (R_p, spin_p) = (self.frame(b, q, v) for b in (body, int(self.mj.body_parentid[body])))
                home, turn = np.zeros(9), np.zeros(4)
                mujoco.mju_quat2Mat(home, self.mj.body_quat[body])
                mujoco.mju_mat2Quat(turn, (home.reshape(3, 3).T @ R_p.T @ R).ravel())
                qpos, qvel = [*qpos, *turn], [*qvel, *(R.T @ (spin - spin_p))]
            else:
                qpos, qvel = [*qpos, q_span[rows.start]], [*qvel, v_span[speeds.start]]
        return np.array(qpos), np.array(qvel)

    def compare(self, q, v, tau):
        """Our mass matrix and accelerations meet MuJoCo's equation of motion; returns the largest gap of loops."""
        h, ours = 1e-3, self.model
        self.data.qpos[:], self.data.qvel[:] = self.of(q, v)
        mujoco.mj_forward(self.mj, self.data)
        M = np.zeros((self.mj.nv, self.mj.nv))
        mujoco.mj_fullM(self.mj, self.data, M)
        T = np.stack([self.of(q, row)[1] for row in np.eye(ours.nv)], axis=1)
        np.testing.assert_allclose(T.T @ M @ T, ours.mass_matrix(q), atol=1e-12)
        steps = ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0))  # a central difference of fourth order
        drift = sum(w * self.of(moved(self.robot, q, s * h * v), v)[1] for s, w in steps) / (12 * h)
        motion = M @ (T @ ours.forward_dynamics(q, v, tau) + drift) + self.data.qfrc_bias
        np.testing.assert_allclose(T.T @ motion, tau, atol=1e-9)
        rows = self.data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        J = self.data.efc_J.reshape(-1, self.mj.nv)[: self.data.nefc][rows]
        np.testing.assert_allclose(J @ T, 0, atol=1e-12)
        return np.abs(self.data.efc_pos[rows]).max(initial=0.0)


def test_balls_of_a_tree(write):
    text = mjcf(TREE).replace("</mujoco>", f"{KEY}</mujoco>")
    beside = Beside(write(text))
    robot = beside.robot
    assert robot.balls == ("arm", "hand")
    assert robot.independent == ("fore", "twist")
    assert robot.body("arm").joint.position == (-np.inf, 1.2)
    assert robot.body("arm").joint.damping == 0.1
    turn = np.array(dict(robot.pose.balls)["arm"])
    np.testing.assert_allclose(turn, np.array([0.9, 0.1, 0.2, 0.1]) / np.linalg.norm([0.9, 0.1, 0.2, 0.1]))
    for seed in range(2):
        beside.compare(*random_state(robot, seed), np.linspace(-1, 1, beside.model.nv))


def test_a_rod_with_balls_at_both_ends_closes_a_loop(write):
    beside = Beside(write(mjcf(FOUR_BAR, equality=PIN)))
    robot = beside.robot
    assert robot.independent == ("crank", "rod"), "the rod spins as it likes"
    assert [body.name for body in robot.bodies] == ["crank", "rod_swing_1", "rod_swing_2", "rod", "rocker"]
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, v = np.array([0.3, 2.0]) * rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2)
        assert beside.compare(q, v, rng.uniform(-1, 1, 2)) < 1e-12
        assert beside.model.loop_gap(q) < 1e-12


def test_the_gap_of_a_rounded_pose_moves_no_joint_that_the_loop_does_not(write):
    """The joint that carries the loop stays independent, and the spring before the hinge without one."""
    turret = f'<body name="turret"><joint name="turret" axis="0 0 1"/>{lump()}{FOUR_BAR}</body>'
    sprung = turret.replace('name="rocker" axis', 'name="rocker" stiffness="5" axis')
    for file, independent in ((turret, ("turret", "crank", "rod")), (sprung, ("turret", "rod", "rocker"))):
        text = mjcf(file, equality=PIN).replace("</mujoco>", ROUNDED)
        assert load_robot(write(text)).independent == independent


def test_balls_are_written(tmp_path):
    robot = with_balls(True, damping=0.1, position=(-np.inf, 1.0))
    text = to_mjcf(robot, "exact")
    (tmp_path / "robot.xml").write_text(text)
    model, back = Model(robot), Model(load_robot(tmp_path / "robot.xml"))
    mj, (q, v) = mujoco.MjModel.from_xml_string(text), random_state(robot, 0)
    coordinates, data = Coordinates.of(mj, robot), mujoco.MjData(mj)
    T = coordinates.velocity_map(q)
    data.qpos[:], data.qvel[:] = coordinates.positions(q), T @ v
    mujoco.mj_forward(mj, data)
    M = np.zeros((mj.nv, mj.nv))
    mujoco.mj_fullM(mj, data, M)
    np.testing.assert_allclose(T.T @ M @ T, model.mass_matrix(q), atol=1e-9)
    bias = T.T @ (data.qfrc_bias + M @ coordinates.velocity_product(q, v))
    np.testing.assert_allclose(bias, model.bias_force(q, v), atol=1e-9)
    np.testing.assert_allclose(back.mass_matrix(q), model.mass_matrix(q), atol=1e-9)
    balls = [replace(b.joint, name="") for b in back.robot.bodies if b.joint.type == "ball"]
    assert balls == [robot.body("a").joint] * 3
    twin = MujocoTwin(robot, "armature", 1)
    twin.start(q[None], v[None])
    np.testing.assert_allclose(np.concatenate(twin.state(), axis=1)[0], np.concatenate([q, v]), atol=1e-12)
