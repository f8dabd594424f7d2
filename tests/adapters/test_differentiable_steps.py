"""Steps as functions of torch tensors and of JAX arrays: gradients against differences."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym import Model, Simulator


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
