"""Friction laws of a contact, one class each; `FRICTION` names them.

With cone `mu lam` and the trial force `x` of a bristle that sticks:

    x = k_t s + (mu lam / v_s + dt k_t) v_t            f_t = -min(1, mu lam / |x|) x

The secant about the velocity at the start keeps the slope of sticking, scaled by mu lam / |x|. It never reverses a
velocity and is slow to break away. The tangent is Newton's method, with the true slope, none along the slip: its second
iteration is about the result of the first. There a contact whose slip has reversed sticks, and one that stuck and left
the cone is released. If the active set has changed again, by twice the cone where one stuck, the third iteration falls
back on the secant about the start, which cannot add energy.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import FrictionLaw, LinearContact, TangentialForce

CONE_TOLERANCE = 0.02
"""Share by which a sticking contact may leave the cone without another iteration."""
SECOND_TOLERANCE = 1.0
"""What is added to it in the second iteration: sticking too long costs accuracy, but adds no energy."""
CONE_FLOOR = 1e-6
"""The same as a force, for cones near zero [N]."""


class Tangent:
    """Newton's method on Coulomb's cone."""

    iterations = 2

    def linearise(self, contact: LinearContact) -> TangentialForce:
        """Linearise about the velocity of the iterate; in the last iteration by the secant about the start.

        A contact whose slip has reversed sticks. Released contacts use secant friction about the current iterate; the
        slip direction is unknown, as several may be released at once.
        """
        last, slipped = contact.iterate.last, contact.iterate.slip
        gain = linearised_about(contact)
        cone, slope, x, size = contact.trial(gain)
        reversed_slip = ca.logic_and(ca.sumsqr(slipped) > 0.5, ca.dot(slipped, x) <= cone)
        slips = ca.logic_and(size > cone, ca.logic_or(last, ca.logic_not(reversed_slip)))
        share = ca.if_else(slips, cone / size, 1)
        slip = ca.if_else(ca.logic_and(slips, ca.logic_not(ca.logic_or(last, released(contact)))), x / size, 0)
        return TangentialForce(share * x, share * slope, slip, gain)

    def check(self, contact: LinearContact, slip: SX, gain: SX) -> SX:
        """Return 1 if a contact that slipped has reversed, or one that stuck has left the cone; else 0."""
        cone, _, x, size = contact.trial(gain)
        tolerance = CONE_TOLERANCE + SECOND_TOLERANCE * contact.iterate.count
        left = ca.logic_and(size > (1 + tolerance) * cone + CONE_FLOOR, ca.logic_not(released(contact)))
        return ca.if_else(ca.sumsqr(slip) > 0.5, ca.dot(slip, x) < cone, left)


class Secant:
    """One solve: what happens to a contact in it does not ask for another."""

    iterations = 0

    def linearise(self, contact: LinearContact) -> TangentialForce:
        """Linearise about the velocity at the start, with the slope of sticking scaled into the cone."""
        cone, slope, x, size = contact.trial(SX(3, 1))
        share = ca.fmin(1, cone / size)
        return TangentialForce(share * x, share * slope, SX(3, 1), SX(3, 1))

    def check(self, contact: LinearContact, slip: SX, gain: SX) -> SX:
        """Return 0: another iteration would take the same secant."""
        return SX(0)


def linearised_about(contact: LinearContact) -> SX:
    """Return the change of the velocity that the tangent is about; none in the last iteration."""
    return ca.if_else(contact.iterate.last, 0, contact.iterate.gain)


def released(contact: LinearContact) -> SX:
    """Return 1 in a second iteration if the contact stuck in the first one and left the cone; else 0."""
    cone, _, _, size = contact.trial(linearised_about(contact))
    stuck = ca.logic_and(contact.iterate.count > 0.5, ca.sumsqr(contact.iterate.slip) < 0.5)
    return ca.logic_and(stuck, size > cone)


FRICTION: dict[str, FrictionLaw] = {"tangent": Tangent(), "secant": Secant()}
"""All laws, by the name that `Simulator(friction=...)` takes."""
