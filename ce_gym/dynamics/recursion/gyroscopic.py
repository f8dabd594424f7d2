"""Stabilised gyroscopic terms of a rotating base, of ball joints, and of joints on rotating bodies.

*The base.* On a freely rotating body, an explicit step with the gyroscopic moment `-w x L` adds the energy
`dt^2 |w x L|^2 / (2 I)`: a body that tumbles at 20 rad/s diverges within 15 s at 5 ms. Here a part is implicit,
`(J w) x w+`, with J the inertia about the centre of mass of the robot frozen in its standing pose. This adds the
*antisymmetric* matrix `-dt skew(J w)` to the inertia of the base. For one rigid body the step then satisfies
`w+^T J w+ = w+^T J w`: the energy never grows, at any step length. In another pose the difference stays explicit; J
needs to be correct within a factor of two only, as in any linearly implicit method.

*Ball joints.* The same instability exists on a ball joint. Its articulated inertia must stay symmetric, so the implicit
part is computed beforehand for the body and its descendants frozen into one rigid body, with inertia J about the joint:
`(J - dt skew(J w)) dw = dt (J w) x w` gives `dw`, and `J dw / dt` replaces `(J w) x w`.

*The joints.* Their Coriolis forces stay explicit, with an error that grows with a^2 if a step rotates the carrier by
`a = dt w`. Such joints are damped implicitly at a rate `4 a^4 / dt`. At 10 rad/s and 5 ms the rate is 0.005/s, less
than any joint's own friction and far below the error of the step. At half a radian per step the rate is 50/s.

All terms vanish with the step length and do not change the order of the method.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, skew, solve_positive_definite
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, is_free, outward_velocity_pass
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


def frozen_inertia(mechanism: Mechanism) -> SX:
    """Return the inertia of a floating robot in its standing pose about its centre of mass, base axes, (3, 3)."""
    base = frozen_inertias(mechanism)[next(iter(mechanism.bodies))]
    return base[:3, :3] - base[:3, 3:] @ base[:3, 3:].T / base[5, 5]


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


def turning_momentum(mechanism: Mechanism, v: SX, dt: float) -> SX | None:
    """Return `dt J w` of a floating robot with velocities `v` (nv,), base axes [kg m^2], (3,); None for a fixed one."""
    free = any(is_free(mechanism, cluster) for cluster in mechanism.tree.clusters)
    return dt * (frozen_inertia(mechanism) @ v[:3]) if free else None


def solve_turning(inertia: SX, turning: SX, force: SX) -> SX:
    """Solve `(inertia - [skew(turning), 0; 0, 0]) a = force` for the acceleration of a base, shape (6, n).

    Args:
        inertia: Symmetric positive definite, angular part first, shape (6, 6).
        turning: Shape (3,).
        force: Shape (6, n).
    """
    across = inertia[:3, 3:]
    linear = solve_positive_definite(inertia[3:, 3:], ca.horzcat(across.T, force[3:, :]))
    schur = inertia[:3, :3] - across @ linear[:, :3] - skew(turning)
    moment = force[:3, :] - across @ linear[:, 3:]
    angular = ca.horzcat(*[_solve_three(schur, moment[:, i]) for i in range(moment.shape[1])])
    return ca.vertcat(angular, linear[:, 3:] - linear[:, :3] @ angular)


def _solve_three(A: SX, b: SX) -> SX:
    """Cramer's rule; the determinant of a positive definite matrix plus an antisymmetric one is positive."""
    x, y, z = A[:, 0], A[:, 1], A[:, 2]
    yz = cross(y, z)
    return ca.vertcat(ca.dot(b, yz), ca.dot(b, cross(z, x)), ca.dot(b, cross(x, y))) / ca.dot(x, yz)
