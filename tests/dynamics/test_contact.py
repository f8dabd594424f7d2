"""One contact by itself: how its friction is linearised in each iteration of a step."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import Compliance, Contact, Iterate, LinearContact, Touch
from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.forces.normal import KelvinVoigt

DT, MU, LOAD, BRISTLE, SLIP_SPEED = 0.005, 0.5, 20.0, 1e4, 0.01
CONE = MU * LOAD
UP = np.array([0.0, 0.0, 1.0])


def contact(
    velocity: list[float], *, gain=(0.0, 0.0, 0.0), slip=(0.0, 0.0, 0.0), count: int = 0, friction: str = "tangent"
) -> LinearContact:
    """A loaded point 1 mm in the ground, about an iterate."""
    touch = Touch(SX.eye(3), SX(UP), SX(3, 1), SX(0.001), SX(velocity), SX(3, 1), SX(LOAD), SX(3, 1))
    material = Compliance(SX(5e4), SX(100.0), None, SX(MU), SX(SLIP_SPEED), SX(BRISTLE))
    law = Contact("foot", touch, material, KelvinVoigt(), FRICTION[friction], DT)
    return law.linearise(SX([*gain, *slip, 1.0 if count else 0.0, float(count)]))


def numbers(x: SX) -> np.ndarray:
    return np.array(ca.evalf(x)).squeeze()


def motion(gain) -> Motion:
    """Accelerations of which the point's velocity gains that much in a step."""
    return Motion(SX(0, 1), {"foot": ca.vertcat(SX(3, 1), SX(list(gain)) / DT)}, SX(3, 1))


def tangential(point: LinearContact, gain=(0.0, 0.0, 0.0)) -> np.ndarray:
    return numbers(point.force_after(SX(list(gain))))[:2]


def slopes(point: LinearContact) -> tuple[float, float]:
    """Damping along x and along y [N s/m]."""
    C = numbers(point.C)
    return float(C[0, 0]), float(C[1, 1])


STICKING = CONE / SLIP_SPEED + DT * BRISTLE
SLOW, FAST = 0.2 * CONE / STICKING, 5.0 * CONE / STICKING


def test_a_slow_point_sticks():
    point = contact([SLOW, 0, 0])
    assert slopes(point) == pytest.approx((STICKING, STICKING))
    np.testing.assert_allclose(tangential(point), [-STICKING * SLOW, 0])
    assert not numbers(point.slip).any()


def test_a_fast_point_slips_with_the_true_slope():
    """At the edge of the cone, no slope along the slip, and across it a force that turns with the velocity."""
    point = contact([FAST, 0, 0])
    assert slopes(point) == pytest.approx((0.0, STICKING / 5))
    np.testing.assert_allclose(tangential(point), [-CONE, 0], rtol=1e-9)
    np.testing.assert_allclose(numbers(point.slip), [1, 0, 0], rtol=1e-9)


def test_one_that_slipped_and_reversed_sticks():
    point = contact([FAST, 0, 0], gain=(-FAST - SLOW, 0, 0), slip=(1, 0, 0), count=1)
    assert slopes(point) == pytest.approx((STICKING, STICKING))
    assert not numbers(point.slip).any()


def test_one_that_stuck_and_left_the_cone_is_released_by_the_secant():
    """About the velocity it has come to: a force on the cone, and a slope along the slip that no tangent has."""
    gain = (FAST - SLOW, 0, 0)
    point = contact([SLOW, 0, 0], gain=gain, count=1)
    np.testing.assert_allclose(tangential(point, gain), [-CONE, 0], rtol=1e-9)
    assert slopes(point) == pytest.approx((STICKING / 5, STICKING / 5))
    assert not numbers(point.slip).any()


def test_the_last_iteration_takes_the_secant_about_the_start():
    point = contact([FAST, 0, 0], gain=(-9 * FAST, 0, 0), slip=(1, 0, 0), count=2)
    np.testing.assert_allclose(tangential(point), [-CONE, 0], rtol=1e-9)
    assert slopes(point) == pytest.approx((STICKING / 5, STICKING / 5))
    assert slopes(point) == slopes(contact([FAST, 0, 0], friction="secant"))


@pytest.mark.parametrize(
    ("velocity", "gain", "changed"),
    [
        ([SLOW, 0, 0], (0, 0, 0), False),
        ([SLOW, 0, 0], (FAST, 0, 0), True),  # stuck, and has left the cone
        ([FAST, 0, 0], (0, 0, 0), False),
        ([FAST, 0, 0], (-2 * FAST, 0, 0), True),  # slipped, and has reversed
        ([FAST, 0, 0], (0, FAST, 0), False),
    ],
)
def test_a_change_of_the_active_set_is_noticed(velocity, gain, changed):
    point = contact(velocity)
    assert bool(numbers(point.check(motion(gain)))) is changed


@pytest.mark.parametrize("gain", [(0, 0, 0), (FAST, 0, 0), (-2 * FAST, 0, 0), (0, FAST, 0)])
@pytest.mark.parametrize("velocity", [[SLOW, 0, 0], [FAST, 0, 0]])
def test_the_secant_never_asks_for_another_iteration(velocity, gain):
    """It uses the velocity at the start, which no iteration changes; motors may still need one."""
    point = contact(velocity, friction="secant")
    assert not numbers(point.check(motion(gain)))
    again = contact(velocity, gain=gain, slip=(1, 0, 0), count=1, friction="secant")
    np.testing.assert_array_equal(tangential(again), tangential(point))


def test_an_iterate_holds_what_the_iteration_found():
    gain = [-0.5 * FAST, 0.1, 0.2]
    found = Iterate.of(contact([FAST, 0, 0], count=1, slip=(1, 0, 0)).next_iterate(motion(gain)))
    np.testing.assert_allclose(numbers(found.gain), gain)
    np.testing.assert_allclose(numbers(found.slip), [1, 0, 0], rtol=1e-9)
    assert (float(found.active), float(found.count)) == (1.0, 2.0)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_no_iteration_can_be_made_unstable(count):
    """The slope is symmetric and never negative, whatever was found before."""
    rng = np.random.default_rng(count)
    for _ in range(50):
        slip = rng.standard_normal(3) * [1, 1, 0] if count and rng.random() < 0.5 else np.zeros(3)
        slip /= np.linalg.norm(slip) or 1.0
        gain = FAST * rng.standard_normal(3) if count else np.zeros(3)
        point = contact((FAST * rng.standard_normal(3)).tolist(), gain=gain, slip=slip, count=count)
        C = numbers(point.C)
        np.testing.assert_array_equal(C, C.T)
        assert np.linalg.eigvalsh(C).min() > -1e-9 * STICKING
