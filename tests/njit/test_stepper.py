"""Sub-steps in `@njit` code have the bits of `Simulator.step`."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym import Model, Simulator
from ce_gym.sim.terrain import Terrain

numba = pytest.importorskip("numba")

from ce_gym.numba import bias_force, mass_matrix, stepper  # noqa: E402

HILLS = Terrain(np.random.default_rng(0).uniform(0, 0.05, (30, 30)), 0.1, (-1.5, -1.5))


@pytest.fixture(scope="module")
def model() -> Model:
    return Model("mini_cheetah")


@pytest.mark.parametrize(
    ("num_envs", "options"),
    [
        (1, {}),
        (11, {"terrain": HILLS}),
        (3, {"dtype": "float32", "outputs": ()}),
        (2, {"control": "torque", "contacts": ()}),
    ],
)
def test_bits_are_those_of_the_simulator(model, num_envs, options):
    njit, python = (Simulator(model, num_envs, **options) for _ in range(2))
    robots, step = stepper(njit)
    rng = np.random.default_rng(0)
    for n in (1, 4, 0, 3):
        targets = rng.normal(0, 0.3, (num_envs, 12)) + model.standing_q[7:]
        robots.target[...] = targets
        step(robots, n)
        python.step(targets, n)
        assert np.array_equal(njit.q, python.q)
        assert np.array_equal(njit.v, python.v)
    for name in options.get("outputs", ("torque", "contact_forces")):
        assert np.array_equal(getattr(njit, name), getattr(python, name))
    assert robots.torque.shape[1] == (0 if options.get("outputs") == () else 12)
    k = num_envs - 1
    lanes = robots.q.shape[2]
    assert np.array_equal(robots.q[k // lanes, :, k % lanes], python.q[k])
    njit.reset()
    python.reset()
    assert np.array_equal(robots.v[k // lanes, :, k % lanes], python.v[k])


def test_a_control_loop_in_njit(model):
    """Gravity compensation and damping through the mass matrix, against the same loop in Python."""
    mass, bias = mass_matrix(model), bias_force(model)
    njit, python = (Simulator(model, control="torque") for _ in range(2))
    robots, step = stepper(njit)

    @numba.njit
    def run(robots, n):
        for _ in range(n):
            q, v = robots.q[0, :, 0], robots.v[0, :, 0]
            tau = bias(q, v) - 20.0 * (mass(q) @ np.ascontiguousarray(v))
            robots.target[0] = tau[6:]
            step(robots, 1)

    run(robots, 50)
    for _ in range(50):
        q, v = python.q[0], python.v[0]
        python.step((model.bias_force(q, v) - 20.0 * (model.mass_matrix(q) @ v))[6:])
    np.testing.assert_allclose(njit.q, python.q, rtol=0, atol=1e-9)
