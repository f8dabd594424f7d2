"""Penalty contact between spheres and the ground, linearly implicit in the step.

A contact is a spring and damper along the normal and a bristle in the tangent plane: an elastic deflection `s` from an
anchor, damped, that slips when it would carry more than Coulomb's cone allows. Its force is a function of the velocity
`v+` of the point at the end of the step, linearised about a velocity `w`,

    f+ = F(w) - C (v+ - w),    v+ = J (qd + dt qdd) = v + dt (J a - drift),    C = Dn n n^T + Dt,

with the acceleration `a` of the body still unknown. `dt J^T C J` joins the body's inertia before the inward pass and
the recursion stays linear in the number of bodies. This is Newton's method on backward Euler (Anitescu and Potra 2002)
with frozen normal, lever arm and Jacobian: the velocity product `drift` has no part in `v+`, or the force would do work
on the motion it is meant to stop. C is positive semidefinite: no step length makes a lasting contact unstable.

Normal force, with depth `d`, and friction, with cone `mu lam` and the trial force `x` of a bristle that sticks:

    lam = k d - (c + dt k) v_n   (Kelvin-Voigt)        lam = k d+ (1 - h v_n)+   (Hunt-Crossley, linearised)
    x = k_t s + (mu lam / v_s + dt k_t) v_t            f_t = -min(1, mu lam / |x|) x

Friction in one attempt, with w = v: a slipping contact keeps the slope of a sticking one, scaled by mu lam / |x| (the
secant). That never reverses a velocity, and is slow to break away. In two: the first with the true slope (the tangent,
none along the slip), the second about its result, in which a contact whose slip would have turned round sticks, and one
that was held and left the cone is let go by the secant. If that was misjudged too, by twice the cone where one was
held, a third falls back on the secant about the start, which cannot gain energy.

A contact begins if it *will* be in the ground by the end of the step, `d - dt v_n > 0`, and pushes. A corner that its
velocity does not take there, but the velocity it has after another one was hit, is seen in the second attempt. A point
that the law would pull down to the surface, because it is turned back before, makes a third attempt, with a damper
`-share (c + dt k) v_n+` in place of the spring: it can do no work. `share = 1 - d / (dt v_n)` is the part of the step
that the point spends in the ground. The prediction knows the velocity but not yet the acceleration: a loaded foot that
its spring has just lifted would be judged gone, fall back, and bounce on the steps for ever. So a contact that pushed
at the end of the last step goes on as long as it is in the ground. May know spatial algebra; no robots, no recursions.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, mirrored, skew, symmetric_blocks
from ce_gym.dynamics.recursion.ce_aba import BodyTerms
from ce_gym.dynamics.recursion.kinematics import BodyState

CONE_TOLERANCE = 0.02
"""Share by which a sticking contact may leave the cone before its step is solved again."""
SECOND_TOLERANCE = 1.0
"""What is added to it for a third attempt: holding on too long costs accuracy, but no energy."""
CONE_FLOOR = 1e-6
"""The same as a force, for cones near zero [N]."""
TINY_SPEED = 1e-9
"""Keeps divisions finite [m/s]."""


@dataclass(frozen=True)
class Compliance:
    """Figures of a contact, numbers or symbols.

    Attributes:
        stiffness: Normal stiffness `k` [N/m].
        damping: Normal damping `c` of Kelvin and Voigt [N s/m].
        dissipation: Normal dissipation `h` of Hunt and Crossley [s/m]; None for Kelvin and Voigt.
        friction: Coulomb coefficient `mu` [-].
        slip_speed: Speed `v_s` at which damping alone carries the full friction [m/s].
        bristle: Tangential stiffness `k_t` [N/m]; 0 for none.
    """

    stiffness: SX
    damping: SX
    dissipation: SX | None
    friction: SX
    slip_speed: SX
    bristle: SX


@dataclass
class Touch:
    """Where a sphere is above the ground and how it moves. In body axes.

    Attributes:
        normal: Unit normal out of the ground, shape (3,).
        point: The sphere's lowest point, in the body frame [m], shape (3,).
        depth: How far it is in the ground [m].
        velocity: Of the point [m/s], shape (3,).
        drift: Its acceleration while all of `vdot` is zero [m/s^2], shape (3,).
        load: Its normal force over the last step [N].
        anchor: Deflection of the bristle, shape (3,) [m].
    """

    normal: SX
    point: SX
    depth: SX
    velocity: SX
    drift: SX
    load: SX
    anchor: SX


@dataclass
class ContactResponse:
    """One contact's force over the step, linear in the velocity of its point at the end, `force - C (v+ - v)`.

    Attributes:
        force: For an unchanged velocity, body axes [N], shape (3,).
        C: Effective damping, body axes [N s/m], shape (3, 3).
        slip: Direction in which friction slips, shape (3,); zero while it sticks.
        touch: Where it acts.
        dt: Step length [s].
    """

    force: SX
    C: SX
    slip: SX
    touch: Touch
    dt: float

    def body_terms(self, gravity: SX) -> BodyTerms:
        """Return what the contact adds to its body before the inward pass.

        Args:
            gravity: Acceleration of free fall in body axes, shape (3,); the recursion's `a` does not contain it.
        """
        r = skew(self.touch.point)
        rC = r @ self.C
        inertia = symmetric_blocks(mirrored(rC @ r.T), rC, self.C) * self.dt
        force = self.force - self.dt * (self.C @ (gravity - self.touch.drift))
        return BodyTerms(inertia, ca.vertcat(cross(self.touch.point, force), force))

    def velocity_gain(self, a: SX, gravity: SX) -> SX:
        """Return what the point's velocity gains in the step, body axes [m/s], given its body's acceleration."""
        return self.dt * (a[3:] + cross(a[:3], self.touch.point) + gravity - self.touch.drift)

    def force_after(self, gain: SX) -> SX:
        """Return the force over the step, body axes [N], given the gain in velocity."""
        return self.force - self.C @ gain


def touch_ground(body: BodyState, position: SX, radius: float, height: SX, normal: SX, load: SX, anchor: SX) -> Touch:
    """Place a sphere against the plane that the ground is nearby.

    Args:
        body: Kinematics of the body that carries it.
        position: Centre of the sphere in the body frame [m], shape (3,).
        radius: [m].
        height: Of the ground under the centre [m].
        normal: Unit normal of the ground there, world axes, shape (3,).
        load: Its normal force over the last step [N].
        anchor: Horizontal deflection of its bristle, world axes [m], shape (2,), or (0,) for none.
    """
    n = body.R.T @ normal
    depth = radius - normal[2] * (body.point_position(position)[2] - height)
    point = position - radius * n
    velocity, drift = body.point_velocity(point), body.drift[3:] + cross(body.drift[:3], point)
    deflection = SX(3, 1)
    if anchor.numel():  # in the tangent plane: the normal has no part in it
        deflection = body.R.T @ ca.vertcat(anchor, -ca.dot(normal[:2], anchor) / normal[2])
    return Touch(n, point, depth, velocity, drift, load, deflection)


def normal_law(touch: Touch, compliance: Compliance, dt: float) -> tuple[SX, SX]:
    """Return the normal force of a contact as `force - slope * v_n+`, whether it is there or not."""
    c, v_n = compliance, ca.dot(touch.normal, touch.velocity)
    rate = c.stiffness * ca.fmax(0, 1 - c.dissipation * v_n) if c.dissipation is not None else c.stiffness
    slope = c.damping + dt * rate
    force = rate * touch.depth
    if c.dissipation is not None:
        growth = ca.if_else(v_n < 1 / c.dissipation, c.stiffness * c.dissipation * ca.fmax(touch.depth, 0), 0)
        slope, force = slope + growth, force + growth * v_n
    return force, slope


@dataclass
class Hint:
    """What the attempt before has found of a contact; all zero for the first.

    Attributes:
        gain: What its velocity gained in the step, body axes [m/s], shape (3,).
        slip: Direction of its slip, shape (3,); zero if it stuck.
        there: 1 if it was there, else 0.
        attempts: How many have been made.
    """

    gain: SX
    slip: SX
    there: SX
    attempts: SX

    SIZE = 8

    @staticmethod
    def of(rows: SX) -> Hint:
        """Unpack a column, shape (SIZE,)."""
        return Hint(rows[:3], rows[3:6], rows[6], rows[7])

    @property
    def last(self) -> SX:
        """1 if two attempts have failed, so that the next must be safe."""
        return self.attempts > 1.5


@dataclass
class Contact:
    """A sphere that may be touching the ground, for the length of one step.

    Attributes:
        body: Name of the body that carries it.
        touch: Where it is.
        compliance: What it is made of.
        dt: Step length [s].
        hint: From the attempt before.
    """

    body: str
    touch: Touch
    compliance: Compliance
    dt: float
    hint: Hint

    def __post_init__(self) -> None:
        t, last = self.touch, self.hint.last
        force, slope = normal_law(t, self.compliance, self.dt)
        before, after = self._closing(SX(3, 1)), self._closing(self.hint.gain)
        pushes = ca.logic_or(force - slope * before > 0, force - slope * after > 0)
        share = self._share(before, after)
        self.above = t.depth <= 0
        self.there = ca.if_else(
            self.above, ca.logic_and(share > 0, ca.logic_or(pushes, last)), ca.logic_or(t.load > 0, pushes)
        )
        damped = ca.logic_and(self.above, last)
        self.normal_force = ca.if_else(ca.logic_and(self.there, ca.logic_not(damped)), force, 0)
        self.normal_slope = ca.if_else(self.there, ca.if_else(damped, share * slope, slope), 0)

    def _closing(self, gain: SX) -> SX:
        """Return the normal velocity [m/s], given what the velocity gains; negative towards the ground."""
        return ca.dot(self.touch.normal, self.touch.velocity + gain)

    def _share(self, before: SX, after: SX) -> SX:
        """Return the share of the step that a point above the ground will be in it; not positive if it will not."""
        if isinstance(self.dt, float) and self.dt == 0:  # the acceleration of the moment
            return SX(0)
        approach = ca.fmin(ca.fmin(before, after), -TINY_SPEED)
        foreseen = ca.if_else(after < 0, 1 - self.touch.depth / (self.dt * approach), 0)
        return ca.if_else(ca.logic_and(self.hint.last, self.hint.there), 1, foreseen)

    @property
    def sliding(self) -> SX:
        """Velocity of the point in the tangent plane, body axes [m/s], shape (3,)."""
        n, velocity = self.touch.normal, self.touch.velocity
        return velocity - ca.dot(n, velocity) * n

    def secant(self) -> ContactResponse:
        """Linearise about the present velocity, with the slope of sticking scaled into the cone."""
        cone, slope, x, size = self._trial(SX(3, 1))
        share = ca.fmin(1, cone / size)
        return self._response(share * x, share * slope, SX(3, 1), SX(3, 1))

    @property
    def released(self) -> SX:
        """1 in a second attempt if the first one, in which it stuck, took it out of the cone."""
        cone, _, _, size = self._trial(self.hint.gain)
        stuck = ca.logic_and(self.hint.attempts > 0.5, ca.sumsqr(self.hint.slip) < 0.5)
        return ca.logic_and(stuck, size > cone)

    def tangent(self) -> ContactResponse:
        """Linearise about the velocity of the attempt before, with the true slope, which is none along the slip.

        A contact that turned round in that attempt sticks. One that was held and left the cone is let go by the secant
        about what it has come to: which way it will slip is not known yet, as several may be let go at once. The last
        attempt takes the secant about the start.
        """
        safe, slipped = self.hint.last, self.hint.slip
        gain = ca.if_else(safe, 0, self.hint.gain)
        cone, slope, x, size = self._trial(gain)
        turned = ca.logic_and(ca.sumsqr(slipped) > 0.5, ca.dot(slipped, x) <= cone)
        slips = ca.logic_and(size > cone, ca.logic_or(safe, ca.logic_not(turned)))
        share = ca.if_else(slips, cone / size, 1)
        slip = ca.if_else(ca.logic_and(slips, ca.logic_not(ca.logic_or(safe, self.released))), x / size, 0)
        return self._response(share * x, share * slope, slip, gain)

    def misjudged(self, response: ContactResponse, gain: SX) -> SX:
        """Return 1 if the contact did not do what it was taken to do, given its gain in velocity; else 0.

        One taken to slip has turned round, one taken to stick has left the cone, one taken to stay away is in the
        ground, or one above it was pulled down. A safe attempt is never misjudged: there is nothing safer to try.
        """
        cone, _, x, size = self._trial(gain)
        tolerance = CONE_TOLERANCE + SECOND_TOLERANCE * self.hint.attempts
        out_of_cone = ca.logic_and(size > (1 + tolerance) * cone + CONE_FLOOR, ca.logic_not(self.released))
        slid = ca.if_else(ca.sumsqr(response.slip) > 0.5, ca.dot(response.slip, x) < cone, out_of_cone)
        arrived = self.touch.depth - self.dt * self._closing(gain) > 0
        pulled = ca.logic_and(self.above, self.normal_after(gain) < -CONE_FLOOR)
        wrong = ca.logic_or(slid, ca.if_else(self.there, pulled, arrived))
        return ca.logic_and(wrong, ca.logic_not(self.hint.last))

    def hint_after(self, gain: SX, slip: SX) -> SX:
        """Return the hint for another attempt, shape (Hint.SIZE,)."""
        return ca.vertcat(gain, slip, self.there, self.hint.attempts + 1)

    def anchor_after(self, gain: SX) -> SX:
        """Return the deflection of the bristle at the end of the step, body axes [m], given the gain in velocity."""
        c, n, velocity = self.compliance, self.touch.normal, self.touch.velocity + gain
        cone = ca.if_else(self.normal_slope > 0, c.friction * self.touch.load, 0)
        s = self.touch.anchor + self.dt * (velocity - ca.dot(n, velocity) * n)
        return s * ca.fmin(1, cone / (c.bristle * _length(s)))

    def normal_after(self, gain: SX) -> SX:
        """Return the normal force over the step [N], given the gain in velocity."""
        return self.normal_force - self.normal_slope * ca.dot(self.touch.normal, self.touch.velocity + gain)

    def _trial(self, gain: SX) -> tuple[SX, SX, SX, SX]:
        """Return the cone [N], and the slope [N s/m] and force (3,) [N] of a bristle that sticks, with its norm."""
        c, n, velocity = self.compliance, self.touch.normal, self.touch.velocity + gain
        cone = ca.if_else(self.normal_slope > 0, c.friction * self.touch.load, 0)
        slope = ca.if_else(cone > 0, cone / c.slip_speed + self.dt * c.bristle, 0)  # nothing sticks to the air
        x = slope * (velocity - ca.dot(n, velocity) * n) + ca.if_else(cone > 0, c.bristle, 0) * self.touch.anchor
        return cone, slope, x, _length(x)

    def _response(self, friction: SX, slope: SX, slip: SX, gain: SX) -> ContactResponse:
        n = self.touch.normal
        C = mirrored(slope * SX.eye(3) + (self.normal_slope - slope) * (n @ n.T) - slope * (slip @ slip.T))
        force = self.normal_after(gain) * n - friction + C @ gain
        return ContactResponse(force, C, slip, self.touch, self.dt)


def _length(x: SX) -> SX:
    return ca.sqrt(ca.sumsqr(x) + 1e-20)
