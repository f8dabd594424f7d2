"""Frames, momentum, Coriolis matrices, regressors and moves of configurations against Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest
from ball_joints import random_state, with_balls
from linkages import four_bar, rod_leg
from pinocchio_peer import Peer

from ce_gym.dynamics import Model
from ce_gym.model import Robot, load_robot, robots

pin = pytest.importorskip("pinocchio")
pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

Array = np.ndarray
BUILT = {"balls": lambda: with_balls(True), "four_bar": four_bar, "rod_leg": rod_leg}
QUICK = ("go1", "mini_cheetah", "tello", "mit_humanoid_leg")
NARROW = {"dr_legs": 0.05}
ALIGNED = pin.LOCAL_WORLD_ALIGNED
SWAP = [3, 4, 5, 0, 1, 2]
"""Pinocchio's [linear; angular]."""


class Case:
    """A robot at a random state, and its spanning tree in Pinocchio with the constraints' `G` and `g`."""

    def __init__(self, robot: Robot) -> None:
        self.model, self.peer, layout = Model(robot), Peer(robot), robot.layout
        rng, spread = np.random.default_rng(2), NARROW.get(robot.name, 0.25)
        self.q = self.model.standing_q + rng.uniform(-spread, spread, layout.nq)
        for i, _ in layout.turns:
            self.q[i : i + 4] = rng.normal(size=4)
            self.q[i : i + 4] /= np.linalg.norm(self.q[i : i + 4])
        self.v, self.vdot = rng.normal(0, 1.5, (2, layout.nv))
        self.G, self.g = self.model.explicit_constraint(self.q, self.v)
        span = self.model.spanning(self.q, self.v)
        vdot_span = self.G @ self.vdot + self.g
        self.theirs = self.peer._theirs(*span, vdot_span, self.g)
        self.frames = []
        for frame in robot.frames:
            joint, placement = self.peer.joints[frame.body], frame.placement
            place = pin.SE3(np.array(placement.rotation), np.array(placement.position))
            self.frames.append(
                self.peer.model.addFrame(pin.Frame(f"{frame.name} frame", joint, place, pin.FrameType.OP_FRAME))
            )
        self.peer.data = self.peer.model.createData()

    def columns(self, matrix: Array) -> Array:
        """Columns of Pinocchio's velocities in the order of spanning velocities."""
        return matrix[:, self.peer.velocities]


@pytest.fixture(
    scope="module",
    params=[*BUILT, *QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in robots() if name not in QUICK)],
)
def case(request: pytest.FixtureRequest) -> Case:
    return Case(BUILT[request.param]() if request.param in BUILT else load_robot(request.param))


def assert_close(ours: Array, theirs: Array, tolerance: float = 1e-10) -> None:
    assert np.shape(ours) == np.shape(theirs)
    assert np.abs(ours - theirs).max(initial=0.0) <= tolerance * max(1.0, np.abs(theirs).max(initial=0.0))


def test_frames(case: Case):
    model, peer, (q, v, _, g) = case.model, case.peer.model, case.theirs
    pin.forwardKinematics(peer, case.peer.data, q, v, g)
    pin.computeJointJacobians(peer, case.peer.data, q)
    pin.updateFramePlacements(peer, case.peer.data)
    for frame, index in zip(model.robot.frames, case.frames, strict=True):
        position, rotation = model.frame_pose(case.q, frame.name)
        assert_close(position, case.peer.data.oMf[index].translation)
        assert_close(rotation, case.peer.data.oMf[index].rotation)
        J = case.columns(pin.getFrameJacobian(peer, case.peer.data, index, ALIGNED))[SWAP]
        assert_close(model.frame_jacobian(case.q, frame.name), J @ case.G)
        bias = pin.getFrameClassicalAcceleration(peer, case.peer.data, index, ALIGNED)
        assert_close(model.frame_bias_acceleration(case.q, case.v, frame.name), bias.vector[SWAP])


def test_bodies(case: Case):
    model, peer, (q, v, _, g) = case.model, case.peer.model, case.theirs
    pin.forwardKinematics(peer, case.peer.data, q, v, g)
    pin.computeJointJacobians(peer, case.peer.data, q)
    for name in model.body_names[:: max(1, len(model.body_names) // 6)]:
        joint = case.peer.joints[name]
        J = case.columns(pin.getJointJacobian(peer, case.peer.data, joint, ALIGNED))[SWAP]
        assert_close(model.frame_jacobian(case.q, name), J @ case.G)
        bias = pin.getClassicalAcceleration(peer, case.peer.data, joint, ALIGNED)
        assert_close(model.frame_bias_acceleration(case.q, case.v, name), bias.vector[SWAP])


def test_momentum(case: Case):
    model, peer, data, (q, v, _, g) = case.model, case.peer.model, case.peer.data, case.theirs
    A = case.columns(pin.computeCentroidalMap(peer, data, q))[SWAP] @ case.G
    assert_close(model.centroidal_momentum_matrix(case.q), A)
    assert_close(model.center_of_mass_jacobian(case.q), case.columns(pin.jacobianCenterOfMass(peer, data, q)) @ case.G)
    assert_close(
        model.centroidal_momentum(case.q, case.v), pin.computeCentroidalMomentum(peer, data, q, v).vector[SWAP]
    )
    pin.computeCentroidalMomentumTimeVariation(peer, data, q, v, g)
    assert_close(model.centroidal_momentum_bias(case.q, case.v), data.dhg.vector[SWAP])
    pin.centerOfMass(peer, data, q, v, g)
    assert_close(model.center_of_mass(case.q), data.com[0])
    assert_close(model.center_of_mass_bias_acceleration(case.q, case.v), data.acom[0])


def test_forces(case: Case):
    model, peer, data, (q, v, a, _) = case.model, case.peer.model, case.peer.data, case.theirs
    gravity = pin.computeGeneralizedGravity(peer, data, q)[case.peer.velocities]
    assert_close(model.gravity_force(case.q), case.G.T @ gravity)
    Y = pin.computeJointTorqueRegressor(peer, data, q, v, a)[case.peer.velocities]
    order = [case.peer.joints[name] - 1 for name in model.body_names]
    blocks = Y.reshape(len(Y), -1, 10)[:, order].reshape(len(Y), -1)
    assert_close(model.inertial_regressor(case.q, case.v, case.vdot), case.G.T @ blocks)
    inertias = [peer.inertias[i + 1] for i in order]
    assert_close(model.inertial_parameters, np.concatenate([x.toDynamicParameters() for x in inertias]))


@pytest.mark.parametrize("floating", [True, False])
def test_coriolis_matrix(floating: bool):
    """The same factorisation, base and ball joints included."""
    robot = with_balls(floating)
    model, peer = Model(robot), Peer(robot)
    q, v = random_state(robot, 4)
    C = pin.computeCoriolisMatrix(peer.model, peer.data, *peer._theirs(*model.spanning(q, v)))
    rows = [peer.velocities[i] for body in robot.rows for i in robot.spanning_rows[body][1]]
    assert_close(model.coriolis_matrix(q, v), C[np.ix_(rows, rows)])


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-9, 0.0])
def test_moves_of_configurations(size: float):
    robot = with_balls(True)
    model, peer = Model(robot), Peer(robot)
    for seed in range(3):
        (q, dv), (q_end, _) = random_state(robot, seed), random_state(robot, seed + 10)
        to_span = model.explicit_constraint(q, dv)[0]
        q_pin, dv_pin = peer._theirs(model.spanning(q, dv)[0], to_span @ (size * dv))
        expected = pin.integrate(peer.model, q_pin, dv_pin)
        moved = model.integrate(q, size * dv)
        assert_close(model.spanning(moved, dv)[0], expected[peer.positions], 1e-14)
        assert_close(model.difference(q, moved), size * dv, 1e-14)
        end_pin = peer._theirs(model.spanning(q_end, dv)[0])[0]
        apart = pin.difference(peer.model, q_pin, end_pin)[peer.velocities]
        assert_close(to_span @ model.difference(q, q_end), apart, 1e-12)
        np.testing.assert_allclose(np.abs(model.integrate(q, model.difference(q, q_end))), np.abs(q_end), atol=1e-12)
