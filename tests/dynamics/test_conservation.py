"""Momentum and energy: what a step keeps, and what contacts and motors change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_joints import with_balls
from tripod import TRIPOD

from ce_gym import Model, Simulator
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.model import Robot, load_robot
from ce_gym.model.mechanism import LEVELS

N = 8


def weightless(robot: Robot, **changes) -> Robot:
    return replace(robot, gravity=(0.0, 0.0, 0.0), **changes)


def tumbling(sim: Simulator, spin: float, joints: float) -> None:
    """Let the robots turn about random axes [rad/s] and move their joints."""
    model, rng = sim.model, np.random.default_rng(0)
    v = joints * rng.normal(size=(sim.num_envs, model.nv))
    axes = rng.normal(size=(sim.num_envs, 3))
    v[:, :3] = spin * axes / np.linalg.norm(axes, axis=1)[:, None]
    sim.set_state(np.tile(model.standing_q, (sim.num_envs, 1)), v)


def kinetic(sim: Simulator) -> np.ndarray:
    return np.einsum("ni,nij,nj->n", sim.v, sim.model.mass_matrix(sim.q), sim.v) / 2


def momentum(sim: Simulator) -> np.ndarray:
    return sim.model.centroidal_momentum(sim.q.astype(float), sim.v.astype(float))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("method", METHODS)
def test_motors_do_not_change_the_momentum_of_flight(awkward_robot, method: str, dtype: str):
    """Base origin away from the centre of mass; rotors without symmetry on the base and on moving links."""
    for level in LEVELS:
        model = Model(weightless(awkward_robot(lopsided=1e-3)), level)
        sim = Simulator(model, N, 0.002, dtype, method=method, control="torque", outputs=())
        tumbling(sim, 5.0, 1.0)
        rng, start = np.random.default_rng(1), momentum(sim)
        for _ in range(40):
            sim.step(rng.normal(0, 0.2, (N, len(model.joint_links))), 5)
        assert not sim.diverged.any()
        error = np.abs(momentum(sim) - start).max(axis=1) / np.abs(start).max(axis=1)
        rounding = 5e-4 if method == "adaptive" else 1e-4  # of many short steps
        assert error.max() < (1e-11 if dtype == "float64" else rounding), level


def test_ball_joints_do_not_change_it_either():
    sim = Simulator(Model(weightless(with_balls(floating=True))), N, 0.002, control="torque", outputs=())
    tumbling(sim, 8.0, 3.0)
    start = momentum(sim)
    sim.step(np.zeros((N, len(sim.target_names))), 500)
    np.testing.assert_allclose(momentum(sim), start, atol=1e-11 * np.abs(start).max())


def test_contacts_change_momentum_by_their_impulse():
    """Linear: contact forces and weight. Angular: forces times levers, one step at a time."""
    model, dt = Model(TRIPOD), 0.004
    sim = Simulator(model, N, dt)
    q, rng = np.tile(model.standing_q, (N, 1)), np.random.default_rng(2)
    q[:, 2] += rng.uniform(-0.002, 0.01, N)
    sim.set_state(q, rng.normal(0, 0.5, (N, model.nv)))
    target, touched = model.standing_q[7:] + rng.normal(0, 0.1, (N, 2)), 0
    for _ in range(30):
        before, center = momentum(sim), model.center_of_mass(sim.q)
        centres, _ = model.contact_points(sim.q, sim.v)
        sim.step(target)
        forces = sim.contact_forces
        weight = model.total_mass * np.array(model.robot.gravity)
        np.testing.assert_allclose((momentum(sim) - before)[:, 3:], dt * (forces.sum(1) + weight), atol=1e-12)
        places = centres - [0.0, 0.0, 1.0] * np.array([sphere.radius for sphere in model.robot.contacts])[:, None]
        torque = np.cross(places - center[:, None], forces).sum(1)
        np.testing.assert_allclose((momentum(sim) - before)[:, :3], dt * torque, atol=1e-12)
        touched += (forces[..., 2] > 0).any()
    assert touched > 10


@pytest.mark.parametrize(("dt", "spin", "bound"), [(0.001, 10.0, 1e-4), (0.005, 10.0, 1e-3), (0.02, 20.0, 5e-2)])
def test_free_flight_keeps_its_energy(awkward_robot, dt: float, spin: float, bound: float):
    """Passive joints, however coarse the step: neither gained nor lost."""
    sim = Simulator(Model(weightless(awkward_robot())), N, dt, control="torque", outputs=())
    tumbling(sim, spin, 1.0)
    start = kinetic(sim)
    for _ in range(20):
        sim.step(np.zeros(3), round(0.2 / dt))
        assert np.abs(kinetic(sim) / start - 1).max() < bound
    assert not sim.diverged.any()


def test_a_free_body_turns_as_euler_s_equations_say():
    """An asymmetric body whose origin is away from its centre of mass: second order, and 0.1 % of energy in 5 s."""
    robot = weightless(load_robot(TRIPOD), contacts=())
    base = replace(robot.bodies[0], inertial=replace(robot.bodies[0].inertial, com=(0.1, -0.05, 0.02)))
    model = Model(Robot("body", (base,), pose=replace(robot.pose, joints=()), gravity=robot.gravity))
    ends = []
    for dt in (0.004, 0.002, 0.001, 0.0001):
        sim = Simulator(model, N, dt, control="torque", outputs=())
        tumbling(sim, 10.0, 0.3)
        start = kinetic(sim)
        sim.step(np.zeros(0), round(0.4 / dt))
        ends.append(sim.q)
        assert np.abs(kinetic(sim) / start - 1).max() < 1e-3
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert np.log2(errors[0] / errors[1]) > 1.7, errors


def test_work_of_motors_becomes_energy():
    """In flight: the sum of torque times mean speed, at a step at which Euler's own error would be 1 %."""
    robot = weightless(load_robot(TRIPOD), contacts=())
    sim = Simulator(Model(robot), N, 0.005, control="torque", outputs=("torque",))
    tumbling(sim, 3.0, 0.5)
    rng, gained, start = np.random.default_rng(3), np.zeros(N), kinetic(sim)
    damping = np.array([robot.body(name).joint.damping for name in robot.independent])
    for _ in range(40):
        before = sim.v[:, 6:]
        sim.step(rng.normal(0, 0.1, (N, 2)))
        gained += 0.005 * ((sim.torque - damping * sim.v[:, 6:]) * (before + sim.v[:, 6:]) / 2).sum(1)
    np.testing.assert_allclose(kinetic(sim) - start, gained, atol=1e-2 * np.abs(gained).max())


@pytest.mark.parametrize("dt", [0.001, 0.005])
def test_a_loop_keeps_its_energy(dt: float):
    """A four-bar without friction swings in gravity on a fixed base."""
    four_bar = load_robot("four_bar")
    bodies = tuple(replace(b, joint=replace(b.joint, damping=0.0, friction=0.0)) for b in four_bar.bodies)
    model = Model(replace(four_bar, bodies=bodies))
    sim = Simulator(model, 1, dt, control="torque", outputs=("energy",))
    sim.set_state(model.standing_q, np.full(model.nv, 0.5))
    sim.step(np.zeros(model.nv))
    start = sim.energy[0]
    for _ in range(50):
        sim.step(np.zeros(model.nv), round(0.02 / dt))
        assert abs(sim.energy[0] - start) < 1e-6 * (abs(start) + kinetic(sim)[0])
