"""The simulator: determinism, agreement with the traced step, failure of one lane, bad arguments."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator, StepDerivatives
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import ContactMaterial
from ce_gym.model.mechanism import LEVELS

DTYPES = ("float64", "float32")


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(TRIPOD)


@pytest.fixture(scope="module")
def start(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return near_the_ground(model)


def near_the_ground(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and targets of 40 robots, some with feet in the ground."""
    rng, joints = np.random.default_rng(0), len(model.joint_links)
    q = np.tile(model.standing_q, (40, 1))
    q[:, 2] += rng.uniform(-0.01, 0.05, 40)
    q[:, 7:] += rng.normal(0, 0.2, (40, joints))
    v = rng.normal(0, 0.5, (40, model.nv))
    return q, v, q[:, 7:] + rng.normal(0, 0.2, (40, joints))


def run(model: Model, start, rows=slice(None), threads: int = 1, dtype: str = "float64", n_substeps: int = 10, **more):
    q, v, target = (x[rows] for x in start)
    sim = Simulator(model, len(q), num_threads=threads, dtype=dtype, **more)
    sim.set_state(q, v)
    sim.step(target, n_substeps)
    return sim


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "level", "method"),
    [
        *((TRIPOD, level, "euler") for level in LEVELS),
        (TRIPOD, "exact", "extrapolated"),
        ("mini_cheetah", "exact", "euler"),
    ],
)
def test_kernel_follows_the_traced_step(robot: str, level: str, method: str):
    model = Model(robot, level)
    start = near_the_ground(model)
    outputs = ("torque", "contact_forces", "motor_speed", *(["error"] if method == "extrapolated" else []))
    sim = run(model, start, method=method, outputs=outputs)
    function = step_function(model.mechanism, replace(sim.options, dt=sim.dt), outputs)
    q, v, target = start
    for i in (0, 7, 39):
        n = len(sim.contact_names)
        resting = sim._resting_load(q[i])
        loads = (resting, resting) if method == "extrapolated" else (resting,)
        state = (q[i], v[i], *loads, np.zeros(2 * n), 0.0)
        for _ in range(10):
            results = [np.array(result).ravel() for result in function(*state, target[i])]
            state, told = results[: len(state)], dict(zip(outputs, results[len(state) :], strict=True))
        np.testing.assert_allclose(sim.q[i], state[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(sim.v[i], state[1], rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(sim.torque[i], told["torque"], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(sim.contact_forces[i].ravel(), told["contact_forces"], rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(sim.motor_speed[i], told["motor_speed"], rtol=1e-6, atol=1e-6)
        if "error" in told:
            np.testing.assert_allclose(sim.error[i], told["error"], rtol=1e-6)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_results_do_not_depend_on_batch_or_threads(model: Model, start, dtype: str):
    whole = run(model, start, threads=1, dtype=dtype)
    threaded = run(model, start, threads=2, dtype=dtype)
    for name in ("q", "v", "contact_forces"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(threaded, name))
    for rows in (slice(0, 1), slice(3, 10), slice(17, 40)):
        part = run(model, start, rows, dtype=dtype)
        np.testing.assert_array_equal(part.q, whole.q[rows])
        np.testing.assert_array_equal(part.v, whole.v[rows])


def test_single_precision_follows_double(model: Model, start):
    double, single = run(model, start, n_substeps=4), run(model, start, dtype="float32", n_substeps=4)
    assert np.abs(double.q - single.q).max() < 1e-3


def test_partial_reset_leaves_the_others(model: Model, start):
    sim = run(model, start)
    before = sim.q
    mask = np.zeros(40, bool)
    mask[[3, 39]] = True
    sim.reset(mask)
    np.testing.assert_array_equal(sim.q[mask], np.tile(model.standing_q, (2, 1)))
    np.testing.assert_array_equal(sim.q[~mask], before[~mask])


def test_state_is_a_copy(model: Model):
    sim = Simulator(model, 3)
    sim.q[:] = 7.0
    np.testing.assert_array_equal(sim.q[0], model.standing_q)


@pytest.mark.slow
@pytest.mark.parametrize(("dt", "stiffness", "dtype"), [*itertools.product((0.0005, 0.01), (1e4, 1e6), DTYPES)])
def test_dropped_robots_come_to_rest(model: Model, dt: float, stiffness: float, dtype: str):
    sim = Simulator(model, 8, dt=dt, dtype=dtype, material=ContactMaterial(stiffness, 500.0, 0.8))
    q = np.tile(model.standing_q, (8, 1))
    q[:, 2] += np.linspace(0.01, 0.3, 8)
    sim.set_state(q, np.zeros(model.nv))
    sim.step(model.standing_q[7:], round(6.0 / dt))
    assert not sim.diverged.any()
    assert np.abs(sim.v).max() < 0.05
    weight = model.total_mass * 9.81
    np.testing.assert_allclose(sim.contact_forces[..., 2].sum(axis=1), weight, rtol=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs=0; expected a whole number, at least 1"),
        ({"dt": -1.0}, "dt=-1.0; expected a positive number, at most 0.1 s"),
        ({"dtype": "float16"}, "dtype='float16'; expected 'float64' or 'float32'"),
        ({"control": "velocity"}, "control='velocity'; expected 'position' or 'torque'"),
        ({"contacts": "wing"}, "contacts='wing'; expected 'all', groups or names among"),
        ({"contacts": ["nose"]}, "contacts='nose'; expected 'all', groups or names among"),
        ({"outputs": ("smell",)}, "outputs='smell'; expected one of contact_forces, torque"),
    ],
)
def test_bad_arguments(model: Model, arguments: dict, message: str):
    with pytest.raises(ValueError, match=message):
        Simulator(model, **arguments)


NO_MASKS = {
    "indices": [0, 2, 1],
    "numbers": np.array([1.0, 0.0, 1.0]),
    "NaN": [np.nan, True, False],
    "None": [None, True, False],
    "text": "all",
    "too short": np.array([True]),
    "one": True,
}


@pytest.mark.parametrize("mask", NO_MASKS.values(), ids=NO_MASKS)
def test_masks_are_truth_values(model: Model, mask):
    """Indices are not read as truth values, by any call that takes a mask."""
    sim = Simulator(model, 3, parameters=("friction",))
    before = sim.snapshot()
    for call in (
        lambda: sim.reset(mask),
        lambda: sim.set_state(model.standing_q + 0.1, np.ones(model.nv), mask),
        lambda: sim.set_parameter("friction", 0.1, mask),
    ):
        with pytest.raises(ValueError, match=r"^mask=.*; expected a bool array of shape \(3,\)$"):
            call()
    for name, rows in sim.snapshot().items():
        np.testing.assert_array_equal(rows, before[name])
    sim.reset([True, False, True])


NO_NUMBERS = {
    "complex": np.zeros(2) + 1j,
    "text": np.array(["0.1", "0.2"]),
    "dates": np.zeros(2, "datetime64[s]"),
    "truth values": np.array([True, False]),
    "fields": np.zeros(2, [("a", float)]),
    "objects": [None, 1.0],
    "ragged": [[1.0], [1.0, 2.0]],
}


@pytest.mark.parametrize("values", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_what_is_no_real_number_is_refused(model: Model, values):
    sim = Simulator(model, 2, parameters=("kp",))
    derivatives = StepDerivatives(sim)
    for name, call in {
        "target": lambda: sim.step(values),
        "q": lambda: sim.set_state(values, np.zeros(model.nv)),
        "v": lambda: sim.set_state(model.standing_q, values),
        "kp": lambda: sim.set_parameter("kp", values),
        "load": lambda: derivatives.restore({"load": values}),
    }.items():
        with pytest.raises(ValueError, match=f"^{name} is .*; expected an array of real numbers"):
            call()
    for call in (derivatives.step, lambda x: derivatives.gradient(x, {}), derivatives.linearize):
        with pytest.raises(ValueError, match=r"^target is .*; expected an array of real numbers"):
            call(values)


def test_bad_states_and_targets(model: Model):
    sim = Simulator(model, 2)
    with pytest.raises(ValueError, match=r"target has shape \(3,\); expected \(2,\) or \(2, 2\)"):
        sim.step(np.zeros(3))
    with pytest.raises(ValueError, match="q has shape"):
        sim.set_state(np.zeros(5), np.zeros(model.nv))
    with pytest.raises(ValueError, match="v holds a number that is not finite"):
        sim.set_state(model.standing_q, np.full(model.nv, np.nan))
    with pytest.raises(ValueError, match="torque is not computed"):
        _ = Simulator(model, 2, outputs=()).torque


def test_fixed_base_robot_without_ground():
    """The leg swings under gravity: torque control, no contacts, energy hardly drifts."""
    leg = Model("mit_humanoid_leg")
    sim = Simulator(leg, 1, dt=1e-4, control="torque", contacts=(), outputs=())
    sim.set_state(np.full(leg.nq, 0.3), np.zeros(leg.nv))
    before = sum(leg.energy(sim.q, sim.v))[0]
    sim.step(np.zeros(leg.nv), 2000)
    after = sum(leg.energy(sim.q, sim.v))[0]
    assert abs(after - before) < 0.01 * abs(leg.energy(sim.q, sim.v)[0][0] + 1.0)


@pytest.mark.parametrize("n", [-1, 2.5, "3", True, None], ids=repr)
def test_a_number_of_sub_steps_that_is_none(model: Model, n):
    sim = Simulator(model, 2)
    with pytest.raises(ValueError, match=r"^n_substeps=.*; expected a whole number, at least 0$"):
        sim.step(model.standing_q[7:], n)
    assert (sim.q == model.standing_q).all()


def test_no_sub_steps_change_nothing(model: Model):
    sim = Simulator(model, 2)
    sim.step(model.standing_q[7:], 3)
    q, v, forces = sim.q, sim.v, sim.contact_forces
    sim.step(model.standing_q[7:] + 0.1, np.int64(0))
    for before, after in ((q, sim.q), (v, sim.v), (forces, sim.contact_forces)):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize(("dtype", "figure"), [("float64", np.inf), ("float64", np.nan), ("float32", 1e300)])
@pytest.mark.filterwarnings("ignore:overflow")
def test_targets_and_states_that_are_not_finite_change_nothing(model: Model, dtype: str, figure: float):
    sim = Simulator(model, 2, dtype=dtype)
    q, v, target = sim.q.astype(float), sim.v.astype(float), np.tile(model.standing_q[7:], (2, 1))
    target[1, 1] = figure
    with pytest.raises(ValueError, match=f"^target holds a number that is not finite in {dtype}$"):
        sim.step(target)
    v[1, 3] = figure
    with pytest.raises(ValueError, match=f"^v holds a number that is not finite in {dtype}$"):
        sim.set_state(q + 0.1, v)
    np.testing.assert_array_equal(sim.q, q)
    assert not sim.diverged.any()
