"""DR Legs: three loops in each leg, all by formulas; MuJoCo's tree of the same links finds the same dynamics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from published import feet_above_ground

from ce_gym import LEVELS
from ce_gym.dynamics import Model
from ce_gym.envs.custom import missing
from ce_gym.model import load_robot
from ce_gym.model.constraints import LoopConstraint, RodConstraint
from ce_gym.sim import Simulator

mujoco = pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def robot():
    return load_robot("dr_legs")


def poses(model: Model, n: int) -> np.ndarray:
    """Random poses; those of the shanks side by side differ by less than what stretches the ankle out."""
    q = np.tile(model.standing_q, (n, 1))
    q[:, 7:] += np.random.default_rng(0).uniform(-0.08, 0.08, (n, q.shape[1] - 7))
    return q


def test_it_stands_flat_on_its_feet_and_has_what_tasks_need(robot):
    assert not missing(robot)
    assert robot.total_mass == pytest.approx(2.292148, abs=1e-6), "of the published file"
    lowest, highest = feet_above_ground(Model(robot))
    assert lowest == pytest.approx(0.0, abs=1e-6)
    assert highest < 1e-6
    assert len(robot.motors) == len(robot.driven) == 12


@pytest.mark.parametrize("level", LEVELS)
def test_loops_close_in_closed_form(robot, level):
    """No guess that would be a state; pins and rods of the file meet to rounding in random poses."""
    model = Model(robot, level)
    assert len(model.guess) == 0
    row = {name: i for i, name in enumerate(model.body_names)}
    loops = [tie for tie in robot.constraints if isinstance(tie, LoopConstraint | RodConstraint)]
    assert len(loops) == 10
    for q in poses(model, 20):
        p, R = model.body_poses(q)
        for tie in loops:
            if isinstance(tie, RodConstraint):
                ends = ((tie.first, tie.first_point), (tie.second, tie.second_point))
            else:
                ends = ((tie.first, tie.first_placement.position), (tie.second, tie.second_placement.position))
            first, second = (p[row[name]] + R[row[name]] @ np.array(at) for name, at in ends)
            length = tie.length if isinstance(tie, RodConstraint) else 0.0
            assert np.linalg.norm(second - first) == pytest.approx(length, abs=1e-12)


def test_outer_ankle_stays_at_one_point_of_the_foot(robot):
    """What the three rods stand for: a ball joint between the outer shank and the foot."""
    model = Model(robot)
    row = {name: i for i, name in enumerate(model.body_names)}
    tie = next(tie for tie in robot.constraints if tie.name == "left_ankle_width")
    seen = []
    for q in poses(model, 20):
        p, R = model.body_poses(q)
        centre = p[row[tie.second]] + R[row[tie.second]] @ np.array(tie.second_point)
        bracket, foot = row["left_bracket_b_inner"], row["left_foot"]
        axis = robot.body("left_foot").joint.axis
        seen.append([*(R[bracket].T @ (centre - p[bracket])), np.dot(R[foot].T @ (centre - p[foot]), axis)])
    assert np.ptp(seen, axis=0).max() < 1e-8  # published axes are rounded to eight digits


def test_mass_matrix_and_inverse_dynamics_are_those_of_mujocos_tree(robot):
    """MuJoCo reads the URDF, whose loops are open; ours at the level without rotors is its tree's, tied."""
    spec = mujoco.MjSpec.from_file(str(Path(robot.source).with_suffix(".urdf")))
    spec.body("pelvis").add_freejoint()
    theirs = spec.compile()
    data, model, rng = mujoco.MjData(theirs), Model(robot, "none"), np.random.default_rng(1)
    order = [model.spanning_names.index(theirs.joint(i).name.removesuffix("_joint")) for i in range(1, theirs.njnt)]
    for q in poses(model, 5):
        v, vdot = rng.normal(size=(2, model.nv))
        R = model.body_poses(q)[1][0]

        def spanning(v: np.ndarray, q: np.ndarray = q, R: np.ndarray = R) -> np.ndarray:
            return np.concatenate([R @ v[3:6], v[:3], model.spanning(q, v)[1][6:][order]])

        G = np.column_stack([spanning(column) for column in np.eye(model.nv)])
        data.qpos[:], data.qvel[:] = np.concatenate([q[:7], model.spanning(q, v)[0][7:][order]]), spanning(v)
        linear = R @ (vdot[3:6] + np.cross(v[:3], v[3:6]))
        data.qacc[:] = np.concatenate([linear, vdot[:3], model.spanning_acceleration(q, v, vdot)[6:][order]])
        mujoco.mj_inverse(theirs, data)
        M = np.zeros((theirs.nv, theirs.nv))
        mujoco.mj_fullM(theirs, data, M)
        ours = model.mass_matrix(q)
        np.testing.assert_allclose(ours, G.T @ M @ G, atol=1e-9 * np.abs(ours).max())
        force = model.inverse_dynamics(q, v, vdot)
        np.testing.assert_allclose(G.T @ data.qfrc_inverse, force, atol=1e-9 * np.abs(force).max())


@pytest.mark.slow
def test_it_stands_without_a_policy(robot):
    model = Model(robot)
    sim = Simulator(model, 4, outputs=("loop_gap",))
    q = np.tile(model.standing_q, (4, 1))
    q[1:, 7:] += np.random.default_rng(0).uniform(-0.03, 0.03, (3, 12))
    sim.set_state(q, np.zeros((4, model.nv)))
    sim.step(model.standing_q[7:], 1000)
    assert sim.q[:, 2].min() > 0.98 * model.standing_q[2]
    assert np.abs(sim.v).max() < 1e-3
    assert sim.loop_gap.max() < 1e-12
