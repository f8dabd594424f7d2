"""Dry friction of the joints; `forces/dry_friction.py` has the equations."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.dry_friction import STICK_ITERATIONS, JointFriction, friction_count
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.forces.saturation import SaturatedForce
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start


class DryJointFriction(ForceLaw):
    """Dry friction of all joints, dependent ones included."""

    @property
    def acts(self) -> bool:
        """Whether a joint has dry friction."""
        return self.size > 0

    @property
    def size(self) -> int:
        """Size of the iterate: the torques, and the number of iterations so far."""
        return friction_count(self.mechanism, self.options.parameters)

    @property
    def iterations(self) -> int:
        """How many iterations joints may need until it is settled which of them stick."""
        return STICK_ITERATIONS

    def place(self, start: Start) -> PlacedFriction:
        """Return the friction at the start of a step."""
        return PlacedFriction(JointFriction(start.scene.mechanism, start.kinematics, start.yd, start.dt))


@dataclass
class PlacedFriction(PlacedForce):
    """The friction at the start of a step."""

    friction: JointFriction

    def linearise(self, iterate: SX) -> FrictionForces:
        """Linearise about an iterate."""
        return FrictionForces(self.friction.linearise(iterate), iterate)


@dataclass
class FrictionForces(LinearForce):
    """The friction of all joints, linear in the accelerations."""

    force: SaturatedForce
    iterate: SX

    def __post_init__(self) -> None:
        self.sticks = self.force.frictions

    def add_to(self, loads: Loads) -> None:
        """Add the friction to the joints."""
        loads.joints = loads.joints + self.force

    def check(self, motion: Motion) -> SX:
        """Return 1 if a joint sticks that was assumed to slip, or the reverse; else 0."""
        return self.force.check(motion)

    def next_iterate(self, motion: Motion, unconverged: SX) -> SX:
        """Return the torques to expect."""
        return ca.if_else(unconverged, self.force.next_iterate(motion), self.iterate)
