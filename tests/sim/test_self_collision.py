"""Links that push each other apart, against dense solves, closed forms and balances."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import casadi as ca
import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym
from ce_gym.dynamics import Model
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.forces.self_collision import nearest
from ce_gym.dynamics.stepping.trace import iteration_function, step_function
from ce_gym.model import Body, ContactMaterial, Inertial, Joint, Placement, Robot
from ce_gym.model.checks.collisions import colliding, separate_links
from ce_gym.model.description import Capsule, Shape
from ce_gym.sim import Simulator

STILL = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
PAIR = (("plate", "forearm"),)


def slider(name: str, mass: float) -> Body:
    """A ball that slides along x."""
    joint = Joint("prismatic", axis=(1.0, 0.0, 0.0))
    return Body(name, "link", None, Placement(), joint, Inertial(mass, (0.0,) * 3, STILL), (Shape("sphere", (0.1,)),))


def tripod(*plate: Capsule, gravity=(0.0, 0.0, 0.0)) -> Robot:
    """A floating robot whose forearm is a rod, with what its plate is."""
    rod = Capsule("forearm", (0.0, 0.0, 0.0), (0.0, 0.0, 0.12), 0.02)
    return replace(ce_gym.load_robot(TRIPOD), capsules=(rod, *plate), gravity=gravity)


def beside_the_hand(robot: Robot, gap: float, way, length=0.0) -> Capsule:
    """A capsule of the plate that is this far from the forearm's end in the standing pose."""
    model = Model(robot)
    positions, rotations = model.body_poses(model.standing_q)
    plate, forearm = (model.body_names.index(name) for name in ("plate", "forearm"))
    hand = positions[forearm] + rotations[forearm] @ [0.0, 0.0, 0.12]
    way = np.array(way) / np.linalg.norm(way)
    start = rotations[plate].T @ (hand + (0.05 + gap) * way - positions[plate])
    along = length * np.cross(way, [0.0, 0.0, 1.0])
    return Capsule("plate", tuple(start - along), tuple(start + along), 0.03)


def gaps(model: Model, q, pairs) -> np.ndarray:
    """Distances between capsules [m], by brute force over their axes, refined."""
    positions, rotations = model.body_poses(q)
    found = []
    for pair in pairs:
        ends = []
        for one in pair:
            i = model.body_names.index(one.body)
            ends += [positions[i] + rotations[i] @ np.array(end) for end in (one.start, one.end)]
        found.append(closest(*ends) - pair[0].radius - pair[1].radius)
    return np.array(found)


def closest(a, b, c, d) -> float:
    """Distance between two segments: coordinate descent on a convex function."""
    s = t = 0.5
    for _ in range(400):
        s = np.clip(np.dot(c + t * (d - c) - a, b - a) / max(np.dot(b - a, b - a), 1e-12), 0, 1)
        t = np.clip(np.dot(a + s * (b - a) - c, d - c) / max(np.dot(d - c, d - c), 1e-12), 0, 1)
    return float(np.linalg.norm(a + s * (b - a) - c - t * (d - c)))


def test_nearest_points_of_segments():
    rng = np.random.default_rng(0)
    ends = [SX.sym(name, 3) for name in "abcd"]
    shares = ca.Function("nearest", ends, list(nearest(*ends)))
    for _ in range(100):
        a, b, c, d = rng.normal(size=(4, 3))
        s, t = (float(x) for x in shares(a, b, c, d))
        assert np.linalg.norm(a + s * (b - a) - c - t * (d - c)) == pytest.approx(closest(a, b, c, d), abs=1e-5)
    s, t = (float(x) for x in shares([0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]))  # parallel: in the middle
    assert (s, t) == pytest.approx((0.5, 0.5), abs=1e-6)


def test_two_balls_rebound_as_a_reduced_mass_on_a_spring():
    """Momentum to rounding; velocities, depth and duration as half a period of the spring, order one in the step."""
    stiffness, dt = 5e4, 2e-5
    bodies = (slider("a", 1.0), slider("b", 3.0))
    material = ContactMaterial(stiffness, 0.0, 0.8)
    model = Model(Robot("balls", bodies, independent=("a", "b"), material=material))
    options = StepOptions(dt, control="torque", material=material, self_collisions=(("a", "b"),))
    step = step_function(model.mechanism, options, ("energy",))
    q, v, load, deepest, lasted = np.array([-0.1001, 0.1]), np.array([1.0, 0.0]), 0.0, 0.0, 0
    for _ in range(1200):
        found = step(q=q, v=v, pair_force=load, diverged=0, target=np.zeros(2))
        q, v, load = (found[f"{name}_next"].full().ravel() for name in ("q", "v", "pair_force"))
        deepest, lasted = max(deepest, 0.2 - (q[1] - q[0])), lasted + (load[0] > 0)
        assert v @ [1.0, 3.0] == pytest.approx(1.0, abs=1e-13)
        assert float(found["energy"]) <= 0.5 + 1e-12
    frequency = np.sqrt(stiffness / 0.75)
    assert v == pytest.approx([-0.5, 0.5], abs=0.01)
    assert deepest == pytest.approx(1 / frequency, rel=0.01)
    assert lasted * dt == pytest.approx(np.pi / frequency, rel=0.01)


def test_forces_of_several_pairs_against_a_dense_solve():
    """From rest: M v+ = dt J^T lam with lam = k d - (c + dt k) J v+, J by differences; momentum is conserved."""
    dt = 0.004
    first = tripod()
    robot = tripod(beside_the_hand(first, -0.004, (1, 0.3, 0.2), 0.02), beside_the_hand(first, -0.002, (0.2, -1, 0.1)))
    model, pairs = Model(robot), colliding(robot, PAIR)
    assert len(pairs) == 2
    options = StepOptions(dt, control="torque", material=robot.material, self_collisions=PAIR)
    q, k, c = model.standing_q, robot.material.stiffness, robot.material.damping
    step = step_function(model.mechanism, options)
    found = step(q=q, v=np.zeros(model.nv), pair_force=np.zeros(2), diverged=0, target=np.zeros(2))
    after, lam, turned = (found[name].full().ravel() for name in ("v_next", "pair_force_next", "q_next"))
    J = np.zeros((2, model.nv))
    for i in range(2):
        e = np.zeros(model.nq)
        e[7 + i] = 1e-6
        J[:, 6 + i] = (gaps(model, q + e, pairs) - gaps(model, q - e, pairs)) / 2e-6
    depth = -gaps(model, q, pairs)
    np.testing.assert_allclose(lam, k * depth - (c + dt * k) * (J @ after), rtol=1e-4)
    damping = np.diag([0.0] * 6 + [robot.body(name).joint.damping for name in robot.independent])
    M = model.mass_matrix(q)
    expected = np.linalg.solve(M + dt * damping, dt * J.T @ lam)
    np.testing.assert_allclose(after[6:], expected[6:], rtol=1e-4)
    assert (lam > 5).all()
    np.testing.assert_allclose(model.centroidal_momentum(turned, after), 0, atol=1e-14)


def arms() -> Robot:
    """Two chains of three balls side by side on the ground, in gravity."""
    away, ball = Placement((0.0, 0.0, 0.3)), Placement((0.01, 0.02, 0.3))
    bodies = []
    for side, x in (("left", 0.0), ("right", 0.09)):
        for i, axis in enumerate(((0.0, 1.0, 0.0), (0.6, 0.8, 0.0), (0.0, 0.8, 0.6))):
            start = away if i else Placement((x, 0.0, 0.0))
            inertial = Inertial(1.3, (0.02, 0.0, 0.25), STILL)
            shape, parent = (Shape("sphere", (0.06,), ball),), f"{side}_{i - 1}" if i else None
            bodies.append(Body(f"{side}_{i}", "link", parent, start, Joint("revolute", axis=axis), inertial, shape))
    material = ContactMaterial(5e4, 300.0, 0.8)
    return Robot("arms", tuple(bodies), independent=tuple(body.name for body in bodies), material=material)


def test_forces_in_motion_and_gravity_against_a_dense_solve():
    """As above, on a fixed base: M v+ = M v + dt (tau - h + J^T lam), with what links do to each other in turning."""
    dt, rng = 0.002, np.random.default_rng(6)
    model, listed = Model(arms()), tuple((f"left_{i}", f"right_{i}") for i in (1, 2))
    options = StepOptions(dt, control="torque", material=model.robot.material, self_collisions=listed)
    step, pairs, seen = step_function(model.mechanism, options), colliding(model.robot, listed), 0
    k, c = model.robot.material.stiffness, model.robot.material.damping
    for _ in range(20):
        q, v = rng.normal(0, 0.2, 6), rng.normal(0, 1.0, 6)
        J = np.array([(gaps(model, q + e, pairs) - gaps(model, q - e, pairs)) / 2e-6 for e in 1e-6 * np.eye(6)]).T
        found = step(q=q, v=v, pair_force=np.zeros(2), diverged=0, target=np.zeros(6))
        after, lam = (found[name].full().ravel() for name in ("v_next", "pair_force_next"))
        acts, seen = lam > 0, seen + (lam > 0).sum()
        law = -k * gaps(model, q, pairs) - (c + dt * k) * (J @ after)
        np.testing.assert_allclose(lam[acts], law[acts], rtol=1e-4, atol=1e-2)
        if not acts.any():  # the robot keeps its energy instead
            continue
        free = v + dt * model.forward_dynamics(q, v, np.zeros(6))
        np.testing.assert_allclose(
            model.mass_matrix(q) @ (after - free), dt * J.T @ lam, atol=1e-9 + 1e-4 * dt * lam.max()
        )
    assert seen > 10


@pytest.fixture(scope="module")
def folded() -> Simulator:
    """Tripods on their feet with a rod that may hit the plate: the arm moves freely."""
    first = tripod()
    robot = tripod(beside_the_hand(first, 0.02, (1, 0.3, 0.2), 0.02), gravity=(0.0, 0.0, -9.81))
    return Simulator(Model(robot), 24, control="torque", contacts="foot", self_collisions=PAIR, outputs=("energy",))


def moving(n: int) -> tuple[np.ndarray, np.ndarray]:
    """States of tripods, of which every third throws its arm at the plate."""
    rng, model = np.random.default_rng(5), Model(TRIPOD)
    q, v = np.tile(model.standing_q, (n, 1)), np.zeros((n, model.nv))
    q[:, 2] -= 1e-4
    v[::3, 6:] = rng.uniform(-6, 6, (len(v[::3]), 2))
    return q, v


def test_a_robot_does_what_it_would_do_alone(folded: Simulator):
    """Bit for bit, whether its neighbours in a tile have links near each other or not; and energy does not grow."""
    q, v = moving(24)
    folded.set_state(q, v)
    energy, touched = None, np.zeros(24, bool)
    for _ in range(60):
        folded.step(np.zeros(2), 1)
        touched |= folded.pair_forces[:, 0] > 0
        assert energy is None or (folded.energy <= energy + 1e-3 * np.abs(energy)).all()
        energy = folded.energy
    assert 2 <= touched.sum() <= 8
    together = folded.q
    for i in (*np.flatnonzero(touched)[:2], 1):
        folded.set_state(np.tile(q[i], (24, 1)), np.tile(v[i], (24, 1)))
        for _ in range(60):
            folded.step(np.zeros(2))
        np.testing.assert_array_equal(folded.q[7], together[i])
    assert folded.pairs == PAIR


def test_pairs_are_all_that_a_scene_may_have():
    """Without contacts and limited motors: balls that meet part again, and momentum is kept."""
    bodies = (slider("a", 1.0), slider("b", 3.0))
    robot = Robot("balls", bodies, independent=("a", "b"), material=ContactMaterial(5e4, 0.0, 0.8))
    sim = Simulator(Model(robot), 3, 1e-3, control="torque", self_collisions=[("a", "b")])
    sim.set_state(np.array([-0.11, 0.1]), np.array([1.0, 0.0]))
    sim.step(np.zeros(2), 60)
    assert (sim.v[:, 1] > 0.3).all()
    np.testing.assert_allclose(sim.v @ [1.0, 3.0], 1.0, atol=1e-12)


def test_gradients_go_through_pairs(folded: Simulator):
    """Against central differences, where links press on each other."""
    derivatives, n = ce_gym.StepDerivatives(folded), 24
    q, v = moving(n)
    folded.set_state(q, v)
    for _ in range(60):
        before = folded.snapshot()
        folded.step(np.zeros(2), 1)
        if (folded.pair_forces > 5).any():
            break
    robot = int(folded.pair_forces.argmax())
    folded.restore(before)
    weights = np.zeros((n, 8))
    weights[:, 6:] = [1.0, -0.5]
    found = derivatives.gradient(np.zeros(2), {"v": weights})["v"][robot]
    base, states = folded.v, []
    for i in (6, 7):
        ends = []
        for way in (1e-6, -1e-6):
            folded.restore(before)
            rows = derivatives.state()
            rows["v"] = base.copy()
            rows["v"][:, i] += way
            derivatives.restore(rows)
            folded.step(np.zeros(2), 1)
            ends.append(float(folded.v[robot] @ weights[robot]))
        states.append((ends[0] - ends[1]) / 2e-6)
    np.testing.assert_allclose(found[6:], states, rtol=1e-5, atol=1e-7)


def test_what_is_not_asked_for_costs_nothing_and_adjacent_links_are_left_out():
    model = Model(tripod(gravity=(0.0, 0.0, -9.81)))
    feet = tuple(name for name in model.contact_names if name in ("front", "left", "right"))
    plain = iteration_function(model.mechanism, StepOptions(contacts=feet))
    same = iteration_function(Model(TRIPOD).mechanism, StepOptions(contacts=feet))
    assert plain.serialize() == same.serialize()
    assert ("plate", "upper_arm") not in list(separate_links(model.robot))
    for pairs, said in (
        ([("forearm", "upper_arm")], "upper_arm"),  # has no capsule
        ([("forearm", "tail")], "tail"),
        ([("plate",)], "plate"),
        ("some", "some"),
    ):
        with pytest.raises(ValueError, match=f"self_collisions.*{said}"):
            Simulator(model, self_collisions=pairs)
    whole = tripod(Capsule("plate", (0.0,) * 3, (0.0,) * 3, 0.1), Capsule("upper_arm", (0.0,) * 3, (0.0,) * 3, 0.1))
    with pytest.raises(ValueError, match="carries the other"):
        Simulator(Model(whole), self_collisions=[("plate", "upper_arm")])


def test_robots_do_not_depend_on_robots_whose_contacts_are_near():
    """A tripod that stands and one that is dropped on its lid, in one tile and each alone."""
    model = Model(TRIPOD)
    sim = Simulator(model, 16, outputs=("contact_forces",))
    q = np.tile(model.standing_q, (16, 1))
    q[::5, 2], q[::5, 3], q[::5, 4] = 0.3, 0.0, 1.0  # upside down
    sim.set_state(q, np.zeros(model.nv))
    sim.step(model.standing_q[7:], 175)
    assert (sim.contact_forces[0, 3:, 2] > 1).any()
    together = sim.q
    for i in (0, 1):
        sim.set_state(q[i], np.zeros(model.nv))
        sim.step(model.standing_q[7:], 175)
        np.testing.assert_array_equal(sim.q[3], together[i])


def test_environments_take_pairs(tmp_path):
    """An episode with links that could touch, but do not, is one without."""
    for file in Path(TRIPOD).parent.glob("tripod.*"):
        shutil.copy(file, tmp_path)
    robot, runs = tmp_path / "tripod.yaml", []
    ball, rod = "{from: [0, 0, -0.05], radius: 0.01}", "{from: [0, 0, 0], to: [0, 0, 0.12], radius: 0.02}"
    capsules = f"capsules: {{plate: {ball}, forearm: {rod}}}\nself_collisions: [[plate, forearm]]\n"
    robot.write_text(robot.read_text() + capsules)
    for more in ({}, {"self_collisions": "listed"}):
        scene = {"robot": str(robot), "contacts": ["foot", "knee"], **more}
        envs = gymnasium.make_vec("ce_gym/MiniCheetahStand-v0", num_envs=9, **scene)
        envs.reset(seed=3)
        for _ in range(10):
            observation = envs.step(np.zeros(envs.action_space.shape, np.float32))[0]
        runs.append(observation)
        envs.close()
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-6)
