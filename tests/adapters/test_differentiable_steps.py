"""Steps as functions of torch tensors and of JAX arrays: gradients against differences."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from ball_joints import with_balls
from small_mechanisms import ball
from tripod import TRIPOD

from ce_gym import Model, Simulator, Terrain


def free_leg(dtype: str = "float64") -> Simulator:
    model, rng = Model("planar_leg_linkage"), np.random.default_rng(0)
    sim = Simulator(model, 3, dtype=dtype)
    sim.set_state(model.standing_q + rng.normal(0, 0.1, (3, 2)), rng.normal(0, 1, (3, 2)))
    return sim


def test_gradients_of_coordinates_are_those_of_the_tangent_space():
    import casadi as ca

    from ce_gym.adapters.pure_steps import from_tangent, to_tangent
    from ce_gym.dynamics.algebra.integration import tangent_basis
    from ce_gym.model.coordinates import Layout

    layout = Layout(floating=True, balls=1, joints=2)
    rng, symbol = np.random.default_rng(1), ca.SX.sym("q", layout.nq)
    q, tangent = rng.normal(size=(4, layout.nq)), rng.normal(size=(4, layout.nv))
    for i, _ in layout.turns:
        q[:, i : i + 4] /= np.linalg.norm(q[:, i : i + 4], axis=1, keepdims=True)
    basis = ca.Function("basis", [symbol], [tangent_basis(symbol, layout)])
    gradient = from_tangent(q, tangent, layout)
    for row in range(4):
        here = np.array(basis(q[row]))
        np.testing.assert_allclose(here.T @ gradient[row], tangent[row], atol=1e-12)
        np.testing.assert_allclose(to_tangent(q[[row]], gradient[[row]], layout)[0], tangent[row], atol=1e-12)
    for i, _ in layout.turns:
        np.testing.assert_allclose((gradient[:, i : i + 4] * q[:, i : i + 4]).sum(1), 0, atol=1e-12)


def test_torch_gradcheck():
    torch = pytest.importorskip("torch")
    from ce_gym.adapters.torch import Steps

    steps = Steps(free_leg(), n_substeps=3, keep_every=2)
    start = steps.state()
    target = torch.from_numpy(np.tile(steps._pure.simulator.model.standing_q, (3, 1)))

    def after_two_calls(target, *parts):
        state = steps(dict(zip(start, parts, strict=True)), target)
        return tuple(steps(state, target + 0.01).values())

    given = [x.clone().requires_grad_() for x in (target, *start.values())]
    assert torch.autograd.gradcheck(after_two_calls, given, atol=1e-6)


def test_torch_leaves_steps_without_gradients_alone():
    torch = pytest.importorskip("torch")
    from ce_gym.adapters.torch import Steps

    sim = free_leg("float32")
    steps = Steps(sim)
    after = steps(steps.state(), torch.zeros(3, 2))
    assert not any(part.requires_grad for part in after.values())
    assert after["q"].dtype == torch.float32
    np.testing.assert_array_equal(after["q"].numpy(), sim.q)


def test_jax_gradients():
    jax = pytest.importorskip("jax")
    from ce_gym.adapters.jax import make_steps

    jax.config.update("jax_enable_x64", True)
    sim = free_leg()
    steps, start = make_steps(sim, n_substeps=3)
    target = np.tile(sim.model.standing_q, (3, 1))

    @jax.jit
    def loss(state, target):
        after = steps(steps(state, target), target)
        return sum((part**2).sum() for part in after.values())

    by_state, by_target = jax.grad(loss, argnums=(0, 1))(start, target)
    for found, given, put in (
        (by_state["v"], start["v"], lambda x: loss({**start, "v": x}, target)),
        (by_target, target, lambda x: loss(start, x)),
    ):
        change = np.random.default_rng(3).normal(size=given.shape) * 1e-6
        slope = float(put(given + change) - put(given - change)) / 2
        assert abs(float((found * change).sum()) - slope) < 1e-6 * abs(slope)


def make_jax_steps(sim: Simulator, n_substeps: int = 1):
    """Return jax and the result of `make_steps`."""
    jax = pytest.importorskip("jax")
    pytest.importorskip("numba")
    from ce_gym.adapters.jax import make_steps

    jax.config.update("jax_enable_x64", True)
    steps, start = make_steps(sim, n_substeps)
    return jax, steps, start


@pytest.mark.parametrize(("robot", "num_envs"), [(TRIPOD, 1), (TRIPOD, 35), (ball(), 8), (with_balls(True), 11)])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_jax_steps_have_the_bits_of_the_simulator(robot, num_envs, dtype):
    model, rng = Model(robot), np.random.default_rng(num_envs)
    terrain = Terrain(rng.uniform(0.0, 0.02, (20, 24)), 0.1, (-1.0, -1.0)) if robot == TRIPOD and num_envs > 8 else None
    sim = Simulator(model, num_envs, dtype=dtype, parameters=("gravity",), terrain=terrain)
    targets = rng.normal(0, 0.2, (num_envs, len(sim.target_names))).astype(dtype)
    sim.step(targets, 10)
    jax, steps, start = make_jax_steps(sim, 3)
    sim.set_parameter("gravity", rng.uniform(-9, -2, (num_envs, 3)))
    after = steps(jax.jit(steps)(start, targets), targets)
    np.testing.assert_array_equal(sim.q, start["q"])  # the simulator has not moved
    sim.step(targets, 6)
    assert np.abs(sim.v - start["v"]).max() > 1e-3
    for name, rows in after.items():
        np.testing.assert_array_equal(rows, sim._batch.rows(name), err_msg=name)


def test_jax_steps_scale_quaternions_and_give_nan_for_invalid_robots():
    sim = Simulator(Model(with_balls(True)), 6)
    _, steps, start = make_jax_steps(sim)
    q, target = start["q"].copy(), np.zeros((6, len(sim.target_names)))
    q[0, 3:7] *= 1.0005
    q[1, 7:11] *= 0.9995
    q[2, 3:7] *= 1.002
    q[3, -5] = np.nan
    target[4, 0] = np.inf
    after = steps({**start, "q": q}, target)
    expected = steps(start, np.zeros_like(target))
    for name, rows in after.items():
        valid = np.array([0, 1, 5])
        np.testing.assert_allclose(rows[valid], expected[name][valid], rtol=1e-12, atol=1e-14)
        assert np.isnan(rows[2:5]).all()


def test_jax_steps_of_other_shapes_and_types_are_refused():
    _, steps, start = make_jax_steps(free_leg())
    with pytest.raises(
        ValueError, match=r"^q is float32 \(3, 2\); expected float64 \(3, 2\); float64 needs jax_enable_x64"
    ):
        steps({**start, "q": start["q"].astype("float32")}, np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"^target is float64 \(2,\); expected float64 \(3, 2\)"):
        steps(start, np.zeros(2))


def test_jax_steps_in_batches_and_threads():
    jax, steps, start = make_jax_steps(free_leg(), 20)
    steps = jax.jit(steps)
    targets = np.random.default_rng(2).normal(size=(8, 3, 2))
    each = [steps(start, target)["q"] for target in targets]
    np.testing.assert_array_equal(jax.vmap(steps, (None, 0))(start, targets)["q"], each)
    with ThreadPoolExecutor(4) as threads:
        for _ in range(20):
            np.testing.assert_array_equal(list(threads.map(lambda target: steps(start, target)["q"], targets)), each)


def test_jax_steps_of_one_thread_call_no_python():
    for num_threads in (1, 2):
        jax, steps, start = make_jax_steps(Simulator(Model("planar_leg_linkage"), num_threads=num_threads))
        text = jax.jit(steps).lower(start, np.zeros((1, 2))).as_text()
        assert ("callback" in text) == (num_threads > 1)


def test_state_passes_to_torch_without_a_copy():
    torch, numba = pytest.importorskip("torch"), pytest.importorskip("ce_gym.numba")
    sim = free_leg()
    shared = torch.from_dlpack(numba.stepper(sim)[0].q)
    sim.reset()
    np.testing.assert_array_equal(shared[0, :, 2], sim.q[2])
