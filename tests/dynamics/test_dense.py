"""Every quantity of every robot against dense numpy (dense.py) and, where it is installed, against Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest
from dense import Dense
from linkages import four_bar, rod_leg, spatial_four_bar
from pinocchio_peer import Peer

from ce_gym.dynamics import Model
from ce_gym.model import Robot, load_robot, robots

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

TOLERANCE = 1e-9
LINKAGES = {"crank-rocker": four_bar, "spatial four-bar": spatial_four_bar, "rod leg": rod_leg}
STATES = 6
ALIKE = ("go1", "go2", "anymal_c", "h1", "t1", "berkeley_humanoid", "tello_with_arms")
"""Robots with the structure of Mini Cheetah or of Tello; tests of their files check their figures."""

NARROW = {"dr_legs": 0.1}
"""How far from the standing pose loops close that a quarter of a radian opens [rad]."""
RATIOS = {"dr_legs": 1e-7}
"""Accuracy of the dense solution where rotors turn 353 times as fast as links: its null space mixes the two."""


class Case:
    """A robot at random states, and each state seen by dense numpy."""

    def __init__(self, robot: Robot) -> None:
        self.model = Model(robot)
        self.loops = self.model.loop_report() != ""
        rng, n = np.random.default_rng(11), self.model.nq
        spread = NARROW.get(robot.name, 0.25) if self.loops else 1.5
        self.q = self.model.standing_q + rng.uniform(-spread, spread, (STATES, n))
        if robot.floating:
            self.q[:, 3:7] = rng.normal(size=(STATES, 4))
            self.q[:, 3:7] /= np.linalg.norm(self.q[:, 3:7], axis=1, keepdims=True)
        self.v, self.tau = (rng.normal(0, size, (STATES, self.model.nv)) for size in (2.0, 5.0))
        self.vdot = rng.normal(0, 20, (STATES, self.model.nv))
        self.G, self.g = self.model.explicit_constraint(self.q, self.v)
        self.dense = [Dense(robot, *state) for state in zip(*self.model.spanning(self.q, self.v), strict=True)]

    def spanning_force(self, tau: np.ndarray) -> np.ndarray:
        """Put independent forces where they act, one state."""
        spread = np.zeros(self.G.shape[1])
        base = 6 if self.model.robot.floating else 0
        names = self.model.spanning_names
        spread[[*range(base), *(base + names.index(name) for name in self.model.joint_links)]] = tau
        return spread


@pytest.fixture(scope="module", params=[*sorted(set(robots()) - set(ALIKE)), *LINKAGES, "awkward"])
def case(request: pytest.FixtureRequest, awkward_robot) -> Case:
    if request.param == "awkward":
        return Case(awkward_robot(lopsided=1e-4))
    return Case(LINKAGES[request.param]() if request.param in LINKAGES else load_robot(request.param))


def assert_close(ours: np.ndarray, theirs: np.ndarray, tolerance: float = TOLERANCE) -> None:
    assert np.shape(ours) == np.shape(theirs)
    assert np.abs(ours - theirs).max(initial=0.0) <= tolerance * max(1.0, np.abs(theirs).max(initial=0.0))


@pytest.mark.slow
def test_kinematics(case: Case):
    positions, rotations = case.model.body_poses(case.q)
    angular, linear = case.model.body_velocities(case.q, case.v)
    for i, dense in enumerate(case.dense):
        bodies = [dense.bodies[name] for name in case.model.body_names]
        for ours, theirs in ((positions, "p"), (rotations, "R"), (angular, "w"), (linear, "v")):
            assert_close(ours[i], np.array([getattr(body, theirs) for body in bodies]), 1e-11)


def test_constraints(case: Case):
    """The rows that are kept say the same as all rows: met by every motion that the package allows, and enough."""
    K, k = case.model.implicit_constraint(case.q, case.v)
    spanning = case.model.nv + K.shape[1]
    assert K.shape == (STATES, spanning - case.model.nv, spanning)
    for i, dense in enumerate(case.dense):
        phi, K_all, k_all = dense.constraints()
        free = dense.free_directions()
        assert free.shape == case.G[i].shape
        assert_close(phi, 0 * phi, 1e-12)
        size = np.linalg.norm(K[i], axis=1).clip(1e-300)
        for rows, bias in ((K[i] / size[:, None], k[i] / size), (K_all, k_all)):
            assert_close(rows @ case.G[i] / np.abs(case.G[i]).max(), np.zeros((len(rows), case.model.nv)), 1e-11)
            assert_close(rows @ dense.v, 0 * bias)
            assert_close(rows @ case.g[i], bias)
            assert np.linalg.matrix_rank(rows, 1e-8) == spanning - case.model.nv


@pytest.mark.slow
def test_accelerations(case: Case):
    wrenches = {n: np.random.default_rng(i).normal(0, 5, 6) for i, n in enumerate(case.model.body_names)}
    free = case.model.forward_dynamics(case.q, case.v, case.tau)
    pushed = case.model.forward_dynamics(case.q, case.v, case.tau, wrenches)
    for vdot, pushes in ((free, {}), (pushed, wrenches)):
        ours = case.model.spanning_acceleration(case.q, case.v, vdot)
        for i, dense in enumerate(case.dense):
            tau = case.spanning_force(case.tau[i]) + dense.generalised(pushes)
            assert_close(ours[i], dense.acceleration(tau), RATIOS.get(case.model.robot.name, TOLERANCE))


@pytest.mark.slow
def test_forces(case: Case):
    M, bias = case.model.mass_matrix(case.q), case.model.bias_force(case.q, case.v)
    tau = case.model.inverse_dynamics(case.q, case.v, case.vdot)
    kinetic, potential = case.model.energy(case.q, case.v)
    for i, (dense, G, g) in enumerate(zip(case.dense, case.G, case.g, strict=True)):
        assert_close(M[i], G.T @ dense.M @ G)
        assert_close(bias[i], G.T @ (dense.M @ g + dense.h))
        assert_close(tau[i], G.T @ (dense.M @ (G @ case.vdot[i] + g) + dense.h))
        assert_close(np.array([kinetic[i], potential[i]]), np.array(dense.energy()))


def test_transmissions_neither_make_nor_lose_power(case: Case):
    """The constraint forces of each cluster have no power, whichever joints are driven."""
    drive = np.random.default_rng(12).normal(0, 5, case.G.shape[:2])
    vdot = case.model.forward_dynamics(case.q, case.v, np.einsum("bij,bi->bj", case.G, drive))
    accelerations = case.model.spanning_acceleration(case.q, case.v, vdot)
    for i, dense in enumerate(case.dense):
        ties = dense.M @ accelerations[i] + dense.h - drive[i]
        terms = np.abs(dense.M) @ np.abs(accelerations[i]) + np.abs(dense.h) + np.abs(drive[i])
        for cluster in case.model.cluster_tree.clusters:
            columns = [dense.columns[name] for name in cluster.bodies if name in dense.columns]
            power = ties[columns] @ dense.v[columns]
            assert abs(power) <= TOLERANCE * (terms[columns] @ np.abs(dense.v[columns]))
        error = dense.energy_rate(accelerations[i]) - drive[i] @ dense.v
        assert abs(error) <= TOLERANCE * (terms @ np.abs(dense.v))


def test_pinocchio(case: Case):
    """Spanning tree by Pinocchio, constraints by `G` and `g`."""
    pytest.importorskip("pinocchio")
    peer = Peer(case.model.robot)
    q_span, v_span = case.model.spanning(case.q, case.v)
    vdot = case.model.forward_dynamics(case.q, case.v, case.tau)
    tau = case.model.inverse_dynamics(case.q, case.v, case.vdot)
    for i, (G, g) in enumerate(zip(case.G, case.g, strict=True)):
        M, h = peer.dynamics(q_span[i], v_span[i])
        assert_close(vdot[i], np.linalg.solve(G.T @ M @ G, case.tau[i] - G.T @ (M @ g + h)))
        assert_close(tau[i], G.T @ peer.inverse_dynamics(q_span[i], v_span[i], G @ case.vdot[i] + g))
