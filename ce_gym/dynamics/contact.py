"""Penalty contact between spheres and flat ground, linearly implicit in the step.

A contact is a spring and damper in the normal direction and regularised Coulomb friction in the tangent plane. Its
force is taken one step ahead: with the acceleration `a` of the body still unknown,

    f+ = f0 - dt C (J a + w x v_p),        C = Dn n n^T + Dt (1 - n n^T),   Dn = d + dt k,   Dt = mu lam / s,

so that `dt J^T C J` joins the body's inertia before the inward pass and the recursion stays linear in the number of
bodies. This is one Newton step of backward Euler (Anitescu and Potra 2002) with frozen normal, lever arm and normal
force in the friction; it is dissipative for every step length because C is positive semidefinite.

A contact begins if it *will* be in the ground by the end of the step, `depth + dt depth' > 0`, and pushes; with the
second condition alone the damper would act above the ground. The prediction knows the velocity but not yet the
acceleration. A loaded foot that its spring has just lifted would therefore be judged gone, fall back, and bounce on the
steps for ever; so a contact that pushed at the end of the last step goes on as long as it is in the ground. It ends
when the solution would pull: an active-set method whose iterations are the steps. May know spatial algebra; no robots,
no recursions.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.ce_aba import BodyTerms
from ce_gym.dynamics.kinematics import BodyState
from ce_gym.dynamics.spatial import SX, cross, mirrored, skew, symmetric_blocks
from ce_gym.model.description import ContactMaterial

SLIP_SPEED = 1e-2
"""Slip speed at which regularised friction reaches 1/sqrt(2) of its full value [m/s]."""


@dataclass
class ContactResponse:
    """One contact's force as an affine function of its body's acceleration.

    Attributes:
        force: Force at zero acceleration, body axes [N], shape (3,).
        C: Effective damping, body axes [N s/m], shape (3, 3).
        normal: Unit normal out of the ground, body axes, shape (3,).
        point: Where it acts, in the body frame [m], shape (3,).
        bias: `w x v_p`, shape (3,).
        dt: Step length [s].
    """

    force: SX
    C: SX
    normal: SX
    point: SX
    bias: SX
    dt: float

    def body_terms(self, gravity: SX) -> BodyTerms:
        """Return what the contact adds to its body before the inward pass.

        Args:
            gravity: Acceleration of free fall in body axes, shape (3,); the recursion's `a` does not contain it.
        """
        r = skew(self.point)
        rC = r @ self.C
        inertia = symmetric_blocks(mirrored(rC @ r.T), rC, self.C) * self.dt
        force = self.force - self.dt * (self.C @ (self.bias + gravity))
        return BodyTerms(inertia, ca.vertcat(cross(self.point, force), force))

    def force_after(self, a: SX, gravity: SX) -> SX:
        """Return the force over the step, body axes [N], once the body's acceleration minus gravity is known."""
        point_acceleration = a[3:] + cross(a[:3], self.point) + gravity + self.bias
        return self.force - self.dt * (self.C @ point_acceleration)


def ground_contact(
    body: BodyState, position: SX, radius: float, pushed: SX, material: ContactMaterial, dt: float
) -> ContactResponse:
    """Evaluate a sphere against the plane z = 0.

    Args:
        body: Kinematics of the body that carries it.
        position: Centre of the sphere in the body frame [m], shape (3,).
        radius: [m].
        pushed: 1 if the contact pushed at the end of the last step, else 0.
        material: Compliance and friction.
        dt: Step length [s].
    """
    n = body.R[2, :].T  # upwards, in body axes
    depth = radius - (body.p[2] + ca.dot(n, position))
    point = position - radius * n
    velocity = body.point_velocity(point)
    normal_speed = ca.dot(n, velocity)
    normal_slope = material.damping + dt * material.stiffness
    pushing = material.stiffness * depth - normal_slope * normal_speed
    begins = ca.logic_and(depth - dt * normal_speed > 0, pushing > 0)
    active = ca.logic_or(begins, ca.logic_and(pushed > 0.5, depth > 0))
    normal_force = ca.if_else(active, pushing, 0)
    slip = velocity - normal_speed * n
    tangent_slope = material.friction * ca.fmax(normal_force, 0) / ca.sqrt(ca.sumsqr(slip) + SLIP_SPEED**2)
    normal_excess = ca.if_else(active, normal_slope, 0) - tangent_slope
    C = mirrored(tangent_slope * SX.eye(3) + normal_excess * (n @ n.T))
    return ContactResponse(
        force=normal_force * n - tangent_slope * slip,
        C=C,
        normal=n,
        point=point,
        bias=cross(body.v[:3], velocity),
        dt=dt,
    )
