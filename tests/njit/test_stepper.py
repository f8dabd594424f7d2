"""Sub-steps in `@njit` code have the bits of `Simulator.step`."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym import Model, Simulator
from ce_gym.sim.terrain import Terrain

numba = pytest.importorskip("numba")

from ce_gym.numba import bias_force, mass_matrix, set_state, stepper  # noqa: E402

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


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"dtype": "float32", "outputs": ()},
        {"contacts": ()},
        {"parameters": ("stiffness", "gravity"), "method": "adaptive"},
    ],
)
def test_states_set_in_njit_are_those_of_the_simulator(model, options):
    """A stiff robot in the ground diverges before; robots in the ground have resting loads at once."""
    njit, python = (Simulator(model, 11, **options) for _ in range(2))
    robots, step = stepper(njit)
    put, rng = set_state(njit), np.random.default_rng(0)
    target, mask = np.tile(model.standing_q[7:], (11, 1)), np.arange(11) % 3 == 1
    if "parameters" in options:
        for sim in (njit, python):
            sim.set_parameter("stiffness", 1e4 * (1.0 + np.arange(11)[:, None]))
    q = model.standing_q + rng.uniform(-0.03, 0.03, (11, 19)) * (np.arange(19) > 6)
    q[:, 3:7] *= rng.uniform(1 - 9e-4, 1 + 9e-4, (11, 1))
    v = rng.normal(size=(11, 18))
    wild = np.where(np.arange(11)[:, None] == 4, 1e6, v)
    for sim in (njit, python):
        sim.set_state(q, wild)
        sim.step(target, 3)

    @numba.njit
    def put_some(robots, mask, q, v):
        for k in range(len(mask)):
            if mask[k]:
                put(robots, k, q[k], v[k])

    put_some(robots, mask, q - 0.02 * (np.arange(19) == 2), v)
    python.set_state(q - 0.02 * (np.arange(19) == 2), v, mask)
    robots.target[...] = target
    for _ in range(3):
        for name, expected in python.snapshot().items():
            assert np.array_equal(njit.snapshot()[name], expected), name
        step(robots, 1)
        python.step(target, 1)
    assert njit.n_diverged == python.n_diverged > 0


def test_states_that_are_refused(model):
    sim = Simulator(model, 2)
    robots, _ = stepper(sim)
    put, q, v = set_state(sim), model.standing_q, np.zeros(18)
    before = sim.snapshot()
    for k, wrong_q, wrong_v in ((2, q, v), (-1, q, v), (0, q[:-1], v), (0, q, v * np.nan), (0, 2 * q, v)):
        with pytest.raises(ValueError, match="set_state: "):
            put(robots, k, wrong_q, wrong_v)
    assert all(np.array_equal(rows, before[name]) for name, rows in sim.snapshot().items())
    with pytest.raises(ValueError, match="expected level ground"):
        set_state(Simulator(model, terrain=HILLS))
    assert repr(robots) == "Robots(2 robots, nq=19, nv=18, float64)"
