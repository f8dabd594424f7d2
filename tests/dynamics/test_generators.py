"""The paper's scaling chains against the paper authors' C++ library, tests/data/vectors."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import Pose, Robot
from ce_gym.model import generators as g

DATA = Path(__file__).parents[1] / "data" / "vectors"
TOLERANCE = 1e-10
LINEAR = {
    "bench_revolute_rotor_b2_d3": g.link_and_rotor_chain(2, 3),
    "bench_revolute_rotor_pair_b2_d2": g.belt_pair_chain(2, 2),
    "parallel_explicit_d5_l4": g.transmission_parallel_chain(5, 4),
    "parallel_explicit_d10_l12": g.transmission_parallel_chain(10, 12),
}
LOOPS = {
    "bench_four_bar_b2_d2": g.four_bar_chain(2, 2),
    "parallel_implicit_d5_l5": g.rod_parallel_chain(5, 5),
}


class Reference:
    """Reference states in the order of our coordinates.

    Parallel chains have the library's names. Branched chains are numbered differently there, but list their bodies
    in the same order. Which of the library's joints are independent is read off the velocities: they are equal.
    """

    def __init__(self, name: str, robot: Robot) -> None:
        data = json.loads((DATA / f"{name}.json").read_text())
        self.states = data["states"]
        theirs, ours = data["spanning_joint_order"], [body.name for body in robot.bodies]
        self.names = ours if robot.floating else theirs
        assert len(theirs) == len(ours)
        first = 6 if robot.floating else 0
        self.joints = [name for name in self.names if robot.body(name).joint.type != "free"]
        v_span, yd = self["v_span"][:, first:], self["yd"][:, first:]
        order = [self.joints[int(np.argmin(np.abs(v_span - column[:, None]).max(axis=0)))] for column in yd.T]
        assert sorted(order) == sorted(robot.independent)
        self.columns = [*range(first), *(first + order.index(joint) for joint in robot.independent)]
        self.q = self["q_span"][
            :, [*range(first and 7), *((first and 7) + self.joints.index(j) for j in robot.independent)]
        ]

    def __getitem__(self, key: str) -> np.ndarray:
        return np.array([state[key] for state in self.states])

    def assembled(self, robot: Robot, state: int) -> Robot:
        """The robot put together as in one state: reference states lie on either branch of a loop."""
        angles = dict(zip(self.joints, self["q_span"][state, 7 if robot.floating else 0 :], strict=True))
        free = tuple((joint, float(angles[joint])) for joint in robot.independent)
        tied = tuple((joint, float(angle)) for joint, angle in angles.items() if joint not in robot.independent)
        return dataclasses.replace(robot, pose=Pose(joints=free), assembly=tied)

    def independent(self, key: str) -> np.ndarray:
        """A quantity of the independent coordinates, in our order, shape (n_states, nv)."""
        return self[key][:, self.columns]


def relative_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / max(1.0, np.abs(theirs).max()))


@pytest.mark.parametrize("eliminate", [True, False], ids=["eliminated", "general"])
@pytest.mark.parametrize("name", LINEAR)
def test_forward_and_inverse_dynamics(name: str, eliminate: bool):
    reference, model = Reference(name, LINEAR[name]), Model(LINEAR[name], eliminate_rotors=eliminate)
    v = reference.independent("yd")
    assert len(v) == 10
    ydd = model.forward_dynamics(reference.q, v, reference.independent("tau"))
    assert relative_error(ydd, reference.independent("ydd")) < TOLERANCE
    tau = model.inverse_dynamics(reference.q, v, reference.independent("id_ydd"))
    assert relative_error(tau, reference.independent("id_tau")) < TOLERANCE


@pytest.mark.parametrize("name", LOOPS)
def test_closed_loops(name: str):
    """One four-bar state is 0.006 rad away from a singularity, where the error is 2e-11; elsewhere it is 1e-14."""
    robot = LOOPS[name]
    reference = Reference(name, robot)
    keys = ("yd", "tau", "ydd", "id_ydd", "id_tau")
    v, tau, ydd, id_ydd, id_tau = (reference.independent(key) for key in keys)
    assert len(v) == 10
    for i, q in enumerate(reference.q):
        model = Model(reference.assembled(robot, i))
        assert relative_error(model.forward_dynamics(q, v[i], tau[i]), ydd[i]) < TOLERANCE
        assert relative_error(model.inverse_dynamics(q, v[i], id_ydd[i]), id_tau[i]) < TOLERANCE


@pytest.mark.parametrize(
    "robot", [g.four_bar_chain(1, 2), *map(g.rod_parallel_chain, (3, 3), (3, 7))], ids=lambda r: r.name
)
def test_standing_pose_closes_the_loops(robot: Robot):
    model = Model(robot)
    positions, rotations = model.body_poses(model.standing_q)
    for loop in robot.constraints:
        first, second = (model.body_names.index(body) for body in (loop.first, loop.second))
        ends = [
            positions[body] + rotations[body] @ np.array(placement.position)
            for body, placement in ((first, loop.first_placement), (second, loop.second_placement))
        ]
        np.testing.assert_allclose(*ends, atol=1e-12)
    assert np.linalg.cond(model.mass_matrix(model.standing_q)) < 1e6
