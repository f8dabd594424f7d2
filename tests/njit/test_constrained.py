"""Dynamics with held frames and inertia at a frame in `@njit` code: the results of `Model`."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym import Model

numba = pytest.importorskip("numba")

from ce_gym.numba import constrained_forward_dynamics, operational_space_inertia  # noqa: E402


@pytest.mark.parametrize(
    ("name", "dtype", "tolerance"),
    [("mini_cheetah", "float64", 1e-10), ("t1", "float64", 1e-9), ("t1", "float32", 1e-3)],
)
def test_results_are_those_of_model(name, dtype, tolerance):
    """Corners of a sole of T1 are redundant."""
    model = Model(name, dtype=dtype)
    frames = [contact.name for contact in model.robot.contacts if contact.group == "foot"][:4]
    held, inertia = constrained_forward_dynamics(model, frames), operational_space_inertia(model, frames[0])

    @numba.njit
    def both(q, v, tau):
        return held(q, v, tau), inertia(q)

    rng = np.random.default_rng(0)
    q = model.integrate(model.standing_q, 0.1 * rng.normal(size=model.nv))
    v, tau = rng.normal(size=(2, model.nv))
    (vdot, force), Lambda = both(q, v, tau)
    expected = model.constrained_forward_dynamics(q, v, tau, frames)
    for found, right in (
        (vdot, expected[0]),
        (force, expected[1]),
        (Lambda, model.operational_space_inertia(q, frames[0])),
    ):
        assert found.dtype == dtype
        np.testing.assert_allclose(found, right, rtol=0, atol=tolerance * np.abs(right).max())


def test_states_without_results():
    model = Model("mini_cheetah")
    frames = [model.body_names[0], "FL_foot"]
    held, inertia = constrained_forward_dynamics(model, frames), operational_space_inertia(model, frames[0])
    q, v = model.standing_q * np.r_[np.ones(3), 1.1 * np.ones(4), np.ones(12)], np.zeros(18)
    assert all(np.isnan(result).all() for result in (*held(q, v, v), inertia(q)))
    leg = Model("planar_leg_linkage")  # its links turn about parallel axes
    found = operational_space_inertia(leg, leg.body_names[-1])(leg.standing_q)
    assert np.isnan(found).all()


def test_names_of_frames():
    model = Model("mini_cheetah")
    with pytest.raises(ValueError, match=r"frames.*'FL'.*expected a frame of mini_cheetah"):
        constrained_forward_dynamics(model, ["FL"])
    with pytest.raises(ValueError, match=r"frames=\[\]; expected"):
        constrained_forward_dynamics(model, [])
    with pytest.raises(KeyError, match="no frame 'FL'"):
        operational_space_inertia(model, "FL")
