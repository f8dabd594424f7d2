"""Frames, momentum and forces for controllers: identities, finite differences, and sums over bodies in plain numpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from ball_joints import moved, with_balls
from linkages import four_bar, rod_leg, spatial_four_bar

from ce_gym.dynamics import Model
from ce_gym.model import Frame, Inertial, Placement, Robot, load_robot, robots
from ce_gym.model.mechanism import LEVELS

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

Array = np.ndarray
BUILT = {
    "awkward": None,
    "tilted": None,
    "balls": lambda: with_balls(True),
    "four_bar": four_bar,
    "rod_leg": rod_leg,
    "spatial": spatial_four_bar,
}
QUICK = ("mini_cheetah", "tello", "mit_humanoid_leg", "planar_leg_linkage")
APPROXIMATED = ("mini_cheetah", "tello", "mit_humanoid_leg", "awkward", "four_bar")
CASES = [(name, "exact") for name in (*BUILT, *QUICK)]
CASES += [(name, level) for name in APPROXIMATED for level in LEVELS[1:]] + [("mini_cheetah", "elastic")]
OTHERS = [(name, level) for name in robots() for level in LEVELS if (name, level) not in CASES]
STATES = 3
NARROW = {"dr_legs": 0.05}


class Case:
    """A model at random states, its base turned and away from the origin, and frames of all kinds."""

    def __init__(self, robot: Robot, level: str) -> None:
        links = [body.name for body in robot.bodies if body.kind == "link"]
        pose = Placement((0.1, -0.2, 0.3), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        more = (Frame("sensor", links[-1], pose), Frame("marker", None, pose))
        self.model = Model(replace(robot, frames=(*robot.frames, *more)), level)
        rng, layout = np.random.default_rng(5), robot.layout
        spread = NARROW.get(robot.name, 0.25 if self.model.loop_report() else 1.0)
        self.q = self.model.standing_q + rng.uniform(-spread, spread, (STATES, self.model.nq))
        for i, _ in layout.turns:
            self.q[:, i : i + 4] = rng.normal(size=(STATES, 4))
            self.q[:, i : i + 4] /= np.linalg.norm(self.q[:, i : i + 4], axis=1, keepdims=True)
        self.v, self.vdot, self.tau = rng.normal(0, 1.5, (3, STATES, self.model.nv))
        rotors = [body.name for body in robot.rotors()][:1]
        contacts = self.model.contact_names[-1:]
        file_frames = [frame.name for frame in robot.frames][:1]
        self.frames = ["sensor", "marker", links[0], links[-1], *rotors, *contacts, *file_frames]

    def rate(self, quantity: Callable[[Array], Array], h: float = 1e-3) -> Array:
        """Time derivative of a quantity of positions as they move with `v`, by differences of fourth order."""
        total: Array = np.zeros(())
        for step, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
            there = [moved(self.model.robot, q, step * h * v) for q, v in zip(self.q, self.v, strict=True)]
            total = total + weight * quantity(np.array(there)) / (12 * h)
        return total


@pytest.fixture(
    scope="module",
    params=[*CASES, *(pytest.param(case, marks=pytest.mark.stress) for case in OTHERS)],
    ids=lambda case: "-".join(case),
)
def case(request: pytest.FixtureRequest, awkward_robot) -> Case:
    name, level = request.param
    if name in ("awkward", "tilted"):
        return Case(awkward_robot(lopsided=1e-4, tilted=2e-4 if name == "tilted" else 0.0), level)
    return Case(BUILT[name]() if name in BUILT else load_robot(name), level)


def assert_close(ours: Array, theirs: Array, tolerance: float = 1e-10) -> None:
    assert np.shape(ours) == np.shape(theirs)
    assert np.abs(ours - theirs).max(initial=0.0) <= tolerance * max(1.0, np.abs(theirs).max(initial=0.0))


def times(matrix: Array, x: Array) -> Array:
    return np.einsum("...ij,...j->...i", matrix, x)


def test_frames(case: Case):
    model, q, v = case.model, case.q, case.v
    for name in case.frames:
        position, rotation = model.frame_pose(q, name)
        velocity = model.frame_velocity(q, v, name)
        h = 0.01 / max(10.0, np.abs(velocity).max())  # rotors turn fast
        assert position.shape == (STATES, 3)
        assert_close(times(model.frame_jacobian(q, name), v), velocity)
        assert_close(velocity[:, 3:], case.rate(lambda x, name=name: model.frame_pose(x, name)[0], h), 1e-7)
        turning = case.rate(lambda x, name=name: model.frame_pose(x, name)[1], h) @ np.swapaxes(rotation, -1, -2)
        assert_close(velocity[:, :3], turning[:, (2, 0, 1), (1, 2, 0)], 1e-7)
        bias = model.frame_bias_acceleration(q, v, name)
        assert_close(bias, case.rate(lambda x, name=name: model.frame_velocity(x, v, name), h), 1e-7)
    assert_close(model.frame_pose(q, "marker")[0], np.broadcast_to([0.1, -0.2, 0.3], (STATES, 3)), 0.0)


def test_bodies_and_contacts_are_frames(case: Case):
    model, q, v = case.model, case.q, case.v
    places, velocities = model.body_poses(q), model.body_velocities(q, v)
    for i, name in enumerate(model.body_names[::5]):
        assert_close(model.frame_pose(q, name)[0], places[0][:, 5 * i])
        assert_close(model.frame_pose(q, name)[1], places[1][:, 5 * i])
        assert_close(model.frame_velocity(q, v, name), np.concatenate([x[:, 5 * i] for x in velocities], axis=-1))
    points, speeds = model.contact_points(q, v)
    for i, name in enumerate(model.contact_names[::5]):
        if name not in model.body_names and name not in [frame.name for frame in model.robot.frames]:
            assert_close(model.frame_pose(q, name)[0], points[:, 5 * i])
    J = model.contact_jacobian(q)
    assert J.shape == (STATES, len(model.contact_names), 3, model.nv)
    assert_close(np.einsum("bnij,bj->bni", J, v), speeds)
    bias = model.contact_bias_acceleration(q, v)
    assert_close(bias, case.rate(lambda x: model.contact_points(x, v)[1]), 1e-7)
    assert_close(np.einsum("bnij,bj->bni", J, case.vdot) + bias, model.contact_accelerations(q, v, case.vdot))
    names = model.contact_names[:3][::-1]
    chosen = [model.contact_names.index(name) for name in names]
    for found, expected in zip(model.contact_points(q, v, names), (points, speeds), strict=True):
        assert_close(found, expected[:, chosen], 1e-15)
    assert_close(model.contact_jacobian(q, names), J[:, chosen], 1e-15)
    assert_close(model.contact_bias_acceleration(q, v, names), bias[:, chosen], 1e-12)
    chosen_accelerations = model.contact_accelerations(q, v, case.vdot, names)
    assert_close(chosen_accelerations, model.contact_accelerations(q, v, case.vdot)[:, chosen], 1e-12)


def test_center_of_mass(case: Case):
    model, q, v = case.model, case.q, case.v
    positions, rotations = model.body_poses(q)
    masses = np.array([body.inertial.mass for body in model.robot.bodies])
    centers = positions + times(rotations, np.array([body.inertial.com for body in model.robot.bodies]))
    expected = np.einsum("i,bij->bj", masses, centers) / masses.sum()
    tilted = not model.mechanism.exact and "awkward" in model.robot.name  # its rotors stay at angle zero there
    assert_close(model.center_of_mass(q), expected, 1e-2 if tilted else 1e-12)
    velocity = model.center_of_mass_velocity(q, v)
    assert_close(velocity, case.rate(model.center_of_mass), 1e-7)
    assert_close(times(model.center_of_mass_jacobian(q), v), velocity)
    bias = model.center_of_mass_bias_acceleration(q, v)
    assert_close(bias, case.rate(lambda x: model.center_of_mass_velocity(x, v)), 1e-7)


def test_momentum_is_the_sum_over_bodies(case: Case):
    if not case.model.mechanism.exact:
        return
    model, q, v = case.model, case.q, case.v
    positions, rotations = model.body_poses(q)
    angular, linear = model.body_velocities(q, v)
    center, expected = model.center_of_mass(q), np.zeros((STATES, 6))
    for i, body in enumerate(model.robot.bodies):
        arm = times(rotations[:, i], np.array(body.inertial.com))
        momentum = body.inertial.mass * (linear[:, i] + np.cross(angular[:, i], arm))
        inertia = rotations[:, i] @ np.array(body.inertial.inertia) @ np.swapaxes(rotations[:, i], -1, -2)
        expected[:, :3] += times(inertia, angular[:, i]) + np.cross(positions[:, i] + arm - center, momentum)
        expected[:, 3:] += momentum
    assert_close(model.centroidal_momentum(q, v), expected)


def test_momentum(case: Case):
    model, q, v = case.model, case.q, case.v
    A, bias = model.centroidal_momentum_matrix(q), model.centroidal_momentum_bias(q, v)
    assert_close(times(A, v), model.centroidal_momentum(q, v))
    assert_close(bias, case.rate(lambda x: model.centroidal_momentum(x, v)), 1e-7)
    assert_close(model.centroidal_momentum(q, v)[:, 3:], model.total_mass * model.center_of_mass_velocity(q, v))
    if model.robot.floating:  # only gravity changes it, at every level
        tau = np.concatenate([np.zeros((STATES, 6)), case.tau[:, 6:]], axis=1)
        rate = times(A, model.forward_dynamics(q, v, tau)) + bias
        weight = model.total_mass * np.array(model.robot.gravity)
        assert_close(rate, np.broadcast_to([0.0, 0.0, 0.0, *weight], rate.shape), 1e-9)


def test_coriolis_matrix(case: Case):
    model, q, v = case.model, case.q, case.v
    C, g, M = model.coriolis_matrix(q, v), model.gravity_force(q), model.mass_matrix(q)
    assert_close(times(C, v) + g, model.bias_force(q, v))
    assert_close(times(M, case.vdot) + times(C, v) + g, model.inverse_dynamics(q, v, case.vdot))
    skew = case.rate(model.mass_matrix) - 2 * C
    assert_close(skew, -np.swapaxes(skew, -1, -2), 1e-7)


def test_gravity_force(case: Case):
    power = case.rate(lambda x: case.model.energy(x, case.v)[1])
    assert_close(np.einsum("bi,bi->b", case.model.gravity_force(case.q), case.v), power, 1e-7)


def test_inertial_regressor(case: Case):
    model, state = case.model, (case.q, case.v, case.vdot)
    Y = model.inertial_regressor(*state)
    assert_close(Y @ model.inertial_parameters, model.inverse_dynamics(*state))
    heavier = replace(model.robot, bodies=tuple(other_inertial(body) for body in model.robot.bodies))
    changed = Model(heavier, model.transmission, eliminate_rotors=False)
    assert_close(Y @ changed.inertial_parameters, changed.inverse_dynamics(*state))


def other_inertial(body):
    """A body with another mass, centre of mass and inertia, unless it has none."""
    rng = np.random.default_rng(len(body.name))
    mass, com = body.inertial.mass * 1.3, np.array(body.inertial.com) + rng.normal(0, 0.01, 3)
    if body.kind != "link" or not body.inertial.mass:
        com = np.array(body.inertial.com)
    inertia = np.array(body.inertial.inertia) * 1.2
    return replace(body, inertial=Inertial(mass, tuple(com), tuple(map(tuple, inertia))))


def test_operational_space_inertia(case: Case):
    """A wrench at a frame accelerates it by the inverse."""
    model, q, v = case.model, case.q, case.v
    if not model.robot.floating:
        with pytest.raises(ValueError, match="cannot move in all six directions"):
            model.operational_space_inertia(q, "marker")
        return
    wrench = np.random.default_rng(1).normal(size=(STATES, 6))
    frame = model.robot.frames[-2]
    position, _ = model.frame_pose(q, frame.name)
    moment = wrench[:, :3] + np.cross(position, wrench[:, 3:])
    pushed = {frame.body: np.concatenate([moment, wrench[:, 3:]], axis=1)}
    change = model.forward_dynamics(q, v, case.tau, pushed) - model.forward_dynamics(q, v, case.tau)
    acceleration = times(model.frame_jacobian(q, frame.name), change)
    assert_close(times(model.operational_space_inertia(q, frame.name), acceleration), wrench, 1e-9)


def test_constrained_forward_dynamics(case: Case):
    """Held frames do not accelerate, and their forces alone make the difference."""
    model, q, v = case.model, case.q, case.v
    frames = ["sensor", model.body_names[0]]
    vdot, forces = model.constrained_forward_dynamics(q, v, case.tau, frames)
    wrenches = {}
    for frame, force in zip(frames, np.moveaxis(forces, 1, 0), strict=True):
        position, _ = model.frame_pose(q, frame)
        body = model.robot.frames[-2].body if frame == "sensor" else frame
        wrenches[body] = wrenches.get(body, 0.0) + np.concatenate([np.cross(position, force), force], axis=1)
    assert_close(vdot, model.forward_dynamics(q, v, case.tau, wrenches), 1e-8)
    scale = 1.0 + np.abs(vdot).max()
    possible = model.robot.floating
    for frame in frames if possible else ():
        moved_by = times(model.frame_jacobian(q, frame), vdot) + model.frame_bias_acceleration(q, v, frame)
        assert np.abs(moved_by[:, 3:]).max() < 1e-9 * scale


def test_derivatives_of_frames_are_jacobians(case: Case):
    """Through loops, too: of a pose the frame's velocity, of a momentum the rows of its matrix."""
    model, q, v = case.model, case.q, case.v
    changes = model.derivatives("frame_pose:sensor", ["q"]).product(q, directions={"q": v})
    assert_close(changes["position"], model.frame_velocity(q, v, "sensor")[:, 3:])
    weights = {"momentum": np.eye(6)[1]}
    gradient = model.derivatives("centroidal_momentum", ["v"]).gradient(q, v, weights=weights)["v"]
    assert_close(gradient, model.centroidal_momentum_matrix(q)[:, 1])


def test_redundant_contacts():
    """Of four corners of a sole, three determine the motion; the smallest forces of all that do are returned."""
    model = Model("t1")
    q = model.standing_q
    body = next(contact.body for contact in model.robot.contacts if contact.group == "foot")
    corners = [contact.name for contact in model.robot.contacts if contact.body == body][:4]
    J = np.concatenate([model.contact_jacobian(q)[model.contact_names.index(name)] for name in corners])
    v, tau = np.random.default_rng(0).normal(size=(2, model.nv))
    v = v - np.linalg.pinv(J) @ J @ v  # the sole rests
    vdot, forces = model.constrained_forward_dynamics(q, v, tau, corners)
    assert_close(vdot, model.constrained_forward_dynamics(q, v, tau, corners[:3])[0], 1e-8)
    assert np.linalg.matrix_rank(J) == 6
    needed = model.mass_matrix(q) @ vdot + model.bias_force(q, v) - tau
    assert_close(forces.ravel(), np.linalg.lstsq(J.T, needed, rcond=1e-9)[0], 1e-8)


def test_names_of_contacts():
    model = Model("mini_cheetah")
    q, v = model.standing_q, np.zeros(18)
    assert model.contact_jacobian(q, []).shape == (0, 3, 18)
    assert model.contact_points(q, v, [])[1].shape == (0, 3)
    with pytest.raises(ValueError, match=r"contacts.*'FL'.*expected a contact of mini_cheetah.*FL_foot"):
        model.contact_jacobian(q, ["FL"])
    with pytest.raises(KeyError, match=r"no contact 'FL' for 'contact_jacobian'; expected one of.*FL_foot"):
        model.casadi_function("contact_jacobian:FR_foot,FL")


@pytest.mark.parametrize("robot", ["mini_cheetah", "four_bar"])
def test_batches(robot: str):
    model, rng = Model(robot), np.random.default_rng(0)
    q = np.array([model.random_configuration(rng) for _ in range(6)])
    v, frame = rng.normal(size=(6, model.nv)), model.body_names[-1]
    for quantity in (
        lambda q, v: model.frame_pose(q, frame)[1],
        lambda q, v: model.frame_bias_acceleration(q, v, frame),
        lambda q, v: model.contact_jacobian(q),
        lambda q, v: model.center_of_mass(q),
        model.centroidal_momentum,
        model.coriolis_matrix,
        model.integrate,
        lambda q, v: model.difference(q, q[..., ::-1] if robot == "four_bar" else q),
        lambda q, v: model.constrained_forward_dynamics(q, v, v, [frame])[1],
        lambda q, v: model.constrained_forward_dynamics(q, v, v, [])[1],
        lambda q, v: model.inertial_regressor(q, v, v),
    ):
        flat = quantity(q, v)
        np.testing.assert_allclose(quantity(q.reshape(2, 3, -1), v.reshape(2, 3, -1)).reshape(flat.shape), flat)
        np.testing.assert_allclose(quantity(q[0], v[0]), flat[0], atol=1e-12)


@pytest.mark.parametrize("name", ["mini_cheetah", "tello", "dr_legs", "spatial", "balls"])
def test_random_configurations(name: str):
    model = Model(BUILT[name]() if name in BUILT else load_robot(name))
    rng, layout = np.random.default_rng(3), model.robot.layout
    drawn = np.array([model.random_configuration(rng) for _ in range(20)])
    assert_close(model.unit(drawn), drawn, 1e-15)
    assert np.abs(model.loop_gap(drawn)).max() < 1e-9
    assert np.abs(drawn[:, layout.joints_q :] - model.standing_q[layout.joints_q :]).max(initial=0.0) > 0.1
    for i, joint in enumerate(model.robot.independent, start=layout.joints_q):
        lower, upper = model.robot.body(joint).joint.position
        assert (lower <= drawn[:, i]).all()
        assert (drawn[:, i] <= upper).all()
    again = np.random.default_rng(3)
    np.testing.assert_array_equal(model.random_configuration(again), drawn[0])


def test_neutral():
    q = Model(with_balls(True)).neutral()
    np.testing.assert_array_equal(q, [0, 0, 0, *[1, 0, 0, 0] * 4, 0, 0])
