"""One contact by itself: how its friction is linearised in each of the attempts at a step."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import Compliance, Contact, ContactResponse, Hint, Touch

DT, MU, LOAD, BRISTLE, SLIP_SPEED = 0.005, 0.5, 20.0, 1e4, 0.01
CONE = MU * LOAD
UP = np.array([0.0, 0.0, 1.0])


def contact(velocity: list[float], *, gain=(0.0, 0.0, 0.0), slip=(0.0, 0.0, 0.0), attempts: int = 0) -> Contact:
    """A loaded point 1 mm in the ground."""
    touch = Touch(SX(UP), SX(3, 1), SX(0.001), SX(velocity), SX(3, 1), SX(LOAD), SX(3, 1))
    material = Compliance(SX(5e4), SX(100.0), None, SX(MU), SX(SLIP_SPEED), SX(BRISTLE))
    hint = Hint(SX(list(gain)), SX(list(slip)), SX(1.0 if attempts else 0.0), SX(float(attempts)))
    return Contact("foot", touch, material, DT, hint)


def numbers(x: SX) -> np.ndarray:
    return np.array(ca.evalf(x)).squeeze()


def tangential(response: ContactResponse, gain=(0.0, 0.0, 0.0)) -> np.ndarray:
    return numbers(response.force_after(SX(list(gain))))[:2]


def slopes(response: ContactResponse) -> tuple[float, float]:
    """Damping along x and along y [N s/m]."""
    C = numbers(response.C)
    return float(C[0, 0]), float(C[1, 1])


STICKING = CONE / SLIP_SPEED + DT * BRISTLE
SLOW, FAST = 0.2 * CONE / STICKING, 5.0 * CONE / STICKING


def test_a_slow_point_sticks():
    response = contact([SLOW, 0, 0]).tangent()
    assert slopes(response) == pytest.approx((STICKING, STICKING))
    np.testing.assert_allclose(tangential(response), [-STICKING * SLOW, 0])
    assert not numbers(response.slip).any()


def test_a_fast_point_slips_with_the_true_slope():
    """At the edge of the cone, no slope along the slip, and across it that of a force that turns with the velocity."""
    response = contact([FAST, 0, 0]).tangent()
    assert slopes(response) == pytest.approx((0.0, STICKING / 5))
    np.testing.assert_allclose(tangential(response), [-CONE, 0], rtol=1e-9)
    np.testing.assert_allclose(numbers(response.slip), [1, 0, 0], rtol=1e-9)


def test_one_that_slipped_and_turned_round_sticks():
    turned = contact([FAST, 0, 0], gain=(-FAST - SLOW, 0, 0), slip=(1, 0, 0), attempts=1)
    response = turned.tangent()
    assert slopes(response) == pytest.approx((STICKING, STICKING))
    assert not numbers(response.slip).any()


def test_one_that_was_held_and_left_the_cone_is_let_go_by_the_secant():
    """About the velocity it has come to: a force on the cone, and a slope along the slip that no tangent has."""
    gain = (FAST - SLOW, 0, 0)
    response = contact([SLOW, 0, 0], gain=gain, attempts=1).tangent()
    np.testing.assert_allclose(tangential(response, gain), [-CONE, 0], rtol=1e-9)
    assert slopes(response) == pytest.approx((STICKING / 5, STICKING / 5))
    assert not numbers(response.slip).any()


def test_the_last_attempt_takes_the_secant_about_the_start():
    response = contact([FAST, 0, 0], gain=(-9 * FAST, 0, 0), slip=(1, 0, 0), attempts=2).tangent()
    np.testing.assert_allclose(tangential(response), [-CONE, 0], rtol=1e-9)
    assert slopes(response) == pytest.approx((STICKING / 5, STICKING / 5))
    assert slopes(response) == slopes(contact([FAST, 0, 0]).secant())


@pytest.mark.parametrize(
    ("velocity", "gain", "misjudged"),
    [
        ([SLOW, 0, 0], (0, 0, 0), False),
        ([SLOW, 0, 0], (FAST, 0, 0), True),  # stuck, and has left the cone
        ([FAST, 0, 0], (0, 0, 0), False),
        ([FAST, 0, 0], (-2 * FAST, 0, 0), True),  # slipped, and has turned round
        ([FAST, 0, 0], (0, FAST, 0), False),
    ],
)
def test_surprises_are_noticed(velocity, gain, misjudged):
    point = contact(velocity)
    assert bool(numbers(point.misjudged(point.tangent(), SX(list(gain))))) is misjudged


@pytest.mark.parametrize("attempts", [0, 1, 2])
def test_no_attempt_can_be_made_unstable(attempts):
    """The slope is symmetric and never negative, whatever was found before."""
    rng = np.random.default_rng(attempts)
    for _ in range(50):
        slip = rng.standard_normal(3) * [1, 1, 0] if attempts and rng.random() < 0.5 else np.zeros(3)
        slip /= np.linalg.norm(slip) or 1.0
        gain = FAST * rng.standard_normal(3) if attempts else np.zeros(3)
        point = contact((FAST * rng.standard_normal(3)).tolist(), gain=gain, slip=slip, attempts=attempts)
        C = numbers(point.tangent().C)
        np.testing.assert_array_equal(C, C.T)
        assert np.linalg.eigvalsh(C).min() > -1e-9 * STICKING
