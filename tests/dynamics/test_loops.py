"""Closed loops, rods and users' constraints: against physics, and when they are wrong. Dense solves: test_dense.py."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from facts import robot_from_facts
from linkages import four_bar, link, rod_leg, spatial_four_bar

from ce_gym.dynamics import Model
from ce_gym.dynamics.algebra.integration import integrate
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.constraints.closure import closures
from ce_gym.model import (
    FunctionConstraint,
    LinearConstraint,
    LoopConstraint,
    Placement,
    Pose,
    Robot,
    RobotError,
    cluster_tree,
    load_robot,
    register_constraint,
)
from ce_gym.model.mechanism import LEVELS
from ce_gym.sim.kernel_key import model_key

ROBOTS = {
    "four_bar": four_bar,
    "spatial_four_bar": spatial_four_bar,
    "rod_leg": rod_leg,
    "six_bar": lambda: load_robot("six_bar"),
    "tello": lambda: load_robot("tello"),
}


@pytest.fixture(scope="module", params=ROBOTS)
def model(request: pytest.FixtureRequest) -> Model:
    return Model(ROBOTS[request.param]())


def states(model: Model, count: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Random states around the reference pose."""
    rng = np.random.default_rng(5)
    q = model.standing_q + rng.uniform(-0.25, 0.25, (count, model.nq))
    if model.robot.floating:
        q[:, 3:7] = rng.normal(size=(count, 4))
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    return q, rng.normal(0, 2, (count, model.nv))


def test_inverse_dynamics_undoes_forward_dynamics(model: Model):
    q, v = states(model)
    tau = np.random.default_rng(7).normal(0, 3, v.shape)
    back = model.inverse_dynamics(q, v, model.forward_dynamics(q, v, tau))
    np.testing.assert_allclose(back, tau, rtol=1e-8, atol=1e-8)
    M = model.mass_matrix(q)
    np.testing.assert_allclose(M, np.swapaxes(M, -1, -2), atol=1e-10 * np.abs(M).max())
    assert np.linalg.eigvalsh(M).min() > 0


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_power_balance(model: Model, level: str):
    """The rate of change of energy is the power of the forces."""
    model = Model(model.robot, level)
    q, v = (x[0] for x in states(model, 1))
    tau = np.random.default_rng(8).normal(0, 5, model.nv)
    vdot = model.forward_dynamics(q, v, tau)
    symbols = SX.sym("q", model.nq), SX.sym("v", model.nv), SX.sym("dt")
    move = ca.Function("move", symbols, [integrate(symbols[0], symbols[2] * symbols[1], model.robot.layout)])
    h = 1e-6
    energies = [sum(model.energy(move(q, v, dt).full().ravel(), v + dt * vdot)) for dt in (h, -h)]
    power = (energies[0] - energies[1]) / (2 * h)
    assert abs(power - tau @ v) < 2e-5 * max(1.0, abs(tau @ v), np.abs(vdot).max() * np.abs(v).max())


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_velocity_terms_follow_from_the_mass_matrix(model: Model, level: str):
    """Lagrange's equations for joints on a base at rest: `dM/dt v - d(v^T M v / 2)/dq`, by differences of `M`."""
    model, base = Model(model.robot, level), 6 * model.robot.floating
    q, v = (x[0] for x in states(model, 1))
    v[:base] = 0.0
    joints, h = range(base, model.nv), 1e-5
    ends = [q + h * s * np.eye(model.nq)[model.nq - model.nv + i] for i in joints for s in (1, -1)]
    M = model.mass_matrix(np.array(ends))[:, base:, base:].reshape(len(joints), 2, len(joints), len(joints))
    slope, rates = (M[:, 0] - M[:, 1]) / (2 * h), v[base:]
    expected = np.einsum("kij,k,j->i", slope, rates, rates) - np.einsum("kij,i,j->k", slope, rates, rates) / 2
    terms = (model.bias_force(q, v) - model.bias_force(q, 0 * v))[base:]
    np.testing.assert_allclose(terms, expected, rtol=1e-6, atol=1e-7 * np.abs(slope).max() * (rates @ rates))


def test_armature_is_the_diagonal_of_coupled(model: Model):
    """In clusters with one independent joint both levels are equal, velocity terms included."""
    q, v = states(model, 3)
    coupled, armature, none = (Model(model.robot, level) for level in ("coupled", "armature", "none"))
    added, diagonal = (x.mass_matrix(q) - none.mass_matrix(q) for x in (coupled, armature))
    np.testing.assert_allclose(diagonal, added * np.eye(model.nv), atol=1e-12 * np.abs(added).max(initial=1.0))
    if all(len(cluster.independent) < 2 for cluster in model.cluster_tree.clusters):
        tau = np.random.default_rng(6).normal(0, 5, v.shape)
        theirs = coupled.forward_dynamics(q, v, tau)
        np.testing.assert_allclose(armature.forward_dynamics(q, v, tau), theirs, rtol=1e-10, atol=1e-10)


def test_eliminated_rotors_in_clusters_with_loops(model: Model):
    """Rotors whose G_r varies, on output bodies and inside clusters, against rotors as bodies."""
    q, v = states(model)
    tau = np.random.default_rng(9).normal(0, 3, v.shape)
    general = Model(model.robot, eliminate_rotors=False)
    ours, theirs = model.forward_dynamics(q, v, tau), general.forward_dynamics(q, v, tau)
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())
    wrenches = {name: np.random.default_rng(i).normal(0, 3, 6) for i, name in enumerate(model.body_names)}
    ours, theirs = (m.forward_dynamics(q, v, tau, wrenches) for m in (model, general))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


def test_motors_deliver_their_power(model: Model):
    """`tau = W^T effort` does the work that the efforts do at the velocities of the motors."""
    q, v = (x[0] for x in states(model, 1))
    names = [body.name for body in model.robot.rotors()] or list(model.spanning_names)
    effort = np.random.default_rng(10).normal(size=len(names))
    _, v_span = model.spanning(q, v)
    base = 6 if model.robot.floating else 0
    rates = [v_span[base + model.spanning_names.index(name)] for name in names]
    assert v @ (model.actuator_matrix(q, names).T @ effort) == pytest.approx(np.dot(rates, effort), rel=1e-10)


def test_spanning_coordinates_and_back(model: Model):
    q, v = states(model)
    q_again, v_again = model.from_spanning(*model.spanning(q, v))
    np.testing.assert_allclose(q_again, q)
    np.testing.assert_allclose(v_again, v)
    broken, v_span = model.spanning(q, v)
    broken[:, -1] += 0.01
    with pytest.raises(ValueError, match="misses the constraints"):
        model.from_spanning(broken, v_span)


def test_wrench_is_the_force_it_says(model: Model):
    """A wrench on a body does work at the velocity of the body: compare with the pose of the body a moment later."""
    q, v = (x[0] for x in states(model, 1))
    base = model.bias_force(q, v)
    body = model.body_names[-1]
    i, h, force = model.body_names.index(body), 1e-6, np.array([1.0, -2.0, 3.0])
    symbols = SX.sym("q", model.nq), SX.sym("v", model.nv), SX.sym("dt")
    move = ca.Function("move", symbols, [integrate(symbols[0], symbols[2] * symbols[1], model.robot.layout)])
    points = [model.body_poses(move(q, v, dt).full().ravel())[0][i] for dt in (h, -h)]
    at = model.body_poses(q)[0][i]
    wrench = np.concatenate([np.cross(at, force), force])
    vdot = model.forward_dynamics(q, v, np.zeros(model.nv), {body: wrench})
    power = (model.mass_matrix(q) @ vdot + base) @ v
    assert power == pytest.approx(force @ (points[0] - points[1]) / (2 * h), rel=1e-4, abs=1e-5)
    with pytest.raises(ValueError, match="expected the name of a body"):
        model.forward_dynamics(q, v, np.zeros(model.nv), {"nobody": wrench})


def test_formulas_are_found():
    """Everything planar, and every rod with one unknown, is closed by a formula; the rest by Newton's method."""
    formulas = {
        name: [b.formula for c in closures(Model(make()).mechanism) if c for b in c.blocks]
        for name, make in ROBOTS.items()
    }
    assert not any(
        formula is None for name, found in formulas.items() if name != "spatial_four_bar" for formula in found
    )
    assert formulas["spatial_four_bar"] == [None]
    assert len(formulas["tello"]) == 6
    assert Model(spatial_four_bar()).guess.shape == (3,)


def test_redundant_rows_are_dropped():
    (closure,) = [c for c in closures(Model(four_bar()).mechanism) if c]
    assert closure.assembly.dropped == 3  # of the five rows of a hinge, a planar loop needs two
    (closure,) = [c for c in closures(Model(spatial_four_bar()).mechanism) if c]
    assert closure.assembly.dropped == 0


def test_assembly_chooses_the_branch():
    one = four_bar()
    other = replace(one, assembly=(("coupler", -1.5), ("rocker", -1.8)))
    angles = [
        dict(zip(m.spanning_names, m.spanning(m.standing_q, [0.0])[0], strict=True)) for m in map(Model, (one, other))
    ]
    assert abs(angles[0]["rocker"] - angles[1]["rocker"]) > 0.5
    assert Model(other).loop_gap(Model(other).standing_q) < 1e-14


def test_any_independent_joint_will_do():
    """The same motion, whichever joint of a one-degree-of-freedom loop is called independent."""
    crank = Model(four_bar())
    q_span, v_span = crank.spanning([0.9], [1.3])
    tau = 2.0
    expected = crank.spanning_acceleration([0.9], [1.3], crank.forward_dynamics([0.9], [1.3], [tau]))
    at = dict(zip(crank.spanning_names, q_span, strict=True))
    for name in ("coupler", "rocker", "motor"):
        rest = tuple((joint, angle) for joint, angle in at.items() if joint != name)
        robot = four_bar(independent=(name,), pose=Pose(joints=((name, at[name]),)), assembly=rest)
        model = Model(robot)
        q, v = model.from_spanning(q_span, v_span)
        vdot = model.forward_dynamics(q, v, model.actuator_matrix(q, ["crank"]).T @ [tau])
        np.testing.assert_allclose(model.spanning_acceleration(q, v, vdot), expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("angle", np.linspace(0.1, 3.0, 30))
def test_dead_centre_is_refused(angle):
    """Crank and rocker about one axis, with a coupler that just reaches: rounding decides whether the loop closes."""
    bodies = (
        link("crank", None, (0.0, 0.0, 0.0)),
        link("coupler", "crank", (0.5, 0.0, 0.0)),
        link("rocker", None, (0.0, 0.0, 0.0)),
    )
    pin = LoopConstraint("pin", "revolute", "coupler", "rocker", Placement((1.0, 0.0, 0.0)), Placement((0.5, 0.0, 0.0)))
    pose, rest = Pose(joints=(("crank", angle),)), (("coupler", 3.0), ("rocker", angle + np.pi))
    with pytest.raises(RobotError, match=r"tied by pin, (is singular|has 2 freedoms)"):
        Model(Robot("dead", bodies, (pin,), ("crank",), pose=pose, assembly=rest))


def test_singular_choice_is_refused():
    """At its dead point a rocker stands still: its angle does not determine the crank's."""
    reach = Model(four_bar())
    grid = np.linspace(0, 2 * np.pi, 20001)[:, None]
    rates = reach.spanning(grid, np.ones_like(grid))[1][:, reach.spanning_names.index("rocker")]
    dead = float(grid[int(np.argmax(rates[:-1] * rates[1:] <= 0)), 0])
    for _ in range(60):  # to the last digit, by the secant through two points
        rate = [reach.spanning([dead + h], [1.0])[1][reach.spanning_names.index("rocker")] for h in (0.0, 1e-5)]
        dead -= rate[0] * 1e-5 / (rate[1] - rate[0])
    at = dict(zip(reach.spanning_names, reach.spanning([dead], [0.0])[0], strict=True))
    rest = tuple((joint, angle) for joint, angle in at.items() if joint != "rocker")
    robot = four_bar(independent=("rocker",), pose=Pose(joints=(("rocker", at["rocker"]),)), assembly=rest)
    with pytest.raises(RobotError, match="is singular: expected independent joints that determine"):
        Model(robot)


def test_wrong_loops_are_refused():
    with pytest.raises(RobotError, match=r"pin, gear, has 1 freedom, .*: expected as many independent joints"):
        Model(four_bar(independent=("crank", "coupler"), assembly=()))
    pin = four_bar().constraints[0]
    assert isinstance(pin, LoopConstraint)
    far = replace(pin, second_placement=replace(pin.second_placement, position=(5.0, 0.0, 0.0)))
    with pytest.raises(RobotError, match="does not close at the standing pose"):
        Model(four_bar(constraints=(far, four_bar().constraints[1])))
    lifted = replace(pin, second_placement=replace(pin.second_placement, position=(0.25, 0.0, 0.1)))
    with pytest.raises(RobotError, match="does not close at the standing pose"):
        Model(four_bar(constraints=(lifted, four_bar().constraints[1])))


def test_beyond_the_range_of_a_loop():
    """A loop that cannot be closed is an error, not a number; how near it is can be asked."""
    model = Model("tello")
    q = model.standing_q.copy()
    thigh = 7 + model.joint_links.index("left-thigh")
    assert model.nearness(q) == pytest.approx(1.0)
    assert 0 < model.nearness(q + 0.9 * (np.arange(model.nq) == thigh)) < 0.9
    q[thigh] = 1.5
    assert model.nearness(q) == -1.0
    with pytest.raises(ValueError, match="the loops of tello cannot be closed at this q"):
        model.forward_dynamics(q, np.zeros(model.nv), np.zeros(model.nv))
    by_rotors = Model(robot_from_facts("tello"))  # no formula for the links then
    q = by_rotors.standing_q.copy()
    q[7 + by_rotors.joint_links.index("left-hip-rotor-1")] -= 6 * 2.5
    q[7 + by_rotors.joint_links.index("left-hip-rotor-2")] -= 6 * 2.5
    with pytest.raises(ValueError, match="the loops of tello pass a singularity on the way to this q"):
        by_rotors.forward_dynamics(q, np.zeros(by_rotors.nv), np.zeros(by_rotors.nv))


def with_function(**changes) -> Robot:
    """The rotor of a two-link arm turns with the sine of the elbow, or so a user says."""
    bodies = (
        link("arm", None, (0.0, 0.0, 0.0)),
        link("elbow", "arm", (0.3, 0.0, 0.0)),
        link("cam", "arm", (0.0, 0.1, 0.0)),
    )
    tie = FunctionConstraint("cam", "test_cam", **({"arguments": ("elbow",), "dependent": ("cam",)} | changes))
    return Robot("arm", bodies, (tie,), ("arm", "elbow"))


def test_functions_from_python():
    register_constraint("test_cam", lambda q: [q[0] + 0.5 * ca.sin(q[0])])
    explicit = Model(with_function())
    register_constraint("test_cam_implicit", lambda q: [q[1] + 0.5 * ca.sin(q[1]) - q[0]])
    changes = {"function": "test_cam_implicit", "arguments": ("cam", "elbow"), "dependent": ()}
    implicit = Model(replace(with_function(), constraints=(FunctionConstraint("cam", **changes),)))
    backwards = Model(replace(implicit.robot, independent=("arm", "cam")))
    q, v, tau = np.array([0.3, 0.8]), np.array([1.0, -2.0]), np.array([0.5, 0.7])
    q_span, v_span = explicit.spanning(q, v)
    assert q_span[2] == pytest.approx(0.8 + 0.5 * np.sin(0.8))
    assert v_span[2] == pytest.approx(-2.0 * (1 + 0.5 * np.cos(0.8)))
    vdot = explicit.forward_dynamics(q, v, tau)
    np.testing.assert_allclose(implicit.forward_dynamics(q, v, tau), vdot, rtol=1e-12)
    for model in (explicit, implicit):
        (G, g), (K, k) = model.explicit_constraint(q, v), model.implicit_constraint(q, v)
        np.testing.assert_allclose(K @ G, np.zeros((1, 2)), atol=1e-14)
        np.testing.assert_allclose(K @ g, k, rtol=1e-12)
        assert abs(k[0]) > 0.5
    assert explicit.guess.size == implicit.guess.size == 0
    assert backwards.guess.size == 1  # q + sin(q) / 2 = y has no formula
    q_b, v_b = backwards.from_spanning(q_span, v_span)
    tau_b = backwards.actuator_matrix(q_b, ["arm", "elbow"]).T @ tau
    accelerations = backwards.spanning_acceleration(q_b, v_b, backwards.forward_dynamics(q_b, v_b, tau_b))
    np.testing.assert_allclose(accelerations, explicit.spanning_acceleration(q, v, vdot), rtol=1e-10)


@pytest.mark.parametrize("dependent", [("cam",), ()])
def test_a_kernel_is_not_taken_for_that_of_another_function_of_the_same_name(dependent):
    robot = with_function(arguments=("elbow",) if dependent else ("elbow", "cam"), dependent=dependent)
    keys = []
    for gain in (0.5, 0.7, 0.5):
        register_constraint("test_cam", lambda q, gain=gain: [sum(q[1:], gain * ca.sin(q[0]))])
        keys.append(model_key(Model(robot)))
    assert keys[0] == keys[2] != keys[1]


def test_functions_that_are_wrong():
    with pytest.raises(RobotError, match="expected a registered function"):
        Model(replace(with_function(), constraints=(FunctionConstraint("cam", "no_such", ("elbow",), ("cam",)),)))
    register_constraint("test_two", lambda q: [q[0], q[0]])
    with pytest.raises(RobotError, match=r"returned 2 values: expected 1"):
        Model(replace(with_function(), constraints=(FunctionConstraint("cam", "test_two", ("elbow",), ("cam",)),)))


def test_clusters_of_the_papers_figure_3():
    """Nested loops (the chord 2-3 inside 6-7) and parallel loops (two chords at one body) of arXiv:2311.13732."""
    parents = {1: None, 2: 1, 3: 1, 4: 1, 5: 4, 6: 2, 7: 3, 8: 4, 9: 8}
    bodies = tuple(link(f"b{i}", f"b{p}" if p else None, (0.1 * i, 0.0, 0.0)) for i, p in parents.items())
    chords = [(2, 3), (6, 7), (4, 5), (4, 9)]
    loops = tuple(LoopConstraint(f"{a}-{b}", "ball", f"b{a}", f"b{b}") for a, b in chords)
    tree = cluster_tree(Robot("figure", bodies, loops, ()))
    groups = [set(cluster.bodies) for cluster in tree.clusters]
    assert {"b2", "b3", "b6", "b7"} in groups  # nested loops are one cluster
    assert {"b5"} in groups
    assert {"b8", "b9"} in groups  # a loop that ends on its own output body leaves it out
    assert [cluster.output_body for cluster in tree.clusters] == [None, "b1", "b1", "b4", "b4"]
    tied_together = cluster_tree(Robot("figure", bodies, (*loops, LoopConstraint("5-9", "ball", "b5", "b9")), ()))
    assert {"b5", "b8", "b9"} in [set(cluster.bodies) for cluster in tied_together.clusters]


def test_facts_and_assets_are_the_same_robots():
    """The files of ours have the figures that the reference vectors were checked with."""
    for name in ("four_bar", "six_bar", "planar_leg_linkage", "tello", "tello_with_arms"):
        ours = load_robot(name)
        at = dict(ours.pose.joints) | dict(ours.assembly)
        facts = Model(robot_from_facts(name, list(ours.independent), at))
        model = Model(ours)
        q, v = states(model)
        np.testing.assert_allclose(
            model.forward_dynamics(q, v, 0.1 * v), facts.forward_dynamics(q, v, 0.1 * v), rtol=1e-8, atol=1e-8
        )


def test_linear_constraints_in_a_cluster_with_loops_keep_their_offsets():
    robot = four_bar()
    shifted = replace(robot.constraints[1], offset=0.4)
    assert isinstance(shifted, LinearConstraint)
    models = Model(robot), Model(replace(robot, constraints=(robot.constraints[0], shifted)))
    angles = [m.spanning([0.7], [0.0])[0][m.spanning_names.index("motor")] for m in models]
    assert angles[1] - angles[0] == pytest.approx(0.4)
