"""Base velocity after a step from the momentum of the robot, and the energy of free flight.

An Euler step integrates the velocity of the base with the Coriolis forces at the start of the step. Its angular
momentum is wrong by a term of first order, and so is the energy: a body that tumbles gains both. Therefore a step takes
from the recursion only the accelerations of the joints and the contact forces. Momentum is integrated exactly,

    P+ = P + dt (sum f + m g),    L+ = L + dt sum (x - c) x f        (L about the centre of mass c, forces f at x),

and the velocity of the base follows from the momentum and the composite inertia at the end of the step. In flight the
momentum is constant to rounding; contacts change it by exactly their impulses.

With given momentum, the kinetic energy about the centre of mass is a quadratic form in the velocities of the joints,

    T = L^T I^-1 L / 2 + B(yd),    B(yd) = energy of the joints' motion with zero momentum.

While nothing touches the robot, only the forces of the joints do work about the centre of mass, and this work is known:
`dt tau^T (yd + yd+) / 2`. The velocities of the joints are scaled so that the energy after the step is the energy
before the step plus this work. The factor differs from 1 by an error of the step. On a fixed base the potential energy
takes part as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import (
    SX,
    cross,
    quaternion_product,
    quaternion_to_rotation,
    solve_positive_definite,
)
from ce_gym.dynamics.integrators.plan import Ends, Plan
from ce_gym.dynamics.recursion.ce_aba import gravity_acceleration
from ce_gym.dynamics.recursion.kinematics import BodyState, Kinematics, outward_velocity_pass
from ce_gym.dynamics.recursion.momentum import Composite, composite_of, momentum_of, potential_energy
from ce_gym.model.mechanism import Mechanism

LARGEST_SCALING = 0.5
"""Largest relative change of the velocities of joints in a step to keep the energy."""
SMALL_SHARE = 1e-3
"""Share of the energy below which the motion of the joints is not scaled by the full error of the energy."""
TINY = 1e-12
"""Keeps a quotient finite [J]."""


@dataclass
class Balance:
    """Momentum of a robot at the end of a step, and its energy if nothing touches it.

    Attributes:
        angular: Angular momentum about the centre of mass, world axes [kg m^2/s], shape (3,); (0,) on a fixed base.
        linear: Linear momentum, world axes [kg m/s], shape (3,); (0,) on a fixed base.
        center: Centre of mass at the start of the step, world axes [m], shape (3,); (0,) on a fixed base.
        energy: Kinetic energy about the centre of mass; on a fixed base the kinetic and potential energy [J].
        touching: 1 if a contact acts, so that the energy is not known; else 0.
    """

    angular: SX
    linear: SX
    center: SX
    energy: SX
    touching: SX

    @staticmethod
    def of(mechanism: Mechanism, kinematics: Kinematics) -> Balance:
        """Return what a robot has in a state."""
        momentum = momentum_of(mechanism, kinematics)
        if not mechanism.robot.floating:
            energy = momentum.energy + potential_energy(mechanism, kinematics)
            none = SX(0, 1)
            return Balance(none, none, none, energy, SX(0))
        composite, base = composite_of(mechanism, kinematics), base_of(mechanism, kinematics)
        energy = momentum.energy - ca.sumsqr(momentum.linear) / (2 * composite.mass)
        angular, center = momentum.about(composite.center), base.point_position(composite.center)
        return Balance(base.R @ angular, base.R @ momentum.linear, center, energy, SX(0))

    def pushed(
        self, mechanism: Mechanism, kinematics: Kinematics, wrenches: Sequence[tuple[str, SX]], duration: SX | float
    ) -> Balance:
        """Return the balance after wrenches on bodies and gravity have acted.

        Args:
            mechanism: The robot.
            kinematics: Where the wrenches act.
            wrenches: Body and wrench on it [N m; N], world axes, about its origin, shape (6,).
            duration: Of the wrenches [s].
        """
        if not mechanism.robot.floating:
            return self
        force, torque = mass_of(mechanism) * gravity_acceleration(mechanism), SX(3, 1)
        for name, wrench in wrenches:
            arm = kinematics.bodies[name].p - self.center
            force, torque = force + wrench[3:], torque + wrench[:3] + cross(arm, wrench[3:])
        return replace(self, angular=self.angular + duration * torque, linear=self.linear + duration * force)

    @property
    def column(self) -> SX:
        """The numbers stacked, shape (`balance_size`,)."""
        return ca.vertcat(self.angular, self.linear, self.center, self.energy, self.touching)

    @staticmethod
    def from_column(column: SX) -> Balance:
        """Unpack a column."""
        n = (column.numel() - 2) // 3
        return Balance(*ca.vertsplit(column, [0, n, 2 * n, 3 * n, 3 * n + 1, 3 * n + 2]))


def combined_balance(plan: Plan, balances: Mapping[str, Balance | None]) -> Balance:
    """Return the weighted sum of the momenta of stages, for a plan whose `end` is `Ends`; energy is not kept."""
    assert isinstance(plan.end, Ends)
    columns = {name: balance.column for name, balance in balances.items() if balance is not None}
    column = sum((weight * columns[name] for name, weight in plan.end.weights.items()), SX(0))
    return replace(Balance.from_column(column), touching=SX(1))


def balance_size(mechanism: Mechanism) -> int:
    """Return the size of the column of a balance."""
    return 11 if mechanism.robot.floating else 2


def base_of(mechanism: Mechanism, kinematics: Kinematics) -> BodyState:
    """Return the state of the floating base."""
    return kinematics.bodies[next(iter(mechanism.bodies))]


def mass_of(mechanism: Mechanism) -> SX:
    """Return the mass of all moving bodies [kg]."""
    return sum((body.inertia[3, 3] for body in mechanism.bodies.values()), SX(0))


def conserving_velocity(mechanism: Mechanism, q: SX, v: SX, guess: SX, balance: Balance) -> tuple[SX, SX, Balance]:
    """Return positions and velocities with a given momentum and, in flight, a given energy; and their own balance.

    Args:
        mechanism: The robot.
        q: Positions, shape (nq,). Only the orientation of a robot without joints changes, to have the energy.
        v: Velocities, shape (nv,): base velocities are ignored, joint velocities are scaled to have the energy.
        guess: Dependent coordinates, see `outward_velocity_pass`.
        balance: Momentum and energy.
    """
    n = mechanism.robot.layout.base_nv
    kinematics = outward_velocity_pass(mechanism, q, ca.vertcat(SX(n, 1), v[n:]), guess)
    motion = momentum_of(mechanism, kinematics)  # of the joints, with the base at rest
    if not mechanism.robot.floating:
        potential = potential_energy(mechanism, kinematics)
        scale = _scaling(balance.energy - potential, motion.energy, balance.touching)
        return q, scale * v, replace(balance, energy=scale**2 * motion.energy + potential, touching=SX(0))
    composite, base = composite_of(mechanism, kinematics), base_of(mechanism, kinematics)
    linear, angular = base.R.T @ balance.linear, base.R.T @ balance.angular
    if v.numel() == n:
        return _turned_body(q, composite, angular, balance)
    joints = motion.about(composite.center)
    turning = solve_positive_definite(composite.inertia_about_center, ca.horzcat(angular, joints))
    frozen = ca.dot(angular, turning[:, 0]) / 2
    energy = motion.energy - ca.sumsqr(motion.linear) / (2 * composite.mass) - ca.dot(joints, turning[:, 1]) / 2
    scale = _scaling(balance.energy - frozen, energy, balance.touching, frozen)
    w = turning[:, 0] - scale * turning[:, 1]
    u = (linear - scale * motion.linear) / composite.mass - cross(w, composite.center)
    after = replace(balance, center=base.point_position(composite.center), touching=SX(0))
    return q, ca.vertcat(w, u, scale * v[n:]), replace(after, energy=frozen + scale**2 * energy)


def _turned_body(q: SX, composite: Composite, angular: SX, balance: Balance) -> tuple[SX, SX, Balance]:
    """Return what `conserving_velocity` returns, for one rigid body.

    The energy of a body depends on the direction of its angular momentum M in its axes. The directions
    tried are `M + t d`, scaled to the length of M, where d is the part of the angular velocity across M. The energy
    `M^T I^-1 M / 2` then gives a quadratic equation in t. The body is turned by the smallest rotation between the two
    directions.

    Args:
        q: Position and orientation, shape (7,).
        composite: The body.
        angular: Angular momentum about the centre of mass, body axes [kg m^2/s], shape (3,).
        balance: Momentum and energy.
    """
    inertia, square = composite.inertia_about_center, ca.sumsqr(angular) + TINY
    w = solve_positive_definite(inertia, angular)
    across = w - angular * (ca.dot(w, angular) / square)
    bent = solve_positive_definite(inertia, across)
    excess, slope = ca.dot(angular, w) - 2 * balance.energy, ca.dot(across, w)
    curvature = ca.dot(across, bent) - 2 * balance.energy * ca.sumsqr(across) / square
    t = -excess / (slope + ca.sqrt(ca.fmax(slope**2 - curvature * excess, 0)) + TINY)
    t = ca.if_else(balance.touching, 0, t)
    direction = angular + t * across
    direction = direction * ca.sqrt(square / (ca.sumsqr(direction) + TINY))
    turn = ca.vertcat(square + ca.dot(direction, angular), cross(direction, angular))
    orientation = quaternion_product(q[3:7], turn)
    q = ca.vertcat(q[:3], orientation / ca.norm_2(orientation))
    w = solve_positive_definite(inertia, direction)
    R = quaternion_to_rotation(q[3:7])
    u = R.T @ balance.linear / composite.mass - cross(w, composite.center)
    center, energy = q[:3] + R @ composite.center, ca.dot(direction, w) / 2
    return q, ca.vertcat(w, u), replace(balance, center=center, energy=energy, touching=SX(0))


def _scaling(kept: SX, energy: SX, touching: SX, other: SX | float = 0.0) -> SX:
    """Return the factor on the velocities of joints that gives their motion the energy that is kept [J].

    Args:
        kept: Energy that the motion of the joints should have.
        energy: Energy that it has.
        touching: Whether a contact acts; then the factor is 1.
        other: Energy that does not depend on this motion.
    """
    lowest, highest = (1 - LARGEST_SCALING) ** 2, (1 + LARGEST_SCALING) ** 2
    square = 1 + (kept - energy) / (energy + SMALL_SHARE * other + TINY)
    scale = ca.sqrt(ca.fmin(ca.fmax(square, lowest), highest))
    return ca.if_else(touching, 1, scale)
