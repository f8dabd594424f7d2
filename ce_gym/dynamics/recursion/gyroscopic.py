"""Stabilised gyroscopic terms of ball joints, and of joints on rotating bodies.

The momentum of a robot and its energy in flight are conserved, see `stepping/conservation.py`. These terms stabilise
robots that turn fast while something touches them.

*Ball joints.* An explicit gyroscopic moment `-w x L` adds the energy `dt^2 |w x L|^2 / (2 I)` in each step. Here it is
implicit, computed beforehand for the body and its descendants frozen into one rigid body, with inertia J about the
joint: `(J - dt skew(J w)) dw = dt (J w) x w` gives `dw`, and `J dw / dt` replaces `(J w) x w`.

*The joints.* Their Coriolis forces stay explicit, with an error that grows with a^2 if a step rotates the carrier by
`a = dt w`. Such joints are damped implicitly at a rate `4 a^4 / dt`. At 10 rad/s and 5 ms the rate is 0.005/s, less
than any joint's own friction and far below the error of the step. At half a radian per step the rate is 50/s.

Both terms vanish with the step length and do not change the order of the method.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, skew
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.model.mechanism import Mechanism

TURNING_DAMPING = 4.0
"""Factor on the fourth power of the rotation angle in a step, see above."""


@dataclass(frozen=True)
class TurningDamping:
    """The step in which joints on turning bodies are damped.

    Attributes:
        v: Velocities, shape (nv,).
        dt: Step length [s].
    """

    v: SX
    dt: float

    def on(self, D: SX, rows: list[int], w: SX) -> tuple[SX, SX]:
        """Return the addition to a cluster's `D`, and the force, at an angular velocity `w` of its carrier [rad/s]."""
        rate = TURNING_DAMPING * self.dt**3 * ca.sumsqr(w) ** 2
        return rate * self.dt * D, -rate * (D @ self.v[rows])


def frozen_inertias(mechanism: Mechanism) -> dict[str, SX]:
    """Return the inertia of each body and its descendants in the standing pose, about its origin, body axes, (6, 6)."""
    robot = mechanism.robot
    kinematics = outward_velocity_pass(mechanism, SX(ca.DM(robot.standing_q)), SX(robot.layout.nv, 1))
    total = {name: constant(body.inertia) for name, body in mechanism.bodies.items()}
    for name in reversed(mechanism.bodies):
        parent = mechanism.bodies[name].parent
        if parent is not None:
            total[parent] = total[parent] + kinematics.bodies[name].X.inertia_to_parent(total[name])
    return total


def steadying_couples(mechanism: Mechanism, kinematics: Kinematics, dt: float) -> dict[str, SX]:
    """Return the couple on the body of each ball joint that makes its gyroscopic terms implicit, body axes [N m]."""
    couples, total = {}, frozen_inertias(mechanism) if mechanism.robot.balls else {}
    for name in mechanism.robot.balls:
        J, w = total[name][:3, :3], kinematics.bodies[name].v[:3]
        momentum = J @ w
        explicit = cross(momentum, w)
        couples[name] = J @ _solve_three(J - dt * skew(momentum), explicit) - explicit
    return couples


def _solve_three(A: SX, b: SX) -> SX:
    """Cramer's rule; the determinant of a positive definite matrix plus an antisymmetric one is positive."""
    x, y, z = A[:, 0], A[:, 1], A[:, 2]
    yz = cross(y, z)
    return ca.vertcat(ca.dot(b, yz), ca.dot(b, cross(z, x)), ca.dot(b, cross(x, y))) / ca.dot(x, yz)
