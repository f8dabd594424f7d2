"""Robots that fail numerically: frozen, flagged, counted, their neighbours untouched; stepped again if asked."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym import Model, Simulator

BAD, N = 5, 12
OTHERS = np.arange(N) != BAD


@pytest.fixture(scope="module")
def model() -> Model:
    return Model("mini_cheetah")


def in_the_air(model: Model, **options) -> Simulator:
    """All robots high up and gently moving."""
    sim = Simulator(model, N, contacts="foot", **options)
    q, v = np.tile(model.standing_q, (N, 1)), np.random.default_rng(0).normal(0, 0.2, (N, model.nv))
    q[:, 2] += 1.0
    sim.set_state(q, v)
    return sim


def whirl(sim: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Let the joints of one robot turn too fast for a step of 10 ms; return its state, shapes (nq,) and (nv,)."""
    v = sim.v
    v[BAD] = 0.0
    v[BAD, 6:] = 4500.0 * np.resize([1.0, -1.0], 12)
    sim.set_state(sim.q, v)
    return sim.q[BAD], v[BAD]


@pytest.mark.parametrize("name", ["q", "v", "anchor"])
def test_a_bad_number_anywhere_is_flagged_and_stays_in_its_lane(model: Model, name: str):
    target = model.standing_q[7:]
    clean = Simulator(model, N)
    clean.step(target, 5)
    for entry in range(clean._arrays[name].shape[1]):
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
    v[BAD, 3] = 9.9e3  # m/s, and a spin that turns the whole of it into accelerations
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


def test_a_robot_that_blows_up_is_stepped_again_with_smaller_steps(model: Model):
    """It then does, to the last bit, what it would have done alone with those steps; the others notice nothing."""
    target = model.standing_q[7:]
    plain, saved, unharmed = (in_the_air(model, dt=0.01, retry=retry) for retry in (0, 6, 0))
    for sim in (plain, saved):
        q, v = whirl(sim)
    for sim in (plain, saved, unharmed):
        sim.step(target, 5)
    assert plain.diverged.tolist() == [i == BAD for i in range(N)]
    assert (plain.n_diverged, plain.n_retried) == (1, 0)
    assert not saved.diverged.any()
    assert (saved.n_diverged, saved.n_retried) == (0, 1)

    fails = []
    for k in range(7):
        alone = Simulator(model, 1, dt=0.01 / 2**k, contacts="foot")
        alone.set_state(q, v)
        alone.step(target, 5 * 2**k)
        fails.append(bool(alone.diverged[0]))
        if not fails[-1]:
            break
    assert fails[:2] == [True, True], "halving once is not enough here, so that going on is tested too"
    assert not fails[-1]
    for array in ("q", "v", "torque", "contact_forces"):
        np.testing.assert_array_equal(getattr(saved, array)[BAD], getattr(alone, array)[0])
        np.testing.assert_array_equal(getattr(saved, array)[OTHERS], getattr(unharmed, array)[OTHERS])


def test_a_robot_that_nothing_saves_is_given_up(model: Model):
    target = model.standing_q[7:]
    without, given_up = (in_the_air(model, dt=0.01, retry=retry) for retry in (0, 1))
    for sim in (without, given_up):
        whirl(sim)
        for _ in range(3):
            sim.step(target, 5)
    assert given_up.diverged[BAD]
    assert (given_up.n_diverged, given_up.n_retried) == (1, 1), "once frozen, it is not tried over and over"
    np.testing.assert_array_equal(given_up.q, without.q)
    np.testing.assert_array_equal(given_up.v, without.v)


def test_no_state_is_kept_unless_asked_for(model: Model, monkeypatch):
    sim, copies = Simulator(model, 2), []
    monkeypatch.setattr("ce_gym.sim.retry.Retry.__call__", lambda *_: copies.append(1))
    sim.step(model.standing_q[7:])
    assert not copies
    with pytest.raises(ValueError, match="retry=-1; expected between 0 and 10"):
        Simulator(model, retry=-1)
