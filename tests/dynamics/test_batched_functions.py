"""Kernels of quantities give what CasADi's interpreter gives: all quantities, batch shapes, dtypes, thread counts."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest
from ball_joints import with_balls
from linkages import spatial_four_bar

from ce_gym import Model
from ce_gym.dynamics import batched_function
from ce_gym.dynamics.functions import FUNCTIONS
from ce_gym.dynamics.quantities.frames import CONTACT_FUNCTIONS, FRAME_FUNCTIONS
from ce_gym.model import Body, Inertial, Joint, Placement, Robot

MODELS = {
    "floating": lambda **options: Model("mini_cheetah", **options),
    "loops": lambda **options: Model("tello", **options),
    "balls": lambda **options: Model(with_balls(floating=True, stiffness=3.0, damping=0.1), **options),
    "no formula": lambda **options: Model(spatial_four_bar(), **options),
}
INERTIAL = Inertial(2.0, (0.1, 0.02, 0.03), ((0.02, 0.001, 0.0), (0.001, 0.03, 0.0), (0.0, 0.0, 0.04)))


def states(model: Model, batch: tuple[int, ...] = ()) -> dict[str, np.ndarray]:
    """Random inputs of all quantities, near the standing pose."""
    rng = np.random.default_rng(1)
    q = model.standing_q + rng.uniform(-0.2, 0.2, (*batch, model.nq))
    for i, _ in model.robot.layout.turns:
        q[..., i : i + 4] /= np.linalg.norm(q[..., i : i + 4], axis=-1, keepdims=True)
    sizes = {**dict.fromkeys(("v", "tau", "vdot", "dv"), model.nv), "wrenches": 6 * len(model.body_names)}
    return {
        "q": q,
        "q1": q[::-1] if batch else q,
        **{name: rng.normal(size=(*batch, size)) for name, size in sizes.items()},
    }


def interpreted(model: Model, function: ca.Function, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
    """The outputs of CasADi's interpreter at one state."""
    arguments = inputs | {"guess": model.dependent_guess(inputs["q"])}
    results = function.call([ca.DM(arguments[name]) for name in function.name_in()])
    return [np.array(ca.DM(result).full()) for result in results]


@pytest.mark.parametrize("kind", ["loops", "balls", "no formula"])
def test_kernels_agree_with_the_interpreter(kind):
    model = MODELS[kind]()
    inputs = states(model, (3,))
    for name in (*FUNCTIONS, *CONTACT_FUNCTIONS, *(f"{kind}:{model.body_names[-1]}" for kind in FRAME_FUNCTIONS)):
        function = model.casadi_function(name)
        names = [x for x in function.name_in() if x != "guess"]
        results = model.evaluate(name, *[inputs[x] for x in names])
        for k in range(3):
            state = {x: inputs[x][k] for x in names}
            single = model.evaluate(name, *state.values())
            expected = interpreted(model, function, {x: inputs[x][k] for x in inputs})
            for batch, row, right in zip(results, single, expected, strict=True):
                assert np.array_equal(batch[k], row), name
                scale = np.abs(right).max(initial=1.0)
                np.testing.assert_allclose(row, right, rtol=0, atol=1e-11 * scale, err_msg=name)


def test_a_single_row_may_be_a_list_and_is_not_kept():
    model = MODELS["floating"]()
    inputs = states(model)
    v, vdot = [0] * model.nv, inputs["vdot"]
    first = model.inverse_dynamics(inputs["q"], v, vdot)
    kept = first.copy()
    model.inverse_dynamics(inputs["q"], np.ones(model.nv), vdot)
    assert np.array_equal(first, kept)
    assert np.array_equal(first, model.inverse_dynamics(inputs["q"], np.zeros(model.nv), vdot))


@pytest.mark.parametrize("batch", [(0,), (1,), (9,), (2, 3), (2, 0, 3)])
def test_batches_broadcast(batch):
    model = MODELS["floating"]()
    inputs, row = states(model, batch), states(model)
    found = model.forward_dynamics(inputs["q"], row["v"], inputs["tau"])
    assert found.shape == (*batch, model.nv)
    for index in np.ndindex(batch):
        expected = model.forward_dynamics(inputs["q"][index], row["v"], inputs["tau"][index])
        assert np.array_equal(found[index], expected)


def test_threads_change_no_bits():
    inputs = states(MODELS["floating"](), (100,))
    single, several = (
        MODELS["floating"](num_threads=n).forward_dynamics(inputs["q"], inputs["v"], inputs["tau"]) for n in (1, 3)
    )
    assert np.array_equal(single, several)


@pytest.mark.parametrize("kind", ["floating", "loops", "no formula"])
def test_single_precision(kind):
    double, single = MODELS[kind](), MODELS[kind](dtype="float32")
    inputs = states(double, (20,))
    found = single.forward_dynamics(inputs["q"], inputs["v"], inputs["tau"])
    assert found.dtype == single.mass_matrix(inputs["q"][0]).dtype == np.float32
    expected = double.forward_dynamics(inputs["q"], inputs["v"], inputs["tau"])
    assert 1e-9 < np.abs(found - expected).max() / np.abs(expected).max() < 1e-4


def test_long_functions_are_interpreted_at_first(monkeypatch):
    monkeypatch.setattr(batched_function, "LONG", 100)
    monkeypatch.setattr(batched_function, "INTERPRETED", 12)
    for kind in ("balls", "no formula"):
        model, compiled = MODELS[kind](), MODELS[kind]()
        inputs = states(model, (10,))
        inputs["q"] *= 1 + 1e-5 * bool(model.robot.layout.turns)
        results = []
        for _ in range(3):
            results.append(model.mass_matrix(inputs["q"]))
            batched = model._batched_function("mass_matrix")
            assert ("kernel" in vars(batched)) == (len(results) == 3)
        monkeypatch.setattr(batched_function, "LONG", 10**9)
        assert np.array_equal(results[2], compiled.mass_matrix(inputs["q"]))
        monkeypatch.setattr(batched_function, "LONG", 100)
        assert np.array_equal(results[0], results[1])
        np.testing.assert_allclose(results[0], results[2], rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["floating", "loops", "balls", "no formula"])
@pytest.mark.parametrize("compiled", [True, False])
def test_rows_of_numbers_that_are_not_finite(kind, compiled, monkeypatch):
    """All results of a robot are nan, those that do not depend on the wrong number, too; others keep their bits."""
    monkeypatch.setattr(batched_function, "LONG", batched_function.LONG if compiled else 0)
    model = MODELS[kind]()
    base = model.body_names[0]
    for name in ("mass_matrix", "bias_force", "energy", f"frame_jacobian:{base}", f"frame_pose:{base}"):
        inputs = states(model, (3,))
        names = [x for x in model.casadi_function(name).name_in() if x != "guess"]
        expected = model.evaluate(name, *[inputs[x] for x in names])
        inputs["q"][1, -1] = np.nan if model.robot.floating else np.inf
        found = model.evaluate(name, *[inputs[x] for x in names])
        for result, right in zip(found, expected, strict=True):
            assert np.isnan(result[1]).all(), name
            assert np.array_equal(result[[0, 2]], right[[0, 2]])
        single = model.evaluate(name, *[inputs[x][1] for x in names])
        assert all(np.isnan(result).all() for result in single)


def test_robots_without_joints_and_contacts():
    model = Model(Robot("lump", (Body("base", "link", None, Placement(), Joint("free"), INERTIAL),)))
    q, v = model.standing_q, np.ones(6)
    assert model.contact_points(q, v)[0].shape == (0, 3)
    assert model.contact_points(np.tile(q, (4, 1)), v)[0].shape == (4, 0, 3)
    assert model.implicit_constraint(q, v)[0].shape == (0, 6)
    np.testing.assert_allclose(model.mass_matrix(q)[3:, 3:], 2.0 * np.eye(3))


def test_a_used_model_can_be_pickled():
    model = MODELS["no formula"]()
    inputs = states(model)
    expected = model.mass_matrix(inputs["q"])
    assert np.array_equal(pickle.loads(pickle.dumps(model)).mass_matrix(inputs["q"]), expected)


def test_wrong_arguments_are_refused():
    model = MODELS["floating"]()
    q, v = model.standing_q, np.zeros(model.nv)
    with pytest.raises(ValueError, match=r"bias_force: 1 arguments; expected q, v$"):
        model.evaluate("bias_force", q)
    with pytest.raises(ValueError, match=r"bias_force: v has shape \(17,\); expected \(\.\.\., 18\)"):
        model.bias_force(q, v[1:])
    with pytest.raises(ValueError, match="dtype='float16'; expected"):
        Model("mini_cheetah", dtype="float16")
