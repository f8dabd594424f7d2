"""Quaternions that come in: scaled where they are nearly of unit length, refused where they are not, bits kept.

The oracle is the same quantity at a quaternion that numpy has scaled.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_joints import random_state, with_balls

from ce_gym import Model, Simulator, StepDerivatives
from ce_gym.adapters.pure_steps import PureSteps
from ce_gym.model import Pose
from ce_gym.model.coordinates import unit_quaternions

SMALL, LARGE = 1.0008, 0.97
PLACES = (3, 7, 11, 15)  # the base and three ball joints


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(with_balls(floating=True, stiffness=3.0, damping=0.1))


def scaled(q: np.ndarray, *factors: float) -> np.ndarray:
    """Each quaternion times a factor of its own."""
    q = q.copy()
    for place, factor in zip(PLACES, factors, strict=True):
        q[..., place : place + 4] *= factor
    return q


def states(model: Model, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    each = [random_state(model.robot, seed) for seed in range(int(np.prod(shape)))]
    q, v = (np.array(rows).reshape(*shape, -1) for rows in zip(*each, strict=True))
    return q, v


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (2, 1, 3)])
def test_quantities_are_those_of_the_scaled_quaternions(model: Model, shape):
    q, v = states(model, shape)
    off, tau = scaled(q, SMALL, 1 / SMALL, 1.0003, 1.0), np.ones_like(v)
    quantities = {
        "forward_dynamics": lambda q: model.forward_dynamics(q, v, tau),
        "inverse_dynamics": lambda q: model.inverse_dynamics(q, v, tau),
        "mass_matrix": model.mass_matrix,
        "energy": lambda q: np.stack(model.energy(q, v)),
        "rotations": lambda q: model.body_poses(q)[1],
        "spanning": lambda q: model.spanning(q, v)[0],
        "derivatives": lambda q: model.forward_dynamics_derivatives(q, v, tau)[0],
        "product": lambda q: model.derivatives("bias_force", ["q"]).product(q, v, directions={"q": v})["tau"],
        "from_spanning": lambda q: model.from_spanning(*model.spanning(q, v))[0],
    }
    for name, quantity in quantities.items():
        np.testing.assert_allclose(quantity(off), quantity(q), rtol=1e-9, atol=1e-9, err_msg=name)
    q_span, v_span = model.spanning(q, v)
    for rows, _ in model.robot.spanning_rows.values():
        q_span[..., list(rows)[-4:]] *= SMALL if len(rows) > 1 else 1.0
    np.testing.assert_allclose(model.from_spanning(q_span, v_span)[0], q, atol=1e-12)


def test_what_is_of_unit_length_keeps_its_bits(model: Model):
    q, _ = states(model, (500,))
    first = [i for i, _ in model.robot.layout.turns]
    assert unit_quaternions(q, first) is q
    single = q.astype(np.float32)
    assert unit_quaternions(single, first, dtype="float32") is single
    kept = unit_quaternions(single.astype(float), first)
    assert np.abs(np.linalg.norm(kept[:, 3:7], axis=1) - 1).max() < 1e-15
    q[4, 3:7] *= 1.0005  # one of many: the others keep theirs
    result = unit_quaternions(q, first)
    np.testing.assert_array_equal(np.delete(result, 4, 0), np.delete(q, 4, 0))
    q[4, 3:7] = np.nan
    np.testing.assert_array_equal(unit_quaternions(q, first), q)


@pytest.mark.parametrize(("factor", "norm"), [(LARGE, "0.97"), (1.0011, "1.001"), (0.0, "0"), (-2.0, "2")])
def test_others_are_refused_in_one_line(model: Model, factor: float, norm: str):
    """By entry, norm and remedy; -1 is as good as 1."""
    q, v = states(model, (2, 3))
    q[1, 2, 7:11] = [0.0, factor, 0.0, 0.0]
    for call in (lambda: model.mass_matrix(q), lambda: model.dependent_guess(q), lambda: model.energy(q, v[0, 0])):
        with pytest.raises(ValueError, match="divide it by its norm") as caught:
            call()
        message = str(caught.value)
        assert "\n" not in message
        assert f"q[1, 2, 7:11] has norm {norm}; expected" in message
    q[1, 2, 7] = 0.0
    q[1, 2, 8] = -1.0
    model.mass_matrix(q)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_simulators_take_them_in_by_every_door(model: Model, dtype: str):
    """States, snapshots and states of derivatives; steps go on as from the scaled ones."""
    n, rounding = 3, 1e-5 if dtype == "float32" else 1e-12
    q, v = states(model, (n,))
    off, first, second = scaled(q, SMALL, 1.0, 1 / SMALL, 1.0002), *(Simulator(model, n, dtype=dtype) for _ in range(2))
    second.set_state(q, v)
    begin, result = second.snapshot(), []
    first.set_state(off, v)
    for sim in (first, second):
        sim.step(model.standing_q[-2:], 3)
        result.append(sim.q)
    np.testing.assert_allclose(*result, atol=rounding)
    first.restore({**begin, "q": off.astype(dtype)})
    first.step(model.standing_q[-2:], 3)
    np.testing.assert_allclose(first.q, result[1], atol=rounding)
    derivatives = StepDerivatives(first)
    derivatives.restore({"q": off, "v": v})
    np.testing.assert_allclose(first.q, q, atol=rounding)
    first.restore(begin)
    np.testing.assert_array_equal(first.q, begin["q"])
    bad = scaled(q, 1.0, LARGE, 1.0, 1.0)
    for call in (
        lambda: first.set_state(bad, v),
        lambda: first.restore({**begin, "q": bad.astype(dtype)}),
        lambda: derivatives.restore({"q": bad}),
    ):
        with pytest.raises(ValueError, match=r"^(snapshot: )?q\[0, 7:11\] has norm 0.97"):
            call()
        np.testing.assert_array_equal(first.q, begin["q"])


def test_standing_poses_are_scaled_or_refused():
    robot, turned = with_balls(floating=False), np.array([0.8, 0.0, 0.6, 0.0])
    stands = Model(replace(robot, pose=Pose(balls=(("c", tuple(turned * 1.0004)),))))
    np.testing.assert_allclose(stands.standing_q[4:8], turned, atol=1e-15)
    with pytest.raises(ValueError, match=r"pose\.balls\.c"):
        Model(replace(robot, pose=Pose(balls=(("c", tuple(turned * 1.01)),))))


def test_gradients_of_pure_steps_are_with_respect_to_the_quaternion_that_was_given(model: Model):
    """Against central differences, at a norm of 0.9995."""
    steps = PureSteps(Simulator(model, 1))
    q, v = states(model, (1,))
    state = {**steps.state(), "q": scaled(q, 0.9995, 1.0, 0.9995, 1.0), "v": 0.3 * v}
    target, size = model.standing_q[None, -2:], 1e-6
    weights = {name: np.zeros_like(rows) for name, rows in state.items()}
    weights["q"][0, :19] = np.linspace(1, 2, 19)
    _, recorded = steps.forward(state, target)
    found = steps.backward(recorded, weights)[0]["q"][0, :19]
    for i in range(19):
        change = size * np.eye(model.nq)[i]
        ends = [steps.forward({**state, "q": state["q"] + s * change}, target, record=False)[0]["q"] for s in (1, -1)]
        slope = (ends[0] - ends[1])[0, :19] @ weights["q"][0, :19] / (2 * size)
        assert found[i] == pytest.approx(slope, rel=1e-5, abs=1e-5)
