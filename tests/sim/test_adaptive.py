"""Adaptive steps: the error meets the tolerance, robots do not affect each other, and every step ends."""

from __future__ import annotations

import copy
import pickle

import casadi as ca
import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator, StepDerivatives
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping import step_size
from ce_gym.dynamics.stepping.step_size import ALLOWED, GROWTH, SHORTEST, control_function, next_length
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.dynamics.stepping.variables import StepVariables
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot
from ce_gym.sim.schema import physics_rows
from ce_gym.sim.substeps import substeps

INTERVAL = 0.02
INERTIA = ((0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.02))


def pendulum() -> Model:
    """Two links on a fixed base, without friction."""
    inertial = Inertial(1.0, (0.0, 0.0, -0.2), INERTIA)
    joint = Joint("revolute", (0.0, 1.0, 0.0))
    bodies = (
        Body("upper", "link", None, Placement(), joint, inertial),
        Body("lower", "link", "upper", Placement((0.0, 0.0, -0.4)), joint, inertial),
    )
    return Model(Robot("pendulum", bodies, (), ("upper", "lower")))


def ball(damping: float = 0.0) -> Model:
    """One kilogram that is a sphere of 5 cm."""
    body = Body("ball", "link", None, Placement(), Joint("free"), Inertial(1.0, (0.0, 0.0, 0.0), INERTIA))
    material = ContactMaterial(1e4, damping, 0.0)
    return Model(
        Robot("ball", (body,), contacts=(ContactSphere("ball", "ball", (0.0, 0.0, 0.0), 0.05),), material=material)
    )


def falling(sim: Simulator, heights: np.ndarray) -> None:
    q = np.tile([0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0], (len(heights), 1))
    q[:, 2] += heights
    sim.set_state(q, np.zeros((len(heights), 6)))


def test_the_error_follows_the_tolerance_over_four_decades():
    """In proportion, within a factor: the estimate is of the order of the error that is left after a given time."""
    model, (q, v) = pendulum(), (np.array([1.0, -0.5]), np.array([2.0, 0.0]))
    step = step_function(model.mechanism, StepOptions(INTERVAL / 10, control="torque", method="rk8"))
    state = {"q": ca.DM(q), "v": ca.DM(v), "diverged": 0.0}
    for _ in range(250):
        result = step(**state, target=ca.DM([0.0, 0.0]))
        state = {name: result[f"{name}_next"] for name in state}
    tolerances, errors = 10.0 ** -np.arange(3, 8), []
    for tolerance in tolerances:
        sim = Simulator(model, 1, INTERVAL, method="adaptive", tolerance=tolerance, control="torque", outputs=())
        sim.set_state(q, v)
        sim.step(np.zeros(2), 25)
        errors.append(np.abs(sim.q[0] - state["q"].full().ravel()).max())
        assert not sim.steps.missed
        assert sim.steps.error <= ALLOWED * tolerance
    slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.15), errors
    assert (np.array(errors) / tolerances < 10).all(), errors
    assert (np.array(errors) / tolerances > 0.03).all(), errors


def test_balls_bounce_as_the_closed_form_says():
    """Free fall, half a period of a mass on a spring that gravity loads, free flight: without loss."""
    drop, k, g, time = np.linspace(0.1, 0.3, 32), 1e4, 9.81, 18 * INTERVAL
    speed, omega = np.sqrt(2 * g * drop), np.sqrt(k)
    fall, touch = speed / g, 2 * (np.pi - np.arctan(speed * omega / g)) / omega
    after = time - fall - touch
    assert ((after > 0) & (after < 2 * fall)).all()  # on its way up or down again
    for tolerance in (1e-2, 1e-3, 1e-4):
        sim = Simulator(ball(), len(drop), INTERVAL, method="adaptive", tolerance=tolerance, outputs=())
        falling(sim, drop)
        sim.step(np.zeros(0), 18)
        error = np.abs(sim.q[:, 2] - 0.05 - (speed * after - g * after**2 / 2))
        assert np.median(error) < 3 * tolerance
        assert error.max() < 30 * tolerance
        assert np.abs(sim.q[:, [0, 1, 4, 5, 6]]).max() < 1e-12
        assert sim.steps.refused.any()
        assert sim.steps.taken.mean() < 120  # steps of one length would have to be ten times as many at 1e-4


def test_a_robot_in_the_air_makes_few_steps_while_another_lands():
    """And those it would make alone: to the bit, whatever lane and batch."""
    heights = np.array([0.01, 1.0, 0.1, 1.0, 0.0, 0.02, 0.05, 1.0, 0.03, 1.5, 0.1])
    options = {"method": "adaptive", "tolerance": 1e-4}
    every = Simulator(ball(100.0), len(heights), INTERVAL, **options)
    falling(every, heights)
    every.step(np.zeros(0), 10)
    flying = heights >= 1
    assert np.ptp(every.steps.taken[flying]) == 0
    assert (every.steps.taken[~flying] > 1.5 * every.steps.taken[1]).all()
    assert (every.steps.refused[flying] == 0).all()
    for i, height in enumerate(heights):
        alone = Simulator(ball(100.0), 1, INTERVAL, **options)
        falling(alone, np.array([height]))
        alone.step(np.zeros(0), 10)
        for name, rows in alone.snapshot().items():
            np.testing.assert_array_equal(rows[0], every.snapshot()[name][i], err_msg=f"{name} of {i}")
    turned = Simulator(ball(100.0), len(heights), INTERVAL, num_threads=2, **options)
    falling(turned, heights[::-1])
    turned.step(np.zeros(0), 4)
    turned.step(np.zeros(0), 6)
    np.testing.assert_array_equal(turned.q[::-1], every.q)
    np.testing.assert_array_equal(turned.contact_forces[::-1], every.contact_forces)


def test_who_cannot_meet_the_tolerance_is_counted_and_goes_on():
    """In single precision rounding alone exceeds the tolerance; steps end at the shortest length."""
    heights = np.array([0.0, 1.0])
    sim = Simulator(ball(), 2, INTERVAL, "float32", method="adaptive", tolerance=1e-9, outputs=())
    falling(sim, heights)
    sim.step(np.zeros(0))
    most = 1 / SHORTEST
    assert (sim.steps.missed > 0).all()
    assert (sim.steps.taken <= most).all()
    assert (sim.steps.taken + sim.steps.refused <= 2 * most).all()
    assert not sim.diverged.any()
    np.testing.assert_allclose(sim.q[:, 2] - 0.05, heights, atol=3e-3)  # 2 mm of fall in that time


def test_who_diverges_is_frozen_and_no_step_hangs():
    sim = Simulator(ball(), 3, INTERVAL, method="adaptive", outputs=("contact_forces",))
    falling(sim, np.ones(3))
    v = np.zeros((3, 6))
    v[1] = 1e8
    sim.set_state(sim.q, v)
    sim.step(np.zeros(0), 3)
    assert sim.diverged.tolist() == [False, True, False]
    np.testing.assert_array_equal(sim.q[0], sim.q[2])
    np.testing.assert_allclose(sim.q[0, 2], 1.05 - 9.81 * (3 * INTERVAL) ** 2 / 2, rtol=1e-12)


def test_means_are_over_the_whole_interval():
    """The mean contact force is the change of momentum, through an impact in steps of many lengths."""
    sim = Simulator(ball(100.0), 1, INTERVAL, method="adaptive", tolerance=1e-5)
    falling(sim, np.array([0.01]))
    gained = 0.0
    for _ in range(5):
        before = sim.v[0, 5]
        sim.step(np.zeros(0))
        gained = sim.v[0, 5] - before
        mean = sim.contact_forces[0, 0, 2]
        assert gained == pytest.approx((mean - 9.81) * INTERVAL, abs=2e-2)
    assert sim.steps.taken > 20


def test_copies_go_on_alike():
    sim = Simulator(Model(TRIPOD), 3, INTERVAL, method="adaptive", tolerance=1e-4)
    target = sim.model.standing_q[7:] + 0.1
    sim.step(target, 3)
    copies = [
        copy.deepcopy(sim),
        pickle.loads(pickle.dumps(sim)),
        Simulator(Model(TRIPOD), 3, INTERVAL, method="adaptive", tolerance=1e-4),
    ]
    copies[-1].restore(sim.snapshot())
    for each in (sim, *copies):
        each.step(target, 3)
        np.testing.assert_array_equal(each.q, sim.q)
        np.testing.assert_array_equal(each.steps.length, sim.steps.length)
        np.testing.assert_array_equal(each.steps.taken, sim.steps.taken)


def test_a_state_that_is_set_begins_with_a_step_of_its_own():
    """Earlier steps have no effect."""
    model, target = Model(TRIPOD), Model(TRIPOD).standing_q[7:] + 0.2
    sim = Simulator(model, 1, INTERVAL, method="adaptive")
    q, v, ends = sim.q, sim.v, []
    for _ in range(2):
        sim.set_state(q, v)
        sim.step(target, 4)
        ends.append(sim.q)
    np.testing.assert_array_equal(*ends)


def test_lengths_of_steps():
    """The controller by itself: shares of an interval, growth, refusal, the shortest step."""
    left, length = ca.SX.sym("left"), ca.SX.sym("length")
    share = ca.Function("share", [left, length], [next_length(left, length)])
    assert float(share(1.0, 0.3)) == 0.25
    assert float(share(1.0, 0.95)) == 1.0  # a little longer spares a step
    assert float(share(1.0, 5.0)) == 1.0

    model = pendulum()
    step = StepVariables(model.mechanism, StepOptions(method="adaptive"))
    after = control_function(step, model.robot.layout)
    numbers = dict.fromkeys(after.name_in(), 0.0)
    numbers |= {"dt": 1.0, "left": 1.0, "trying": 0.1, "step_length": 0.1, "tolerance": 1.0, "tried_q": [1.0, 2.0]}
    numbers |= {"step_change": np.full(2, 1e3)}  # so that the change allows less than the error itself
    q = {"q": [0.0, 0.0]}

    def then(**changes):
        return {name: np.array(value).ravel() for name, value in after(**{**numbers, **q, **changes}).items()}

    good = then(tried_off=[1e-12, 0.0, 0.0])
    assert good["q_next"].tolist() == [1.0, 2.0]
    assert good["step_length_next"] == pytest.approx(0.1 * GROWTH)
    assert good["left_next"] == pytest.approx(0.9)
    assert then(tried_off=[1e-12, 0.0, 0.0], refusing=1.0)["step_length_next"] == pytest.approx(0.1)
    steady = then(tried_off=[0.0, step_size.AIM * ALLOWED, 0.0], step_error=step_size.AIM * ALLOWED)
    assert steady["step_length_next"] == pytest.approx(0.1)
    for bad in (
        {"tried_off": [0.0, -1.01 * ALLOWED, 0.0]},
        {"tried_off": [0.0, np.inf, 0.0]},
        {"tried_off": [0.0, 0.0, 1.01 * ALLOWED]},
        {"tried_diverged": 1.0},
        {"tried_moved": 0.6},
    ):
        refused = then(**bad)
        assert refused["q_next"].tolist() == [0.0, 0.0]
        assert refused["left_next"] == 1.0
        assert 0.009 < refused["step_length_next"] <= 0.05
        assert (refused["retries_next"], refused["steps_taken_next"], refused["unfinished"]) == (1, 0, 1)
    last = then(trying=SHORTEST, step_length=SHORTEST, tried_off=[1.0, 0.0, 0.0])
    assert last["q_next"].tolist() == [1.0, 2.0]
    assert (last["steps_taken_next"], last["steps_missed_next"]) == (1, 1)
    through = then(trying=0.0, left=0.0, tried_q=[np.nan, np.nan])
    assert through["q_next"].tolist() == [0.0, 0.0]
    assert (through["unfinished"], through["step_length_next"], through["steps_taken_next"]) == (0, 0.1, 0)


def test_the_schema_is_what_the_sub_steps_need():
    model = Model(TRIPOD)
    options = StepOptions(contacts=model.contact_names, method="adaptive")
    sizes, *_ = substeps(model.mechanism, options, ("torque", "error"))
    rows = {row.name: row.size for row in physics_rows(model, options, ("torque", "error"), INTERVAL)}
    assert rows == {name: size for name, size in sizes.items() if name != "target"}


def test_what_does_not_fit_is_refused_in_one_line():
    model = pendulum()
    with pytest.raises(ValueError, match=r"^tolerance=0.001; expected None, because method is 'euler'$"):
        Simulator(model, tolerance=1e-3)
    for bad in (0.0, -1.0, 2.0, np.nan, "small", True):
        with pytest.raises(ValueError, match=r"^tolerance=.*; expected a number between 1e-09 and 1 rad or m$"):
            Simulator(model, method="adaptive", tolerance=bad)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"^method='euler' makes no steps of its own; expected 'adaptive'$"):
        _ = Simulator(model).steps
    with pytest.raises(ValueError, match=r"^derivatives of steps with method='adaptive'; expected 'euler' or 'extr"):
        StepDerivatives(Simulator(model, method="adaptive"))
