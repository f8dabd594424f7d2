"""Dry friction of joints and rotors, linearly implicit in the step: it sticks or slips.

The state at the end of the step decides which, see saturation.py. So friction never exceeds its torque at any step
length. Dependent joints have friction, too. With `W` the row of the constraint Jacobian, a dependent joint moves at
`W yd`, and its friction tau acts as `W^T tau` on the independent joints of its cluster. In a cluster with one degree of
freedom all frictions add up to one, `sum |W_i| f_i`.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.linear import JointForce, is_moment
from ce_gym.dynamics.forces.saturation import Saturation, Stick
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.model.mechanism import Mechanism

STICK_SPEED = 1e-4
"""Speed at which dry friction reaches its full torque; a joint or rotor that sticks and is slower is at rest [rad/s or
m/s]."""
STICK_ACCELERATION, STICK_ACCELERATION_ALONE = 2e-3, 1e-5
"""That speed at rest is this times the step, in a cluster with several degrees of freedom and with one [rad/s^2].

Breakaway is late by it times the inertia. The damping of a rotor that sticks must leave digits for the other motions of
its cluster, which single precision has few of; a cluster with one degree of freedom has no others.
"""
INDEPENDENT = 1e-6
"""Least determinant of directions for them to be independent."""


def has_dry_friction(friction: float | SX) -> bool:
    """Return whether something has dry friction: a number that is not 0, or a symbol that may not be."""
    return isinstance(friction, SX) or bool(friction)


def dry_friction(
    friction: SX | float, speed: SX, turning: SX, dt: float, iterate: SX, place: int, alone: bool
) -> tuple[Saturation, SX, SX]:
    """Return the dry friction of a joint or a rotor: the torque that stops it, within the limits of the friction.

    A joint sticks by a damping that leaves at most `STICK_SPEED` at the end of the step. Where this damping would need
    more than the friction, the joint slips, against a constant torque. At rest the damping is larger, and `stand_still`
    removes the remaining speed.

    Args:
        friction: Largest torque or force [N m or N].
        speed: Of the joint or rotor [rad/s or m/s].
        turning: Speed of the joint or rotor for unit velocities of all independent joints, shape (1, nj).
        dt: Length of the step [s].
        iterate: From the iteration before, shape (limit_count,).
        place: Row of this torque in the iterate.
        alone: Whether the cluster of the joint has one degree of freedom.

    Returns:
        The torque; whether the joint or rotor is at rest at the start of the step, 1 or 0; the damping [N m s/rad].
    """
    rests, still = ca.fabs(speed) <= STICK_SPEED, SX(1, turning.numel())
    slowest = ca.fmin(STICK_SPEED, dt * (STICK_ACCELERATION_ALONE if alone else STICK_ACCELERATION))
    damping = SX(friction) / (STICK_SPEED if is_moment(dt) else ca.if_else(rests, slowest, STICK_SPEED))
    ends = JointForce(SX(friction), still), JointForce(SX(-friction), still)
    torque = Saturation.about(iterate, place, JointForce(-damping * speed, dt * damping * turning), *ends)
    if is_moment(dt):
        return torque, rests, damping
    expected = ca.if_else(iterate[-1] > 0, torque.expected, ca.if_else(rests, 0, torque.expected))
    return replace(torque, expected=expected), rests, damping


def stand_still(
    mechanism: Mechanism, kinematics: Kinematics, frictions: list[Stick], before: SX, q: SX, v: SX, dt: float
) -> None:
    """Keep joints that dry friction holds at rest, in place, in positions (nq,) and velocities (nv,) after a step.

    A cluster does not move if friction sticks along as many independent directions as the cluster has degrees of
    freedom. An independent joint that sticks does not move. A rotor that sticks behind an elastic transmission does not
    turn: the stretch takes up the motion of its joints.

    Args:
        mechanism: The robot.
        kinematics: At the start of the step.
        frictions: Dry friction of joints and rotors.
        before: Positions at the start of the step.
        q: Positions after the step.
        v: Velocities after the step.
        dt: Length of the step [s].
    """
    robot, layout = mechanism.robot, mechanism.robot.layout
    first_q, first_v = layout.joints_q, layout.joints_v
    for rows_of_v in kinematics.rows:
        rows = [row - first_v for row in rows_of_v if row >= first_v]
        acting = [friction for friction in frictions if ca.sparsify(friction.turning[rows]).nnz()] if rows else []
        may_stand = len(acting) >= len(rows) > 0
        stands = _stands(acting, rows) if may_stand else SX(0)
        for friction in acting:
            sticks, rests = friction.sticks, ca.logic_and(friction.sticks, friction.rests)
            columns = ca.sparsify(friction.turning[rows]).sparsity().get_col()
            if len(columns) == 1:
                row = rows[columns[0]]
                q[first_q + row] = ca.if_else(sticks, before[first_q + row], q[first_q + row])
                v[first_v + row] = ca.if_else(rests, 0, v[first_v + row])
            stretch = [rows[column] for column in columns if rows[column] >= len(robot.commanded)]
            if len(stretch) == 1 and len(columns) > 1:
                row, ratio = stretch[0], friction.turning[stretch[0]]
                speed_of_joints = friction.turning @ v[first_v:] - ratio * v[first_v + row]
                v[first_v + row] = ca.if_else(rests, -speed_of_joints / ratio, v[first_v + row])
                q[first_q + row] = ca.if_else(rests, before[first_q + row] + dt * v[first_v + row], q[first_q + row])
        if may_stand:
            stopping = sum((friction.sticks * ca.logic_not(friction.rests) for friction in acting), SX(0))
            rest = ca.logic_and(stands, stopping < 0.5)
            for row in rows:
                q[first_q + row] = ca.if_else(stands, before[first_q + row], q[first_q + row])
                v[first_v + row] = ca.if_else(rest, 0, v[first_v + row])


def _stands(frictions: list[Stick], rows: list[int]) -> SX:
    """Return 1 if frictions stick along as many independent directions as there are rows of joints, else 0."""
    directions = [friction.turning[rows] for friction in frictions]
    units = [
        ca.if_else(friction.sticks, direction / ca.norm_2(direction), 0)
        for friction, direction in zip(frictions, directions, strict=True)
    ]
    return ca.det(sum((unit.T @ unit for unit in units), SX(len(rows), len(rows)))) > INDEPENDENT
