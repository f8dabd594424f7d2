"""Contact between links of a robot, as capsules: a spring and a damper along the line between their axes.

The implicit force of a pair depends on the accelerations of two branches, which the recursion cannot take into one
body's inertia. But accelerations are linear in the forces `lam` of pairs. So the recursion runs with these as unknowns.
The change of the pairs' normal velocities, `g = g0 + W lam`, enters the law `lam = f - D (v_n + g)` of each pair:

    (1 + D W) lam = f - D (v_n + g0),

one small system, solved exactly. Force and reaction are the same number at the same line, so that both momenta are
kept, and a contact that lasts adds no energy, as on the ground: `W` is positive semidefinite, `D` is not negative.
There is no friction. Which pairs act is found by the iterations of the step, as for contacts with the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX, cross, solve_positive_definite
from ce_gym.dynamics.forces.contact import (
    Compliance,
    Contact,
    Iterate,
    LinearContact,
    NormalLaw,
    TangentialForce,
    Touch,
    where,
)
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.recursion.ce_aba import (
    Articulation,
    BodyTerms,
    gravity_acceleration,
)
from ce_gym.dynamics.recursion.kinematics import BodyState, Kinematics, constant
from ce_gym.dynamics.standing import Standing, standing_pose
from ce_gym.model.checks.collisions import capsules_of, separate_links
from ce_gym.model.description import Capsule
from ce_gym.model.mechanism import Mechanism

PARALLEL = 1e-6
"""Square of the sine below which axes count as parallel; the middle of them then is where they touch."""
APART = 1e-9
"""Keeps the distance between axes from zero [m]."""


class Frictionless:
    """No force but along the normal."""

    iterations = 2

    def linearise(self, contact: LinearContact) -> TangentialForce:
        """Return no force."""
        return TangentialForce(SX(3, 1), SX(1, 1), SX(3, 1), SX(3, 1))

    def check(self, contact: LinearContact, slip: SX, gain: SX) -> SX:
        """Return that nothing has changed."""
        return SX(0)


@dataclass
class Ends:
    """A capsule on a body, and where the other one is nearest to it.

    Attributes:
        name: Of the body.
        body: Its kinematics.
        point: Of the axis that is nearest to the other's, in the body frame [m], shape (3,).
        push: Direction away from the other, in the body frame, shape (3,).
    """

    name: str
    body: BodyState
    point: SX
    push: SX

    def along(self, motion: SX) -> SX:
        """Return what of a spatial motion of the body (6,) moves the point away from the other's."""
        return ca.dot(self.push, motion[3:] + cross(motion[:3], self.point))

    def jacobian(self, J: SX) -> SX:
        """Return the Jacobian (1, nv) of what `along` returns, given that of the point in world axes, shape (3, nv)."""
        return (self.body.R @ self.push).T @ J

    @property
    def wrench(self) -> SX:
        """Wrench of a unit force on the body, body coordinates, shape (6,)."""
        return ca.vertcat(cross(self.point, self.push), self.push)


@dataclass
class Pair(Contact):
    """Two capsules of a robot that may touch, for the length of one step.

    Its touch is in axes of its own, whose first is the normal.

    Attributes:
        ends: Both.
    """

    ends: tuple[Ends, Ends]

    def linearise(self, iterate: SX) -> LinearPair:
        """Linearise about an iterate, shape (size,)."""
        return LinearPair(self, Iterate.of(iterate))


class LinearPair(LinearContact):
    """A pair about an iterate."""

    law: Pair

    def gain(self, motion: Motion) -> SX:
        """Return the change of the normal velocity in the step [m/s], as the first of (3,)."""
        if self in motion.gains:
            return motion.gains[self]
        first, second = (end.along(motion.a[end.name] - end.body.drift) for end in self.law.ends)
        return _normal(self.law.dt * (first + second))


def pair_between(
    capsules: tuple[Capsule, Capsule],
    bodies: tuple[BodyState, BodyState],
    load: SX,
    compliance: Compliance,
    normal: NormalLaw,
    dt: float,
) -> Pair:
    """Place two capsules against each other.

    Args:
        capsules: Both.
        bodies: Kinematics of the bodies that carry them.
        load: Force between them over the last step [N].
        compliance: Of the contact; its friction is not used.
        normal: Law of the force.
        dt: Step length [s].
    """
    axes = [[constant(np.array(end)) for end in (capsule.start, capsule.end)] for capsule in capsules]
    placed = [[body.point_position(end) for end in axis] for axis, body in zip(axes, bodies, strict=True)]
    shares = nearest(*placed[0], *placed[1], long=tuple(capsule.start != capsule.end for capsule in capsules))
    points = [a + share * (b - a) for (a, b), share in zip(axes, shares, strict=True)]
    apart = bodies[0].point_position(points[0]) - bodies[1].point_position(points[1])
    distance = ca.sqrt(ca.sumsqr(apart) + APART**2)
    n = apart / distance
    first, second = (
        Ends(capsule.body, body, point, body.R.T @ (sign * n))
        for capsule, body, point, sign in zip(capsules, bodies, points, (1, -1), strict=True)
    )
    closing = first.along(first.body.v) + second.along(second.body.v)
    depth = capsules[0].radius + capsules[1].radius - distance
    still = SX(3, 1)
    touch = Touch(SX.eye(3), _normal(SX(1)), still, depth, _normal(closing), still, load, still)
    names, ends = f"{first.name} {second.name}", (first, second)
    return Pair(names, touch, compliance, normal, Frictionless(), dt, ends)


def nearest(a: SX, b: SX, c: SX, d: SX, long: tuple[bool, ...] = (True, True)) -> tuple[SX, SX]:
    """Return where two segments are nearest to each other, as shares of their lengths.

    Source: Ericson, "Real-Time Collision Detection", 2005, section 5.1.9; without branches.

    Args:
        a: Start of the first, shape (3,).
        b: Its end.
        c: Start of the second.
        d: Its end.
        long: Whether each has a length.
    """
    u, w, r = b - a, d - c, a - c
    uu, ww, uw, ur, wr = ca.sumsqr(u), ca.sumsqr(w), ca.dot(u, w), ca.dot(u, r), ca.dot(w, r)
    if not long[1]:
        return (_clipped(-ur / uu) if long[0] else SX(0)), SX(0)
    if not long[0]:
        return SX(0), _clipped(wr / ww)
    small = PARALLEL * uu * ww
    share = _clipped((uw * wr - ur * ww + small / 2) / (uu * ww - uw**2 + small))
    other = _clipped((uw * share + wr) / ww)
    return _clipped((uw * other - ur) / uu), other


def apart_when_standing(mechanism: Mechanism) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links that are not adjacent and whose capsules do not overlap in the standing pose."""
    standing, robot = standing_pose(mechanism), mechanism.robot
    return tuple(
        (first, second)
        for first, second in separate_links(robot)
        if all(distance(standing, a, b) > 0 for a in capsules_of(robot, first) for b in capsules_of(robot, second))
    )


def distance(standing: Standing, a: Capsule, b: Capsule) -> float:
    """Return the distance of two capsules [m], negative if they overlap."""
    points = [(capsule.body, np.array(end)) for capsule in (a, b) for end in (capsule.start, capsule.end)]
    ends = [standing.p[body] + standing.R[body] @ point for body, point in points]
    shares = nearest(*[SX(ca.DM(end)) for end in ends], long=(a.start != a.end, b.start != b.end))
    s, t = (float(ca.evalf(SX(share))) for share in shares)
    apart = ends[0] + s * (ends[1] - ends[0]) - ends[2] - t * (ends[3] - ends[2])
    return float(np.linalg.norm(apart)) - a.radius - b.radius


def add_pair_forces(external: dict[str, BodyTerms], pairs: Sequence[LinearPair], forces: SX) -> dict[str, BodyTerms]:
    """Return what acts on bodies with the forces of pairs [N], shape (n_pairs,)."""
    result = dict(external)
    for i, pair in enumerate(pairs):
        for end in pair.law.ends:
            old = result.get(end.name, BodyTerms(SX(6, 6), SX(6, 1)))
            result[end.name] = BodyTerms(old.inertia, old.force + end.wrench * forces[i])
    return result


def solve_pair_forces(
    mechanism: Mechanism,
    kinematics: Kinematics,
    articulation: Articulation,
    pairs: Sequence[LinearPair],
    forces: SX,
    carried: bool = True,
) -> Articulation:
    """Return the articulation with the forces of pairs.

    Let `Y` be the generalised force that a unit force of each pair leaves at a cluster or the base in the inward pass,
    `u` that of all other forces, `d` the acceleration of the carrier of a cluster while vdot is zero, and `J` the
    Jacobian of the pairs' distances. Then `J A^-1 J^T = sum Y^T D^-1 Y` and `J vdot = sum Y^T D^-1 (u - U^T d)`,
    because the recursion is a factorisation of `A`.

    Args:
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        articulation: From the inward pass, in terms of the forces.
        pairs: About an iterate.
        forces: Symbols of their forces, shape (n_pairs,).
        carried: Whether handles accelerate while all of vdot is zero; not in joint space.
    """
    n, near = len(pairs), pairs[0].law.near
    left = {k: _apart(u, forces) for k, u in articulation.u.items()}
    gains, acting = SX(n, n + 1), replace(articulation, u={}, stretched={})
    for k, (Y, u) in left.items():
        if Y.nnz():
            free = u - articulation.U[k].T @ _carried(mechanism, kinematics, articulation, k) if carried else u
            gains += Y.T @ solve_positive_definite(articulation.D[k], ca.horzcat(Y, free))
    if articulation.base is not None:
        inertia, (Y, wrench) = articulation.base[0], _apart(articulation.base[1], forces)
        wrenches = ca.horzcat(Y, wrench)
        gains += Y.T @ solve_positive_definite(inertia, wrenches)
    W, free_gains = gains[:, :n], gains[:, n]
    start = [pair.normal_after(_normal(pair.law.dt * free_gains[i])) for i, pair in enumerate(pairs)]
    slopes = ca.vertcat(*[pair.law.dt * pair.normal_slope for pair in pairs])
    pressed = eliminated(SX.eye(n) + ca.diag(slopes) @ W, ca.vertcat(*start))
    acting.u = {k: where(near, u + Y @ pressed, u) for k, (Y, u) in left.items()}
    if articulation.base is not None:
        acting.base = inertia, where(near, wrench + Y @ pressed, wrench)
    return acting


def _apart(u: SX, forces: SX) -> tuple[SX, SX]:
    """Return the factor of the pairs' forces in a linear expression, and the rest."""
    return ca.sparsify(ca.jacobian(u, forces)), ca.substitute(u, forces, SX(ca.DM.zeros(forces.numel())))


def _carried(mechanism: Mechanism, kinematics: Kinematics, articulation: Articulation, k: int) -> SX:
    """Return how a handle accelerates while all of `vdot` is zero, shape (6,); on a fixed base minus gravity."""
    output, handle = mechanism.tree.clusters[k].output_body, articulation.handle_body[k]
    drift, R = SX(6, 1), SX.eye(3)
    if output is not None:
        drift, R = kinematics.bodies[output].drift, kinematics.bodies[output].R
    if handle:
        drift, R = kinematics.bodies[handle].X.motion(drift), kinematics.bodies[handle].R
    return drift if articulation.base else drift - ca.vertcat(SX(3, 1), R.T @ gravity_acceleration(mechanism))


def eliminated(A: SX, b: SX) -> SX:
    """Solve `A x = b` without pivoting, where `A` is positive definite but for a scaling of rows and columns."""
    n, rows, x = b.numel(), [A[i, :] for i in range(b.numel())], [b[i] for i in range(b.numel())]
    for i in range(n):
        for j in range(i + 1, n):
            factor = rows[j][i] / rows[i][i]
            rows[j], x[j] = rows[j] - factor * rows[i], x[j] - factor * x[i]
    for i in reversed(range(n)):
        x[i] = (x[i] - sum((rows[i][j] * x[j] for j in range(i + 1, n)), SX(0))) / rows[i][i]
    return ca.vertcat(*x)


def _normal(x: SX) -> SX:
    return ca.sparsify(ca.vertcat(x, SX(2, 1)))


def _clipped(x: SX) -> SX:
    return ca.fmax(0, ca.fmin(1, x))
