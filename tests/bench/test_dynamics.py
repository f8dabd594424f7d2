"""Functions of Pinocchio in the benchmark of dynamics are those of `Model`, and the benchmark has a row for each."""

import argparse

import numpy as np
import pytest

pin = pytest.importorskip("pinocchio")
pytest.importorskip("numba")

from ce_gym import Model  # noqa: E402
from ce_gym.bench.peers import pinocchio  # noqa: E402
from ce_gym.bench.speed import competitors, dynamics  # noqa: E402
from ce_gym.model import load_robot  # noqa: E402


def test_functions_of_pinocchio():
    robot = load_robot("mini_cheetah")
    peer = pinocchio.load(robot)
    dynamics.add_frame(peer)
    frame, model = peer.names[-1], Model(robot, "armature")
    q, v, tau, _ = (rows[0] for rows in competitors.random_states(model, 1).values())
    state = peer.positions(q), peer.velocities(v), peer.velocities(tau)
    found = {what: call(peer.model, peer.model.createData(), *state) for what, (_, call) in dynamics.QUANTITIES.items()}
    M, J, A = (found[what] for what in ("mass matrix", "frame Jacobian", "centroidal momentum matrix"))
    half = np.r_[3:6, 0:3]  # linear first
    for ours, theirs in (
        (model.forward_dynamics(q, v, tau), peer.accelerations(found["forward dynamics"])),
        (peer.velocities(model.inverse_dynamics(q, v, tau)), found["inverse dynamics"]),
        (peer.velocities(model.mass_matrix(q) @ v), M @ state[1]),
        (model.frame_velocity(q, v, frame), (J @ state[1])[half]),
        (model.centroidal_momentum(q, v), (A @ state[1])[half]),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.slow
def test_the_benchmark_of_dynamics():
    report = dynamics.run(argparse.Namespace(robot="mini_cheetah", rounds=1))
    assert len(report.tables[0].rows) == len(dynamics.QUANTITIES) * len(dynamics.LEVELS)
    assert len(report.requirements) == len(dynamics.LARGEST)
