"""Robots that fail numerically: stepped again in parts; else frozen, flagged, counted, their neighbours untouched."""

from __future__ import annotations

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator
from ce_gym.dynamics.stepping.halving import FAST, LARGEST_FAST_MOVE, LARGEST_MOVE

BAD, N = 5, 12
OTHERS = np.arange(N) != BAD


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(TRIPOD)


def in_the_air(model: Model, **options) -> Simulator:
    """All robots high up and gently moving."""
    sim = Simulator(model, N, contacts="foot", **options)
    q, v = np.tile(model.standing_q, (N, 1)), np.random.default_rng(0).normal(0, 0.2, (N, model.nv))
    q[:, 2] += 1.0
    sim.set_state(q, v)
    return sim


def whirl(sim: Simulator, speed: float = 4500.0) -> tuple[np.ndarray, np.ndarray]:
    """Let the joints of one robot turn too fast for a step of 10 ms; return its state, shapes (nq,) and (nv,)."""
    v = sim.v
    v[BAD] = 0.0
    v[BAD, 6:] = speed * np.array([1.0, -1.0])
    sim.set_state(sim.q, v)
    return sim.q[BAD], v[BAD]


@pytest.mark.parametrize("name", ["q", "v", "anchor"])
def test_a_bad_number_anywhere_is_flagged_and_stays_in_its_lane(model: Model, name: str):
    target = model.standing_q[7:]
    clean = Simulator(model, N)
    clean.step(target, 5)
    feet = 2 * sum(contact.group == "foot" for contact in model.robot.contacts)  # others do not act in the air
    for entry in range(feet if name == "anchor" else clean._arrays[name].shape[1]):
        sim = Simulator(model, N)
        sim._arrays[name][0, entry, BAD] = np.nan
        sim.step(target, 5)
        assert sim.diverged.tolist() == [i == BAD for i in range(N)], entry
        assert sim.n_diverged == 1
        for array in ("q", "v", "torque", "contact_forces"):
            np.testing.assert_array_equal(getattr(sim, array)[OTHERS], getattr(clean, array)[OTHERS])


def test_a_robot_out_of_bounds_is_frozen_at_its_last_good_state(model: Model):
    sim = in_the_air(model)
    v = sim.v
    v[BAD, 3] = 9.9e3  # m/s, and a spin that turns this speed into accelerations
    v[BAD, 0] = 9.9e3
    sim.set_state(sim.q, v)
    target = model.standing_q[7:]
    states = []
    for _ in range(3):
        states.append((sim.q[BAD], sim.v[BAD]))
        sim.step(target)
    assert sim.diverged[BAD]
    for q, v in ((sim.q[BAD], sim.v[BAD]), states[-1]):
        np.testing.assert_array_equal(q, states[0][0])
        np.testing.assert_array_equal(v, states[0][1])
    assert sim.n_diverged == 1
    sim.reset(sim.diverged)
    assert not sim.diverged.any()
    assert sim.n_diverged == 1, "a reset does not make it unhappen"


def alone_in_parts(model: Model, q: np.ndarray, v: np.ndarray, dt: float, smallest: int, **options) -> Simulator:
    """Step one robot by `dt` in parts, decided out here: half of a part that fails or goes too far, and so on."""
    target, part, left = model.standing_q[7:], 1.0, 1.0
    while left > 0:
        sim = Simulator(model, 1, dt * part, contacts="foot", retry=0, **options)
        sim.set_state(q, v)
        sim.step(target)
        most = np.clip(FAST * dt * part, LARGEST_FAST_MOVE, LARGEST_MOVE)
        fast = np.abs(sim.v[0, 6:]).max() * dt * part > most
        if part > 0.5**smallest and (sim.diverged[0] or fast):
            part /= 2
            continue
        q, v, left = sim.q[0], sim.v[0], left - part
    return sim


@pytest.mark.parametrize("method", ["euler", "extrapolated", "rk4"])
def test_a_robot_that_goes_too_far_makes_its_step_in_parts(model: Model, method: str):
    """It moves as alone with steps of those lengths; the other robots do not change."""
    target = model.standing_q[7:]
    sims = [in_the_air(model, dt=0.01, method=method, retry=retry) for retry in (4, 0)]
    for sim in sims:
        q, v = whirl(sim, 150.0)
        sim.step(target)
    parts, whole = sims
    assert (parts.n_retried, whole.n_retried) == (1, 0)
    alone = alone_in_parts(model, q, v, 0.01, 4, method=method)
    for name in ("q", "v"):
        np.testing.assert_allclose(getattr(parts, name)[BAD], getattr(alone, name)[0], rtol=1e-10, atol=1e-12)
        assert (getattr(parts, name)[BAD] != getattr(whole, name)[BAD]).any()
    for name in ("q", "v", "torque", "contact_forces"):
        np.testing.assert_array_equal(getattr(parts, name)[OTHERS], getattr(whole, name)[OTHERS])


def test_means_are_those_over_all_parts(model: Model):
    """The torque of a step in two halves is the mean of the two."""
    sim, halves = in_the_air(model, dt=0.004), in_the_air(model, dt=0.002, retry=0)
    for one in (sim, halves):
        whirl(one, 80.0)
    torques, target = [], np.tile(model.standing_q[7:], (N, 1))
    target[BAD] += [3.0, -3.0]  # brakes, but not with all that the motors have
    for _ in range(2):
        halves.step(target)
        torques.append(halves.torque[BAD])
    sim.step(target)
    assert sim.n_retried == 1
    np.testing.assert_allclose(sim.q[BAD], halves.q[BAD], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(sim.torque[BAD], np.mean(torques, axis=0), rtol=1e-12)
    assert np.abs(torques[0] - torques[1]).max() > 1e-3


def test_a_robot_that_blows_up_is_saved_by_parts(model: Model):
    plain, saved = (in_the_air(model, dt=0.01, retry=retry) for retry in (0, 4))
    for sim in (plain, saved):
        whirl(sim, 9000.0)
        sim.step(model.standing_q[7:], 5)
    assert plain.diverged.tolist() == [i == BAD for i in range(N)]
    assert (plain.n_diverged, plain.n_retried) == (1, 0)
    assert not saved.diverged.any()
    assert saved.n_diverged == 0
    assert saved.n_retried > 0


def test_a_robot_that_nothing_saves_is_given_up(model: Model):
    sim = in_the_air(model, dt=0.01, retry=1)
    whirl(sim, 9500.0)
    for _ in range(3):
        sim.step(model.standing_q[7:], 5)
    assert sim.diverged[BAD]
    assert sim.n_diverged == 1
    assert 1 <= sim.n_retried <= 5, "once frozen, it is not tried over and over"


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_light_links_under_torques_that_a_step_cannot_follow(dtype: str):
    """Their joints would turn by radians in a step, and their loops not close: one step in five ended so."""
    model, n = Model("planar_leg_linkage"), 32
    largest = [model.robot.body(name).joint.torque for name in model.joint_links]
    sims = [Simulator(model, n, 0.1, dtype, control="torque", **options) for options in ({"retry": 0}, {})]
    rng, lost = np.random.default_rng(0), [0, 0]
    for _ in range(100):
        torque = rng.uniform(-1, 1, (n, 2)) * largest
        for i, sim in enumerate(sims):
            sim.step(torque)
            lost[i] += int(sim.diverged.sum())
            if sim.diverged.any():
                sim.reset(sim.diverged)
    assert lost[0] > 100
    assert lost[1] == 0


def test_a_wrong_number_of_halvings_is_refused(model: Model):
    with pytest.raises(ValueError, match="retry=-1; expected a whole number between 0 and 10"):
        Simulator(model, retry=-1)
