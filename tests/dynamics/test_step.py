"""The implicit step against a dense solve, analytic motions and rest states."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Simulator
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.laws.scene_laws import state_sizes
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot
from ce_gym.model.mechanism import LEVELS

ALL = "all"


@cache
def cheetah(level: str) -> Model:
    return Model("mini_cheetah", level)


def stepper(model: Model, dt: float = 0.005, **options):
    contacts, start = options.pop("contacts", ALL), options.pop("start", None)
    names = model.contact_names if contacts == ALL else contacts
    material = options.pop("material", model.robot.material)
    scene = StepOptions(dt, contacts=names, material=material, **options)
    function = step_function(model.mechanism, scene, ("torque", "contact_forces"))

    sizes = state_sizes(model.mechanism, scene)
    memory = {
        name: np.zeros(sizes[name]) for name in ("load", "anchor") if name in sizes
    }  # as the simulator carries it
    memory |= {name: np.asarray(value, float) for name, value in (start or {}).items()}

    def step(q, v, target, diverged=0.0):
        given = {"q": q, "v": v, **memory, "diverged": diverged} | ({"target": target} if len(target) else {})
        results = function(**given)
        for name in memory:
            memory[name] = results.pop(f"{name}_next").full()
        order = [name for name in function.name_out() if name in results]
        return [results[name].full().ravel() for name in order]

    return step


@pytest.mark.parametrize(
    ("level", "dissipation", "bristle"),
    [*((level, None, 0.0) for level in LEVELS), ("exact", 5.0, 0.0), ("exact", None, 2e4), ("armature", 5.0, 2e4)],
)
def test_step_equals_a_dense_solve(level: str, dissipation: float | None, bristle: float):
    """(M + dt J^T C J + slope) vdot = tau - bias + J^T (f0 - dt C drift), put together in numpy.

    The joints move so; the base has the momentum that contacts and gravity leave.
    """
    model, dt = cheetah(level), 0.004
    material = ContactMaterial(3e4, 200.0, 0.7, 0.05, bristle, dissipation)
    rng = np.random.default_rng(5)
    q, v = model.standing_q.copy(), rng.normal(0, 0.3, model.nv)
    q[2] -= 0.003
    q[7:] += rng.normal(0, 0.02, 12)
    target = q[7:] + rng.normal(0, 0.05, 12)
    loads = rng.uniform(5, 40, len(model.contact_names))
    anchors = rng.normal(0, 2e-4, (len(loads), 2))
    start = {"load": loads} | ({"anchor": anchors.ravel()} if bristle else {})
    step = stepper(model, dt, material=material, friction="secant", start=start)
    q_next, v_next, _, torque, forces = step(q, v, target)

    robot = model.robot
    A, b = model.mass_matrix(q), -model.bias_force(q, v)
    joints = np.arange(6, model.nv)
    kp, kd = (np.array([dict(g)[n] for n in robot.independent]) for g in (robot.gains.kp, robot.gains.kd))
    damping = np.array([robot.body(n).joint.damping for n in robot.independent])
    b[joints] += kp * (target - q[7:]) - (kd + dt * kp) * v[6:] - damping * v[6:]
    A[joints, joints] += dt * (kd + dt * kp + damping)
    expected_forces = []
    parts = [
        contact_parts(model, sphere, q, v, dt, material, load, anchor)
        for sphere, load, anchor in zip(robot.contacts, loads, anchors, strict=True)
    ]
    for J, drift, f0, C in parts:
        A += dt * J.T @ C @ J
        b += J.T @ (f0 - dt * C @ drift)
    vdot = np.linalg.solve(A, b)
    for J, drift, f0, C in parts:
        expected_forces.append(f0 - dt * C @ (J @ vdot + drift))
    assert sum(np.linalg.norm(f) > 1 for f in expected_forces) == 4  # the four feet are loaded
    np.testing.assert_allclose(forces.reshape(-1, 3), expected_forces, atol=1e-9)
    np.testing.assert_allclose(v_next[6:], v[6:] + dt * vdot[6:], atol=1e-10)
    impulse = dt * model.total_mass * np.array([*np.zeros(3), *robot.gravity])
    for sphere, force in zip(robot.contacts, expected_forces, strict=True):
        place, _ = point_jacobian(model, sphere.body, tuple(sphere_bottom(model, sphere, q)), tuple(q))
        impulse += dt * np.array([*np.cross(place - model.center_of_mass(q), force), *force])
    gained = model.centroidal_momentum(q_next, v_next) - model.centroidal_momentum(q, v)
    np.testing.assert_allclose(gained, impulse, atol=1e-11)
    np.testing.assert_allclose(torque, kp * (target - q[7:]) - (kd + dt * kp) * (v[6:] + dt * vdot[6:]), atol=1e-9)


def contact_parts(model: Model, sphere: ContactSphere, q, v, dt: float, material: ContactMaterial, load, anchor):
    """World-frame J, base-frame turning, force at zero acceleration and effective damping of one sphere, by numpy."""
    lowest = sphere_bottom(model, sphere, q)
    world_point, J = point_jacobian(model, sphere.body, tuple(lowest), tuple(q))
    drift = J[:, 3:6] @ np.cross(v[:3], v[3:6])  # the base keeps its velocity in the world, not in its own axes
    velocity, n = J @ v, np.array([0.0, 0.0, 1.0])
    depth, k, up = -world_point[2], material.stiffness, velocity[2]
    if material.dissipation is None:
        normal_slope, push = material.damping + dt * k, k * depth - (material.damping + dt * k) * up
    else:  # lam(depth, rate) = k depth (1 + h rate), expanded about the present and taken one step ahead
        h = material.dissipation
        normal_slope = k * h * max(depth, 0.0) + dt * k * (1 - h * up)
        push = k * (1 - h * up) * (depth - dt * up)
    if not (depth - dt * up > 0 and push > 0) and not (depth > 0 and load > 0):
        return J, drift, np.zeros(3), np.zeros((3, 3))
    slip, cone = velocity - up * n, material.friction * load
    slope = cone / material.slip_speed + dt * material.bristle
    trial = material.bristle * (np.array([*anchor, 0.0]) if material.bristle else 0.0) + slope * slip
    share = min(1.0, cone / np.linalg.norm(trial))
    C = normal_slope * np.outer(n, n) + share * slope * (np.eye(3) - np.outer(n, n))
    return J, drift, push * n - share * trial, C


def sphere_bottom(model: Model, sphere: ContactSphere, q) -> np.ndarray:
    _, rotations = model.body_poses(q)
    R = rotations[model.body_names.index(sphere.body)]
    return np.array(sphere.position) - sphere.radius * R.T @ [0.0, 0.0, 1.0]


def point_on(model: Model, body: str, point) -> ca.Function:
    """Position and velocity of a body-fixed point as a function of (q, v), through our kinematics."""
    robot = replace(model.robot, contacts=(ContactSphere("point", body, tuple(map(float, point)), 0.0),))
    return Model(robot, model.transmission).casadi_function("contact_points")


@cache
def point_jacobian(
    model: Model, body: str, point: tuple[float, ...], q: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    f = point_on(model, body, point)
    columns = [f(q, unit)[1].full().ravel() for unit in np.eye(model.nv)]
    return f(q, np.zeros(model.nv))[0].full().ravel(), np.array(columns).T


def test_free_flight_is_a_straight_line():
    """A tumbling body without forces moves uniformly, and about a main axis it spins uniformly, to rounding."""
    inertia = ((0.02, 0.0, 0.0), (0.0, 0.03, 0.0), (0.0, 0.0, 0.04))
    body = Body("brick", "link", None, Placement(), Joint("free"), Inertial(2.0, (0.0, 0.0, 0.0), inertia))
    model = Model(Robot("brick", (body,), gravity=(0.0, 0.0, 0.0)))
    step = stepper(model, 0.01, control="torque")
    q = np.array([0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5])
    for w in ([3.0, -2.0, 5.0], [0.0, 0.0, 7.0]):
        v = np.array([*w, 0.4, 0.2, -0.3])
        world_velocity = model.body_poses(q)[1][0] @ v[3:]
        start, state = q, q
        for _ in range(100):
            state, v, *_ = step(state, v, np.zeros(0))
            assert abs(np.linalg.norm(state[3:7]) - 1) < 1e-12
        np.testing.assert_allclose(state[:3], start[:3] + 1.0 * world_velocity, atol=1e-12)
    relative = model.body_poses(start)[1][0].T @ model.body_poses(state)[1][0]
    np.testing.assert_allclose(np.arctan2(relative[1, 0], relative[0, 0]), 7.0 - 2 * np.pi, atol=1e-10)


def standing(num_envs: int, dt: float) -> Simulator:
    """Mini Cheetahs, all of whose spheres may touch; one kernel for any step and stiffness."""
    material = ContactMaterial(5e4, 500.0, 0.8)
    model = Model(replace(cheetah("exact").robot, material=material))
    return Simulator(model, num_envs, dt=dt, contacts=model.contact_names, parameters=("stiffness",))


def test_rest_depth_is_weight_over_stiffness():
    """A contact has no bias: the robot rests where the springs carry its weight."""
    sim = standing(1, 0.005)
    model = sim.model
    sim.step(model.standing_q[7:], 4000)
    forces = sim.contact_forces[0]
    assert forces[:, 2].sum() == pytest.approx(model.total_mass * 9.81, rel=1e-3)
    centres, _ = model.contact_points(sim.q[0], sim.v[0])
    for sphere, centre, force in zip(model.robot.contacts, centres, forces, strict=True):
        depth = max(sphere.radius - centre[2], 0.0)
        assert force[2] == pytest.approx(model.robot.material.stiffness * depth, abs=0.5)


@pytest.mark.parametrize("dt", [0.0005, 0.002, 0.01])
def test_drop_settles_without_chatter(dt: float):
    """From 10 cm onto ground of three stiffnesses."""
    sim = standing(3, dt)
    sim.set_parameter("stiffness", [[1e4], [1e5], [1e6]])
    q, target = sim.model.standing_q.copy(), sim.model.standing_q[7:]
    q[2] += 0.1
    sim.set_state(q, np.zeros(sim.model.nv))
    sim.step(target, round(3.0 / dt))
    assert not sim.diverged.any()
    assert np.abs(sim.v[:, :6]).max() < 0.1
    for _ in range(20):
        before = sim.v.copy()
        sim.step(target)
        assert np.abs(sim.v - before).max() < 2e-2


def test_motors_saturate():
    model = cheetah("exact")
    step = stepper(model, contacts=())
    *_, torque, _ = step(model.standing_q, np.zeros(model.nv), model.standing_q[7:] + 10.0)
    limits = [model.robot.body(name).joint.torque for name in model.joint_links]
    np.testing.assert_allclose(torque, limits)


def test_joint_stops_hold():
    """Full torque against a stop gets no further than the stop's compliance allows."""
    model = Model(replace(cheetah("exact").robot, gravity=(0.0, 0.0, 0.0)))
    step = stepper(model, contacts=())
    q, v = model.standing_q.copy(), np.zeros(model.nv)
    for _ in range(400):
        q, v, *_ = step(q, v, np.full(12, 20.0))
    upper = np.array([model.robot.body(name).joint.position[1] for name in model.joint_links])
    assert (q[7:] < upper + 0.02).all()
    assert np.isfinite(q).all()


def test_a_bad_number_freezes_the_robot():
    model = Model(TRIPOD)
    step = stepper(model)
    v = np.zeros(model.nv)
    v[7] = np.nan
    q_next, v_next, diverged, *_ = step(model.standing_q, v, model.standing_q[7:])
    assert diverged[0] == 1
    np.testing.assert_array_equal(q_next, model.standing_q)
    np.testing.assert_array_equal(v_next, v)
    *_, again, _, _ = step(model.standing_q, np.zeros(model.nv), model.standing_q[7:], diverged=1.0)
    assert again[0] == 1


def test_what_is_not_asked_for_costs_nothing():
    mechanism, one = Model(TRIPOD).mechanism, StepOptions(0.005, contacts=("front",))
    bare, touching, telling = (
        step_function(mechanism, options, outputs).n_instructions()
        for options, outputs in ((StepOptions(0.005), ()), (one, ()), (one, ("contact_forces",)))
    )
    assert bare + 50 < touching < telling


def test_a_short_step_is_the_acceleration_of_the_moment(robot: Robot):
    """Without contacts and away from stops, (v_next - v) / dt is what forward dynamics says, joint damping added."""
    model, dt, rng = Model(robot), 1e-7, np.random.default_rng(3)
    n = len(robot.independent)
    step = step_function(model.mechanism, StepOptions(dt, control="torque"))
    q, v, tau = model.standing_q, rng.normal(0, 0.5, model.nv), rng.normal(0, 1.0, n)
    after = {name: x.full().ravel() for name, x in step(q=q, v=v, target=tau, diverged=0.0).items()}
    damping = np.array([robot.body(name).joint.damping for name in robot.independent])
    expected = model.forward_dynamics(q, v, np.concatenate([np.zeros(model.nv - n), tau - damping * v[-n:]]))
    np.testing.assert_allclose((after["v_next"] - v) / dt, expected, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose((after["q_next"] - q)[-n:] / dt, v[-n:], rtol=1e-3, atol=1e-4)
    assert after["diverged_next"] == 0


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_a_rolling_ball_weighs_what_it_weighs(speed: float):
    """Its material point at the ground accelerates upwards; where it touches does not."""
    ball = Body("ball", "link", None, Placement(), Joint("free"), Inertial(2.0, (0.0, 0.0, 0.0), np.eye(3) * 0.008))
    contacts = (ContactSphere("ball", "ball", (0.0, 0.0, 0.0), 0.1),)
    model = Model(Robot("ball", (ball,), contacts=contacts, material=ContactMaterial(5e4, 500.0, 0.8)))
    step = stepper(model, 0.004)
    q = np.array([0.0, 0.0, 0.1 - 2 * 9.81 / 5e4, 1.0, 0.0, 0.0, 0.0])
    v = np.array([0.0, speed / 0.1, 0.0, speed, 0.0, 0.0])
    for _ in range(100):
        q, v, _, _, force = step(q, v, np.zeros(0))
        assert force == pytest.approx([0.0, 0.0, 2.0 * 9.81], abs=1e-6)
