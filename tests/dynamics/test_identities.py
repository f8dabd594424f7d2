"""Laws that hold whatever the robot: symmetry, power balance, momentum, Newton."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics import Model
from ce_gym.dynamics.algebra.integration import integrate
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.model import Robot
from ce_gym.model.mechanism import LEVELS


def move(model: Model, q: np.ndarray, v: np.ndarray, vdot: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Half a step of velocity, a step of position, half a step of velocity: second order, for finite differences."""
    symbols = [SX.sym("q", model.nq), SX.sym("v", model.nv), SX.sym("a", model.nv)]
    q1 = integrate(symbols[0], dt * symbols[1], model.robot.layout)
    step = ca.Function("step", symbols[:2], [q1])
    return step(q, v).full().ravel(), v + dt * vdot


def test_mass_matrix_is_symmetric_and_positive_definite(robot: Robot, random_state):
    for level in LEVELS:
        model = Model(robot, level)
        M = model.mass_matrix(random_state(model, 10)[0])
        np.testing.assert_allclose(M, np.swapaxes(M, -1, -2), atol=1e-12)
        assert np.linalg.eigvalsh(M).min() > 0


def test_power_balance(robot: Robot, awkward_robot, random_state):
    """The rate of change of energy is the power of the forces, tau . v, at every level."""
    for model in [*(Model(robot, level) for level in LEVELS), Model(awkward_robot())]:
        q, v = (x[0] for x in random_state(model, 1))
        tau = np.random.default_rng(3).normal(0, 5, model.nv)
        vdot = model.forward_dynamics(q, v, tau)
        h = 1e-6
        energies = [sum(model.energy(*move(model, q, v, vdot, dt))) for dt in (h, -h)]
        power = (energies[0] - energies[1]) / (2 * h)
        assert abs(power - tau @ v) < 1e-5 * max(1.0, abs(tau @ v), np.abs(vdot).max() * np.abs(v).max())


def test_kinetic_energy_is_the_mass_matrix(robot: Robot, random_state):
    model = Model(robot)
    q, v = random_state(model, 5)
    kinetic, _ = model.energy(q, v)
    np.testing.assert_allclose(kinetic, np.einsum("bi,bij,bj->b", v, model.mass_matrix(q), v) / 2, rtol=1e-12)


def test_free_fall(random_state):
    """With no forces and no velocity, a floating robot falls and keeps its shape: at rest nothing spins."""
    model = Model("mini_cheetah")
    q, v = random_state(model, 5)
    vdot = model.forward_dynamics(q, 0 * v, 0 * v)
    np.testing.assert_allclose(np.linalg.norm(vdot[:, 3:6], axis=1), 9.81, rtol=1e-10)
    np.testing.assert_allclose(vdot[:, :3], 0.0, atol=1e-9)
    np.testing.assert_allclose(vdot[:, 6:], 0.0, atol=1e-9)


def test_shapes_broadcast(robot: Robot, random_state):
    model = Model(robot)
    q, v = random_state(model, 6)
    tau = np.zeros(model.nv)
    flat = model.forward_dynamics(q, v, tau)
    stacked = model.forward_dynamics(q.reshape(2, 3, -1), v.reshape(2, 3, -1), tau)
    np.testing.assert_array_equal(stacked.reshape(6, -1), flat)
    np.testing.assert_array_equal(model.forward_dynamics(q[0], v[0], tau), flat[0])
    assert model.mass_matrix(np.zeros((0, model.nq))).shape == (0, model.nv, model.nv)
