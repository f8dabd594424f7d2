"""Gyroscopic terms to which explicit integration adds energy, stabilised: of a turning base, and of joints on one.

*The base.* A body that turns freely feels `-w x L`, by which an explicit step adds energy, `dt^2 |w x L|^2 / (2 I)`
each time: one that tumbles at 20 rad/s is lost within 15 s at 5 ms. Here a part is taken one step ahead, `(J w) x w+`,
with J the inertia of the robot in its standing pose about its centre of mass, frozen into one rigid body. That adds the
*antisymmetric* matrix `-dt skew(J w)` to the inertia of the base. For one rigid body the step then reads
`w+^T J w+ = w+^T J w`: its energy never grows, whatever the step length. A robot in another pose keeps the difference
explicit; J needs to be right only within a factor of two, as in any method that takes a part of its derivative.

*Ball joints.* The same happens to a body on a ball joint. Its articulated inertia must stay symmetric, so the implicit
part is found beforehand, for the body and what it carries frozen into one rigid body, with J its inertia about the
joint: `(J - dt skew(J w)) dw = dt (J w) x w` gives `dw`, and `J dw / dt` takes the place of `(J w) x w`.

*The joints.* Their Coriolis forces stay explicit; what those make of a turn by `a = dt w` within a step grows with a^2.
Joints carried by a body that turns so are damped at a rate `4 a^4 / dt`, implicitly: at 10 rad/s and 5 ms 0.005/s,
which is less than any joint's own friction and far below the error of the step; where a step turns the body by half a
radian and resolves nothing any more, 50/s.

Both vanish with the step and leave its order as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, skew, solve_positive_definite
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, is_free, outward_velocity_pass
from ce_gym.model.mechanism import Mechanism

TURNING_DAMPING = 4.0
"""Factor on the fourth power of the angle turned in a step, see above."""


@dataclass(frozen=True)
class TurningDamping:
    """The step in which joints on turning bodies are damped.

    Attributes:
        v: Velocities, shape (nv,).
        dt: [s].
    """

    v: SX
    dt: float

    def on(self, D: SX, rows: list[int], w: SX) -> tuple[SX, SX]:
        """Return the addition to a cluster's inertia `D`, and the force, given the turning of its carrier [rad/s]."""
        rate = TURNING_DAMPING * self.dt**3 * ca.sumsqr(w) ** 2
        return rate * self.dt * D, -rate * (D @ self.v[rows])


def frozen_inertia(mechanism: Mechanism) -> SX:
    """Return the inertia of a floating robot in its standing pose about its centre of mass, base axes, (3, 3)."""
    base = frozen_inertias(mechanism)[next(iter(mechanism.bodies))]
    return base[:3, :3] - base[:3, 3:] @ base[:3, 3:].T / base[5, 5]


def frozen_inertias(mechanism: Mechanism) -> dict[str, SX]:
    """Return the inertia of each body and what it carries in the standing pose, about its origin, body axes, (6, 6)."""
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
        left = cross(momentum, w)
        couples[name] = J @ _solve_three(J - dt * skew(momentum), left) - left
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
    left = inertia[:3, :3] - across @ linear[:, :3] - skew(turning)
    moment = force[:3, :] - across @ linear[:, 3:]
    angular = ca.horzcat(*[_solve_three(left, moment[:, i]) for i in range(moment.shape[1])])
    return ca.vertcat(angular, linear[:, 3:] - linear[:, :3] @ angular)


def _solve_three(A: SX, b: SX) -> SX:
    """Cramer's rule; the determinant of a positive definite matrix plus an antisymmetric one is positive."""
    x, y, z = A[:, 0], A[:, 1], A[:, 2]
    yz = cross(y, z)
    return ca.vertcat(ca.dot(b, yz), ca.dot(b, cross(z, x)), ca.dot(b, cross(x, y))) / ca.dot(x, yz)
