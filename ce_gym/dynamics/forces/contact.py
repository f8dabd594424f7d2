"""Penalty contact between spheres and the ground, linearly implicit in the step.

A contact is a spring and damper along the normal and a bristle in the tangent plane: an elastic deflection `s` from an
anchor, damped, that slips when it would carry more than Coulomb's cone allows. Its force is a function of the velocity
`v+` of the point at the end of the step, linearised about a velocity `w`,

    f+ = F(w) - C (v+ - w),    v+ = J (qd + dt qdd) = v + dt (J a - drift),    C = Dn n n^T + Dt,

with the acceleration `a` of the body still unknown. `dt J^T C J` joins the body's inertia before the inward pass and
the recursion stays linear in the number of bodies. This is Newton's method on backward Euler (Anitescu and Potra 2002)
with frozen normal, lever arm and Jacobian: the velocity product `drift` has no part in `v+`, or the force would do work
on the motion it is meant to stop. C is positive semidefinite: no step length makes a lasting contact unstable.

The laws of the normal force and of friction are in `normal.py` and `friction.py`. This file has the place of a contact,
when it is active, and its terms in the recursion.

A contact becomes active if it *will* be in the ground by the end of the step, `d - dt v_n > 0`, and pushes. A corner
that its velocity does not take there, but the velocity it has after another one hit the ground, becomes active in the
second iteration. A point that is turned back before it reaches the surface would be pulled down by the law. It makes a
third iteration, in which the damper `-share (c + dt k) v_n+` replaces the spring and can do no work. `share = 1 - d /
(dt v_n)` is the part of the step that the point spends in the ground. The prediction knows the velocity but not yet the
acceleration: a loaded foot that its spring has just lifted would be taken to be gone, fall back, and bounce on the
steps for ever. So a contact that pushed at the end of the last step is active in the first iteration while it is in the
ground.

A force never pulls. After the first iteration, a contact in the ground is active if its law pushes at the velocity that
the iteration before found: the primal-dual active set method (Hintermueller, Ito and Kunisch 2002). If three iterations
have not converged, up to `RELEASES` more release contacts that pull and make none active, which must end.

In the step in which a point lands, damping acts over the whole step, although the point is in the ground only for a
share of it, and friction has no load yet. Both are errors of first order in the step. Methods with `resolves_landing`
remove them: damping counts by `share`, and friction starts with the force at the velocity before the landing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX, cross, mirrored, skew, symmetric_blocks
from ce_gym.dynamics.forces.ground import above_deepest, sine
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.recursion.ce_aba import BodyTerms
from ce_gym.dynamics.recursion.kinematics import BodyState, constant
from ce_gym.model.description import ContactSphere

RELEASES = 4
"""Iterations in which contacts that pull are released, after those of friction."""
FORCE_FLOOR = 1e-6
"""Pull that counts as none [N]."""
TINY_SPEED = 1e-9
"""Keeps divisions finite [m/s]."""


@dataclass(frozen=True)
class Compliance:
    """Parameters of a contact, numbers or symbols.

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
    """Where a sphere is above the ground and how it moves, in world axes, where the normal of flat ground is constant.

    Attributes:
        R: Rotation of the body, body to world, shape (3, 3).
        normal: Unit normal out of the ground, shape (3,).
        point: The sphere's lowest point, in the body frame [m], shape (3,).
        depth: How far it is in the ground [m].
        velocity: Of the point [m/s], shape (3,).
        drift: Its acceleration while all of `vdot` is zero [m/s^2], shape (3,).
        load: Its normal force over the last step [N].
        anchor: Deflection of the bristle, shape (3,) [m].
    """

    R: SX
    normal: SX
    point: SX
    depth: SX
    velocity: SX
    drift: SX
    load: SX
    anchor: SX


def touch_ground(
    body: BodyState, sphere: ContactSphere, centre: SX, height: SX, normal: SX, load: SX, anchor: SX
) -> Touch:
    """Place a sphere against the plane that the ground is nearby.

    The deepest point of one that rolls is where it is at the start, as a sphere's is: another point of the body at each
    step, which moves as the body there does. Bristles are deflections in the world and need not know.

    Args:
        body: Kinematics of the body that carries it.
        sphere: The sphere, or the rim around which one moves.
        centre: Where its centre is in the body [m], shape (3,).
        height: Of the ground under the centre [m].
        normal: Unit normal of the ground there, world axes, shape (3,).
        load: Its normal force over the last step [N].
        anchor: Horizontal deflection of its bristle, world axes [m], shape (2,), or (0,) for none.
    """
    n = body.R.T @ normal
    axis = constant(np.array(sphere.axis))
    cosine = ca.dot(axis, n)
    depth = sphere.radius + sphere.rim * sine(cosine) - normal[2] * (body.point_position(centre)[2] - height)
    point = centre - above_deepest(sphere.radius, sphere.rim, n, axis, cosine)
    velocity, drift = body.point_velocity(point), body.drift[3:] + cross(body.drift[:3], point)
    deflection = SX(3, 1)
    if anchor.numel():  # in the tangent plane: the normal has no part in it
        deflection = ca.sparsify(ca.vertcat(anchor, -ca.dot(normal[:2], anchor) / normal[2]))
    return Touch(body.R, normal, point, depth, body.R @ velocity, body.R @ drift, load, deflection)


class NormalLaw(Protocol):
    """A law of the normal force, taken one step ahead."""

    def force(self, touch: Touch, compliance: Compliance, dt: float) -> tuple[SX, SX]:
        """Return the force as `force - slope * v_n+`, whether the contact is active or not [N], [N s/m]."""
        ...


@dataclass
class TangentialForce:
    """Friction, linear in the velocity `v + gain` of the point about an iterate: `-force - slope (v_t+ - v_t)`.

    Attributes:
        force: At the iterate, against the motion, world axes [N], shape (3,).
        slope: In the tangent plane, but none along the slip [N s/m].
        slip: Direction in which it slips, shape (3,); zero while it sticks.
        gain: Change of the velocity in the step at the iterate, world axes [m/s], shape (3,).
    """

    force: SX
    slope: SX
    slip: SX
    gain: SX


class FrictionLaw(Protocol):
    """A law of the friction of one contact.

    Attributes:
        iterations: How many iterations of a step it may ask for after the first.
    """

    iterations: int

    def linearise(self, contact: LinearContact) -> TangentialForce:
        """Linearise about the iterate of a contact whose normal force is known."""
        ...

    def check(self, contact: LinearContact, slip: SX, gain: SX) -> SX:
        """Return 1 if it slips where it was assumed to stick, or the other way round, given the gain; else 0."""
        ...


@dataclass
class Iterate:
    """Result of the iteration before for one contact; zero in the first iteration.

    Attributes:
        gain: Change of the point's velocity in the step, world axes [m/s], shape (3,).
        slip: Direction of the slip, shape (3,); zero if the contact stuck.
        active: 1 if the contact was active, else 0.
        count: How many iterations have been made.
    """

    gain: SX
    slip: SX
    active: SX
    count: SX

    SIZE = 8

    @staticmethod
    def of(rows: SX) -> Iterate:
        """Unpack a column, shape (SIZE,)."""
        return Iterate(rows[:3], rows[3:6], rows[6], rows[7])

    @property
    def last(self) -> SX:
        """1 if two iterations have not converged, so that the next must be safe."""
        return self.count > 1.5

    @property
    def releases(self) -> SX:
        """1 if a safe iteration has not converged either, so that contacts may only be released."""
        return self.count > 2.5


@dataclass
class Contact:
    """A sphere that may be touching the ground, for the length of one step.

    Attributes:
        body: Name of the body that carries it.
        touch: Where it is.
        compliance: Of the contact.
        normal: Law of its normal force.
        friction: Law of its friction.
        dt: Step length [s].
        near: 1 where it may act, 0 where it does not; None if it always may.
        resolves_landing: Whether the step in which the point lands is accurate to second order, see above.
    """

    body: str
    touch: Touch
    compliance: Compliance
    normal: NormalLaw
    friction: FrictionLaw
    dt: float
    near: SX | None = field(default=None, kw_only=True)
    resolves_landing: bool = field(default=False, kw_only=True)

    size = Iterate.SIZE

    def linearise(self, iterate: SX) -> LinearContact:
        """Linearise about an iterate, shape (size,)."""
        return LinearContact(self, Iterate.of(iterate))


class LinearContact:
    """A contact about an iterate: its force is `force - C gain`, with `gain` the change of the point's velocity.

    Attributes:
        law: The contact.
        body: Name of the body that carries it.
        iterate: From the iteration before.
        active: 1 if it is taken to touch the ground, else 0.
        force: For an unchanged velocity, world axes [N], shape (3,).
        C: Effective damping, world axes [N s/m], shape (3, 3).
        load: Normal force that limits friction [N].
        slip: Direction in which friction slips, shape (3,); zero while it sticks.
    """

    def __init__(self, law: Contact, iterate: Iterate) -> None:
        self.law, self.body, self.iterate = law, law.body, iterate
        t, last = law.touch, iterate.last
        force, slope = law.normal.force(t, law.compliance, law.dt)
        before, after = self._closing(SX(3, 1)), self._closing(iterate.gain)
        pushed, pushes = force - slope * before > 0, force - slope * after > 0
        share, first = self._share(before, after), iterate.count < 0.5
        self._above, self._law_force, self._law_slope = t.depth <= 0, force, slope
        above = ca.logic_and(share > 0, ca.logic_or(ca.logic_or(pushed, pushes), last))
        inside = ca.if_else(first, ca.logic_or(t.load > 0, pushed), pushes)
        kept = ca.logic_and(iterate.active, ca.if_else(self._above, after < 0, pushes))
        self.active = ca.if_else(iterate.releases, kept, ca.if_else(self._above, above, inside))
        damped = ca.logic_and(self._above, last)
        self.normal_force = ca.if_else(ca.logic_and(self.active, ca.logic_not(damped)), force, 0)
        self.normal_slope = ca.if_else(self.active, ca.if_else(damped, share * slope, slope), 0)
        self._slope_at_end, self.load = self.normal_slope, t.load
        if law.resolves_landing:
            damping = law.compliance.damping * ca.if_else(self._above, share, 1)
            _, shared = law.normal.force(t, replace(law.compliance, damping=damping), law.dt)
            self.normal_slope = ca.if_else(ca.logic_and(self.active, ca.logic_not(damped)), shared, self.normal_slope)
            self.load = ca.if_else(t.load > 0, t.load, ca.fmax(force - shared * before, 0))
        friction, n = law.friction.linearise(self), t.normal
        self.slip, slope = friction.slip, friction.slope
        tangential = ca.sparsify(mirrored(slope * (SX.eye(3) - n @ n.T - self.slip @ self.slip.T)))
        self.C = ca.sparsify(tangential + self.normal_slope * (n @ n.T))
        self.force = self.normal_after(SX(3, 1)) * n - friction.force + tangential @ friction.gain

    def _closing(self, gain: SX) -> SX:
        """Return the normal velocity [m/s] for a change of the velocity; negative towards the ground."""
        return ca.dot(self.law.touch.normal, self.law.touch.velocity + gain)

    def _share(self, before: SX, after: SX) -> SX:
        """Return the share of the step that a point above the ground will be in it; not positive if it will not."""
        depth, dt = self.law.touch.depth, self.law.dt
        if isinstance(dt, float) and dt == 0:  # the acceleration of the moment
            return SX(0)
        approach = ca.fmin(ca.fmin(before, after), -TINY_SPEED)
        foreseen = ca.if_else(after < 0, 1 - depth / (dt * approach), 0)
        return ca.if_else(ca.logic_and(self.iterate.last, self.iterate.active), 1, foreseen)

    @property
    def sliding(self) -> SX:
        """Velocity of the point in the tangent plane, world axes [m/s], shape (3,)."""
        return self._tangential(self.law.touch.velocity)

    def _tangential(self, velocity: SX) -> SX:
        n = self.law.touch.normal
        return ca.sparsify(velocity - ca.dot(n, velocity) * n)

    def trial(self, gain: SX) -> tuple[SX, SX, SX, SX]:
        """Return the cone [N], and the slope [N s/m] and force (3,) [N] of a bristle that sticks, with its norm."""
        c, touch = self.law.compliance, self.law.touch
        cone = self._cone()
        slope = ca.if_else(cone > 0, cone / c.slip_speed + self.law.dt * c.bristle, 0)  # nothing sticks to the air
        x = slope * self._tangential(touch.velocity + gain) + ca.if_else(cone > 0, c.bristle, 0) * touch.anchor
        return cone, slope, x, _length(x)

    def _cone(self) -> SX:
        return ca.if_else(self.normal_slope > 0, self.law.compliance.friction * self.load, 0)

    def body_terms(self, gravity: SX) -> BodyTerms:
        """Return the terms of the contact on its body in the inward pass.

        Args:
            gravity: Acceleration of free fall, world axes, shape (3,); the recursion's `a` does not contain it.
        """
        touch, dt = self.law.touch, self.law.dt
        r, C = skew(touch.point), mirrored(touch.R.T @ self.C @ touch.R)
        rC = r @ C
        inertia = symmetric_blocks(mirrored(rC @ r.T), rC, C) * dt
        force = touch.R.T @ (self.force - dt * (self.C @ (gravity - touch.drift)))
        return BodyTerms(inertia, ca.vertcat(cross(touch.point, force), force))

    def gain(self, motion: Motion) -> SX:
        """Return the change of the point's velocity in the step, world axes [m/s], shape (3,)."""
        if self in motion.gains:
            return motion.gains[self]
        touch, a = self.law.touch, motion.a[self.body]
        return self.law.dt * (touch.R @ (a[3:] + cross(a[:3], touch.point)) + motion.gravity - touch.drift)

    def check(self, motion: Motion) -> SX:
        """Return 1 if the active set is not the one that was assumed; else 0.

        Friction says otherwise, an inactive contact would push, or an active one pulls. Safe iterations are only
        checked for contacts that pull.
        """
        gain, depth = self.gain(motion), self.law.touch.depth
        slid, closing = self.law.friction.check(self, self.slip, gain), self._closing(gain)
        pushes = self._law_force - self._law_slope * closing > 0
        arrived = ca.if_else(self._above, depth - self.law.dt * closing > 0, pushes)
        pulls = ca.logic_and(self.active, self.normal_after(gain) < -FORCE_FLOOR)
        changed = ca.logic_or(slid, ca.if_else(self.active, pulls, arrived))
        return ca.if_else(self.iterate.last, pulls, changed)

    def next_iterate(self, motion: Motion) -> SX:
        """Return the iterate for another iteration, shape (Iterate.SIZE,)."""
        return ca.vertcat(self.gain(motion), self.slip, self.active, self.iterate.count + 1)

    def force_after(self, gain: SX) -> SX:
        """Return the force over the step, world axes [N], given the gain in velocity."""
        return self.force - self.C @ gain

    def normal_after(self, gain: SX) -> SX:
        """Return the normal force over the step [N], given the gain in velocity."""
        return self.normal_force - self.normal_slope * ca.dot(self.law.touch.normal, self.law.touch.velocity + gain)

    def load_after(self, gain: SX) -> SX:
        """Return the normal force at the end of the step [N], given the gain in velocity."""
        return self.normal_force - self._slope_at_end * self._closing(gain)

    def anchor_after(self, gain: SX) -> SX:
        """Return the deflection of the bristle at the end of the step, world axes [m], given the gain in velocity."""
        touch = self.law.touch
        s = touch.anchor + self.law.dt * self._tangential(touch.velocity + gain)
        return s * ca.fmin(1, self._cone() / (self.law.compliance.bristle * _length(s)))


def where(near: SX | None, x: SX, otherwise: SX | float = 0.0) -> SX:
    """Return `x` where something may act, see `Contact.near`, else what there is without it."""
    return x if near is None else ca.if_else(near, x, otherwise)


def _length(x: SX) -> SX:
    return ca.sqrt(ca.sumsqr(x) + 1e-20)
