"""A controller that the kernel calls has the bits of the same controller called from Python before each sub-step."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from ce_gym import Model, Simulator, StepDerivatives

numba = pytest.importorskip("numba")

from ce_gym.numba import controller, stepper  # noqa: E402


@numba.njit
def track(k, q, v, target):
    """Torques of robot k that track target positions, with gains of its own."""
    for i in range(len(target)):
        target[i] = (20.0 + k) * (target[i] - q[7 + i]) - 0.5 * v[6 + i]


@pytest.fixture(scope="module")
def model() -> Model:
    return Model("mini_cheetah")


@pytest.mark.parametrize(
    ("num_envs", "num_threads", "dtype"), [(1, 1, "float64"), (21, 3, "float64"), (5, 1, "float32")]
)
def test_bits(model, num_envs, num_threads, dtype):
    options = {"num_envs": num_envs, "dtype": dtype, "control": "torque"}
    inside = Simulator(model, num_threads=num_threads, controller=controller(track, dtype), **options)
    outside = Simulator(model, **options)
    rng = np.random.default_rng(0)
    for n in (3, 1, 0, 5):
        command = (model.standing_q[7:] + rng.normal(0, 0.2, (num_envs, 12))).astype(dtype)
        inside.step(command, n)
        for _ in range(n):
            q, v, target = outside.q, outside.v, command.copy()
            for k in range(num_envs):
                track(k, q[k], v[k], target[k])
            outside.step(target)
        for name in ("q", "v", "torque", "contact_forces"):
            assert np.array_equal(getattr(inside, name), getattr(outside, name))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda sim: pickle.loads(pickle.dumps(sim))])
def test_copies(model, copied):
    sim = Simulator(model, 2, control="torque", controller=controller(track))
    sim.step(model.standing_q[7:], 3)
    again = copied(sim)
    for simulator in (sim, again):
        simulator.step(model.standing_q[7:], 3)
    assert np.array_equal(sim.q, again.q)


def test_what_cannot_have_a_controller(model):
    with pytest.raises(ValueError, match=r"controller=.*expected the result of ce_gym.numba.controller"):
        Simulator(model, controller=track)
    with pytest.raises(ValueError, match="dtype='float32'"):
        Simulator(model, dtype="float32", controller=controller(track))
    sim = Simulator(model, controller=controller(track))
    for use in (StepDerivatives, stepper):
        with pytest.raises(ValueError, match="controller"):
            use(sim)
