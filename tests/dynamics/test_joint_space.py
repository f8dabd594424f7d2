"""The solution of a step in joint space against dense numpy and against CE-ABA."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from ball_joints import with_balls
from dense import Dense
from elastic_robots import elastic

from ce_gym.compile import Buffer, Call, Program, load_kernel
from ce_gym.dynamics import Model
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.constraints.closure import reference_guess
from ce_gym.dynamics.forces.scene import SceneOptions, StepOptions
from ce_gym.dynamics.laws.scene_laws import iterate_size
from ce_gym.dynamics.recursion.joint_space import JointSpace, has_short_branches, point_jacobian
from ce_gym.dynamics.recursion.kinematics import outward_velocity_pass
from ce_gym.dynamics.stepping.step import linearise, solve_by_recursion, solve_in_joint_space
from ce_gym.dynamics.stepping.trace import Given
from ce_gym.model import load_robot, robots
from ce_gym.model.mechanism import LEVELS, build_mechanism
from ce_gym.sim.scene import resolve_scene

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")
STATES = 4
NARROW = {"dr_legs": 0.02, "cassie": 0.02, "six_bar": 0.1}
"""Largest random angle of robots whose loops close near the standing pose only [rad]."""


@pytest.fixture(params=["mini_cheetah", "four_bar", "planar_leg_linkage", "floating belts", "fixed belts"])
def robot(request: pytest.FixtureRequest, awkward_robot):
    if request.param.endswith("belts"):
        return awkward_robot(lopsided=1e-4, floating=request.param == "floating belts")
    return load_robot(request.param)


def test_the_equation_of_motion_equals_dense_numpy(robot):
    """`H`, `p` and a Jacobian of a point, from a matrix of all bodies and rotors and the null space of constraints."""
    mechanism, model, rng = build_mechanism(robot), Model(robot), np.random.default_rng(3)
    q, v = SX.sym("q", model.nq), SX.sym("v", model.nv)
    kinematics = outward_velocity_pass(mechanism, q, v)
    space = JointSpace.of(mechanism, kinematics, {})
    tip, point = next(reversed(mechanism.bodies)), np.array([0.1, -0.2, 0.3])
    J = point_jacobian(mechanism, kinematics, tip, SX(ca.DM(point)))
    function = ca.Function("space", [q, v], [space.H, space.p, J])
    for _ in range(STATES):
        q_value, v_value = random_state(model, rng)
        H, p, J_value = (x.full() for x in function(q_value, v_value))
        G, g = (x[0] for x in model.explicit_constraint(q_value[None], v_value[None]))
        dense = Dense(robot, *(x[0] for x in model.spanning(q_value[None], v_value[None])))
        M, h = G.T @ dense.M @ G, G.T @ (dense.M @ g + dense.h)
        axes, at_rest = np.eye(model.nv), np.zeros(model.nv)
        if robot.floating:
            axes[:3, :3] = axes[3:6, 3:6] = next(iter(dense.bodies.values())).R
            at_rest[3:6] = -np.cross(v_value[:3], v_value[3:6])
        scale = np.abs(M).max()
        np.testing.assert_allclose(H, axes @ M @ axes.T, rtol=0, atol=1e-12 * scale)
        np.testing.assert_allclose(p.ravel(), axes @ (h + M @ at_rest), rtol=0, atol=1e-11 * max(1, np.abs(h).max()))
        theirs = dense.bodies[tip].at(point).Jv @ G
        np.testing.assert_allclose(J_value, theirs @ axes.T, rtol=0, atol=1e-12 * np.abs(theirs).max())


def random_state(model: Model, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    spread = NARROW.get(model.robot.name, 0.3)
    q, v = model.standing_q + rng.uniform(-spread, spread, model.nq), rng.normal(0, 2, model.nv)
    for row, _ in model.robot.layout.turns:
        q[row : row + 4] = rng.normal(size=4)
        q[row : row + 4] /= np.linalg.norm(q[row : row + 4])
    return q, v


def scene_of(model: Model, **options) -> StepOptions:
    return replace(resolve_scene(SceneOptions(**options), model, None, "position"), dt=0.005)


def both_solutions(model: Model, **options) -> ca.Function:
    """Accelerations in joint space and by CE-ABA, and changes of contact velocities in two ways."""
    scene = scene_of(model, **options)
    given = Given(model.mechanism, scene)
    iterate = SX.sym("iterate", iterate_size(model.mechanism, scene))
    solved, gains = [], []
    for solve in (solve_in_joint_space, solve_by_recursion):
        system = linearise(given.scene, given.state, given.target, given.dt, iterate)
        solved.append(solve(system))
        touching = [*system.contacts, *system.loads.pairs]
        gains.append(ca.vertcat(SX(0, 1), *[contact.gain(solved[-1].motion) for contact in touching]))
    inputs = given.inputs() | ({"iterate": iterate} if iterate.numel() else {})
    outputs = [solved[0].vdot, solved[1].vdot, *gains]
    return ca.Function(
        "both", list(inputs.values()), ca.cse(outputs), list(inputs), ["ours", "theirs", "gain", "gains"]
    )


def inputs_of(function: ca.Function, model: Model, rng: np.random.Generator, iterated: bool) -> list[np.ndarray]:
    """A random state near the ground or in flight, and a random iterate, which need not be one that a step meets."""
    q, v = random_state(model, rng)
    if model.robot.floating:
        q[2] = model.standing_q[2] + rng.uniform(-0.1, 0.3)
    sizes = {name: function.numel_in(name) for name in function.name_in()}
    scales = {"load": 20, "anchor": 1e-3, "target": 0.5, "pair_force": 20, "iterate": 2 * iterated}
    given = {name: scales.get(name, 0) * rng.uniform(0, 1, size) for name, size in sizes.items()}
    given |= {"q": q, "v": v, "dependent": np.array(reference_guess(model.mechanism))}
    return [given[name] for name in sizes]


def check_same(model: Model, n: int = STATES, **options) -> None:
    function, rng = both_solutions(model, **options), np.random.default_rng(1)
    for i in range(n):
        ours, theirs, gain, gains = (x.full() for x in function(*inputs_of(function, model, rng, i % 2 == 1)))
        assert np.isfinite(theirs).all()
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11 * np.abs(theirs).max())
        np.testing.assert_allclose(gain, gains, rtol=0, atol=1e-11 * np.abs(gains).max(initial=1.0))


@pytest.mark.parametrize(
    ("robot_name", "options"),
    [
        ("mini_cheetah", {}),
        ("spot", {"contacts": "foot", "motors": "limited"}),
        ("planar_leg_linkage", {}),
        ("tello", {"contacts": "foot"}),
    ],
)
def test_the_solution_equals_that_of_the_recursion(robot_name: str, options: dict):
    check_same(Model(robot_name), **options)


@pytest.mark.parametrize("floating", [True, False])
def test_ball_joints(floating: bool):
    check_same(Model(with_balls(floating)))


@pytest.mark.stress
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("robot_name", robots())
def test_all_robots(robot_name: str, level: str):
    check_same(Model(robot_name, level), 20)


def test_in_single_precision():
    """Both solutions are as near to the one in double precision."""
    model, n = Model("mini_cheetah"), 256
    function, rng = both_solutions(model, contacts="foot"), np.random.default_rng(2)
    rows = [np.array(x) for x in zip(*[inputs_of(function, model, rng, True) for _ in range(n)], strict=True)]
    inputs, outputs = function.name_in(), function.name_out()
    buffers = [Buffer(name, function.numel_in(name), "rows_in") for name in inputs]
    buffers += [Buffer(name, function.numel_out(name), "rows_out") for name in outputs]
    program = Program("both solutions", tuple(buffers), (Call(function, tuple(inputs), tuple(outputs)),))
    results = {}
    for dtype in ("float32", "float64"):
        arrays = {name: x.astype(dtype) for name, x in zip(inputs, rows, strict=True)}
        arrays |= {name: np.zeros((n, function.numel_out(name)), dtype) for name in outputs}
        load_kernel(f"{__name__} {dtype}", lambda: program, dtype)(arrays, n)
        results[dtype] = arrays
    exact, scale = results["float64"]["theirs"], np.abs(results["float64"]["theirs"]).max(axis=1)
    errors = {
        name: np.median(np.abs(results["float32"][name] - exact).max(axis=1) / scale) for name in ("ours", "theirs")
    }
    assert errors["ours"] < 1e-5
    assert errors["ours"] < 3 * errors["theirs"]


@pytest.mark.parametrize(
    ("robot_name", "short"),
    [("mini_cheetah", True), ("anymal_c", True), ("mit_humanoid_leg", True), ("mit_humanoid", False), ("g1", False)],
)
def test_short_branches_are_solved_in_joint_space(robot_name: str, short: bool):
    assert has_short_branches(Model(robot_name).mechanism) == short


def test_elastic_transmissions():
    check_same(Model(elastic(load_robot("mini_cheetah"), 300.0), "elastic"), contacts="foot")


def test_pairs_of_links():
    pairs = (("FL_knee_link", "FR_knee_link"), ("FL_knee_link", "HL_knee_link"))
    check_same(Model("mini_cheetah"), 12, contacts="foot", self_collisions=pairs)
