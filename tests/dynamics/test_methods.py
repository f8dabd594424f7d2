"""Time-stepping methods: the order of each, conserved quantities, and friction within a step."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.contacts import TWO_LOADS
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, LinearConstraint, Placement, Robot


def swinging_robot() -> Robot:
    """A free trunk with a two-link arm, the second link driven through a rotor on the first."""

    def link(name: str, parent: str, axis, at, kind="link", inertia=(0.01, 0.012, 0.004), mass=0.8) -> Body:
        tensor = tuple(tuple(row) for row in np.diag(inertia))
        joint = Joint("revolute", axis, damping=0.02)
        return Body(name, kind, parent, Placement(position=at), joint, Inertial(mass, (0.0, 0.02, -0.1), tensor))

    trunk = Body(
        "trunk",
        "link",
        None,
        Placement(),
        Joint("free"),
        Inertial(3.0, (0.01, 0.0, 0.02), np.diag((0.02, 0.05, 0.04)).tolist()),
    )
    rotor = Body(
        "rotor", "rotor", "upper", Placement(position=(0.0, 0.05, 0.0)), Joint("revolute", (1.0, 0.0, 0.0)),
        Inertial(0.2, (0.0, 0.0, 0.0), np.diag((1e-4, 6e-5, 6e-5)).tolist()),
    )  # fmt: skip
    bodies = (trunk, link("upper", "trunk", (0.0, 1.0, 0.0), (0.1, 0.0, 0.0)), rotor)
    bodies += (link("lower", "upper", (1.0, 0.0, 0.0), (0.0, 0.0, -0.25)),)
    gear = LinearConstraint("gear", (("rotor", 1.0), ("lower", -7.0)))
    return Robot("swing", bodies, (gear,), ("upper", "lower"))


def run(method: str, dt: float, time: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    model = Model(swinging_robot())
    step = step_function(model.mechanism, StepOptions(dt, control="torque", method=method))
    start = ca.vertcat(
        *[0.0, 0.0, 0.0], *(np.array([0.9, 0.1, -0.3, 0.2]) / np.linalg.norm([0.9, 0.1, -0.3, 0.2])), 0.3, -0.4
    )
    v = ca.DM([1.0, -2.0, 3.0, 0.5, 0.2, -0.1, 2.0, -3.0])
    path = step.mapaccum("path", round(time / dt), ["q", "v", "diverged"], ["q_next", "v_next", "diverged_next"])
    end = path(q=start, v=v, diverged=0.0, target=ca.DM([0.3, -0.2]))
    return end["q_next"].full()[:, -1], end["v_next"].full()[:, -1]


@pytest.mark.parametrize("method", METHODS)
def test_a_length_that_is_an_input_makes_the_same_step(method: str):
    """Stages of length 0 too: they divide by no symbol that happens to be 0."""
    mechanism, options = Model(swinging_robot()).mechanism, StepOptions(0.01, control="torque", method=method)
    fixed, free = step_function(mechanism, options), step_function(mechanism, replace(options, dt=None))
    given = {"q": ca.DM([0, 0, 0, 0.8, 0, 0.6, 0, 0.3, -0.4]), "v": ca.DM([1, -2, 3, 0.5, 0.2, -0.1, 2, -3])}
    given |= {"diverged": 0.0, "target": ca.DM([0.3, -0.2])}
    expected, found = fixed(**given), free(**given, dt=0.01)
    assert not expected["diverged_next"]
    for name in ("q_next", "v_next", "diverged_next"):
        np.testing.assert_allclose(found[name].full(), expected[name].full(), rtol=1e-12, atol=1e-14)


@pytest.fixture(scope="module")
def exact() -> tuple[np.ndarray, np.ndarray]:
    return run("rk8", 0.4 / 128)


def distance(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
    return float(np.linalg.norm(np.concatenate(a) - np.concatenate(b)))


@pytest.mark.parametrize("method", METHODS)
def test_order(method: str, exact):
    """The error falls at least with the power of the step length that the method promises."""
    coarsest = {1: 0.002, 2: 0.01, 4: 0.02, 8: 0.1}[METHODS[method].order]
    errors = [distance(run(method, coarsest / 2**i), exact) for i in range(3)]
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert slopes[-1] > METHODS[method].order - 0.3, errors


def test_extrapolation_keeps_its_order_where_a_foot_slides_and_turns():
    """Friction uses the load of the previous step, with the same error in the whole step and in its halves."""
    material = ContactMaterial(1e4, 100.0, 0.5, 1e-3)
    inertial = Inertial(1.0, (0.0, 0.0, 0.0), ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01)))
    rod = Body("rod", "link", None, Placement(), Joint("free"), inertial)
    foot = ContactSphere("foot", "rod", (0.0, 0.0, -0.3), 0.02)
    model = Model(Robot("sliding_rod", (rod,), contacts=(foot,), material=material))
    start = {"q": ca.DM([0, 0, 0.319, 1, 0, 0, 0]), "v": ca.DM([0, 5.0, 0, -0.3, 0, 0]), "load": ca.DM([10.0])}

    def end(dt: float) -> np.ndarray:
        options = StepOptions(dt, control="torque", contacts=("foot",), material=material, method="extrapolated")
        step = step_function(model.mechanism, options)
        names = [name for name in step.name_in() if f"{name}_next" in step.name_out()]
        path = step.mapaccum("path", round(0.02 / dt), names, [f"{name}_next" for name in names])
        given = {name: start.get(name, ca.DM.zeros(step.size1_in(name))) for name in names}
        return path(**given | {"whole_load": start["load"]})["v_next"].full()[:, -1]

    exact = end(2e-6)
    assert exact[3] - 0.3 * exact[1] < -0.5  # it slides to the end
    errors = [np.abs(end(dt) - exact).max() for dt in (2e-4, 1e-4, 5e-5)]
    assert np.log2(errors[0] / errors[2]) / 2 == pytest.approx(2, abs=0.3), errors


def test_both_loads_are_there_where_a_stage_asks_for_them():
    asked = {name for name, plan in METHODS.items() for stage in plan.stages if stage.load == "whole_load"}
    assert asked == set(TWO_LOADS)


def test_reference_agrees_with_another_method(exact):
    assert distance(run("rk4", 0.4 / 1024), exact) < 1e-9


def test_error_estimate_of_the_extrapolated_step():
    """It is of the size of the error of two Euler steps."""
    model = Model(swinging_robot())
    q = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.3, -0.4])
    v, target = np.array([1.0, -2.0, 3.0, 0.5, 0.2, -0.1, 2.0, -3.0]), np.array([0.3, -0.2])
    ends = {}
    for method, dt, n in (("rk8", 0.002, 1), ("extrapolated", 0.002, 1), ("euler", 0.001, 2)):
        step = step_function(model.mechanism, StepOptions(dt, control="torque", method=method), ("error",))
        state = {"q": q, "v": v, "diverged": 0.0}
        for _ in range(n):
            result = step(**state, target=target)
            state = {name: result[f"{name}_next"] for name in state}
        ends[method] = np.array(state["v"]).ravel(), float(result["error"])
    true_error = np.linalg.norm(ends["euler"][0] - ends["rk8"][0])
    assert 0.5 < ends["extrapolated"][1] / true_error < 2
    assert np.linalg.norm(ends["extrapolated"][0] - ends["rk8"][0]) < true_error / 50


@pytest.mark.parametrize("method", METHODS)
def test_free_flight_keeps_its_momentum(method: str):
    """The centre of mass of a spinning body moves on a straight line, whatever the method."""
    robot = replace(
        swinging_robot(), gravity=(0.0, 0.0, 0.0), bodies=swinging_robot().bodies[:1], constraints=(), independent=()
    )
    model = Model(robot)
    step = step_function(model.mechanism, StepOptions(0.01, control="torque", method=method))
    state = {
        "q": np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
        "v": np.array([3.0, -2.0, 5.0, 0.4, 0.2, -0.3]),
        "diverged": 0.0,
    }
    for _ in range(100):
        result = step(**state)
        state = {name: result[f"{name}_next"].full().ravel() for name in ("q", "v", "diverged")}
    assert abs(np.linalg.norm(state["q"][3:7]) - 1) < 1e-12
