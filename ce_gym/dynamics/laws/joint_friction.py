"""Dry friction of the joints: it sticks or slips; `forces/dry_friction.py` has the torque of one joint."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.dry_friction import dry_friction, has_dry_friction
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.forces.saturation import SaturatedForce, Stick
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.parameters import with_declared_friction
from ce_gym.model.mechanism import Mechanism

STICK_ITERATIONS = 8
"""How many iterations of a step joints may need after the first until it is settled which of them stick.

If it is not settled by then, as in one step of a thousand of long chains, each has the expected torque, up to its own.
"""
TINY = 1e-18
"""Added to the square of a joint's motion for unit motion of independent joints; a fixed joint has none."""


class DryJointFriction(ForceLaw):
    """Dry friction of all joints, dependent ones included."""

    def declare(self) -> None:
        """Iterate over the torques; the last entry counts the iterations."""
        rubbing = rubbing_clusters(with_declared_friction(self.mechanism, self.options.parameters))
        self.acts = bool(rubbing)
        self.size, self.iterations = sum(cluster.count for cluster in rubbing) + 1, STICK_ITERATIONS

    def place(self, start: Start) -> JointFriction:
        """Return the friction at the start of a step."""
        return JointFriction(start)


@dataclass
class Rubbing:
    """A cluster with dry friction.

    Attributes:
        index: Of the cluster.
        rows: Rows of `y` that belong to the cluster, d rows.
        friction: Of its joints, by the name of the body that each moves [N m or N].
    """

    index: int
    rows: list[int]
    friction: dict[str, float]

    @property
    def declared(self) -> bool:
        """Whether a friction is a parameter, which may be 0."""
        return any(isinstance(friction, SX) for friction in self.friction.values())

    @property
    def count(self) -> int:
        """How many torques its friction has."""
        return 1 if len(self.rows) == 1 else len(self.friction)


def rubbing_clusters(mechanism: Mechanism) -> list[Rubbing]:
    """Return the clusters with dry friction."""
    robot, clusters = mechanism.robot, []
    for k, cluster in enumerate(mechanism.tree.clusters):
        joints = {name: robot.body(name).joint for name in cluster.bodies}
        friction = {
            n: joint.friction
            for n, joint in joints.items()
            if joint.type != "free" and has_dry_friction(joint.friction)
        }
        if friction:
            clusters.append(Rubbing(k, [robot.independent.index(name) for name in cluster.independent], friction))
    return clusters


@dataclass
class JointFriction(PlacedForce):
    """The dry friction of all joints at the start of a step."""

    start: Start

    def linearise(self, iterate: SX) -> FrictionForces:
        """Linearise about an iterate, shape (size,)."""
        start, n, last = self.start, self.start.yd.numel(), iterate[-1] > STICK_ITERATIONS - 0.5
        force = SaturatedForce(SX(n, 1), SX(n, n), iterate.numel(), count=iterate[-1] + 1)
        for cluster in rubbing_clusters(start.scene.mechanism):
            for friction, unit in self._torques(cluster).values():
                direction, place = SX(1, n), len(force.limited)
                direction[cluster.rows] = unit
                alone, speed = len(cluster.rows) == 1, direction @ start.yd
                limited, rests, damping = dry_friction(friction, speed, direction, start.dt, iterate, place, alone)
                force.limited[place] = limited
                acts = limited.free if not cluster.declared else ca.logic_and(limited.free, friction > 0)
                sticks = ca.logic_and(acts, ca.logic_not(last))
                settled = ca.fmax(-friction, ca.fmin(friction, limited.expected))
                force.tau += direction.T @ ca.if_else(last, settled, limited.given)
                force.slope += direction.T @ ca.if_else(sticks, start.dt * damping, 0) @ direction
                force.frictions.append(Stick(direction, sticks, rests))
        return FrictionForces(force, iterate)

    def _torques(self, cluster: Rubbing) -> dict[str, tuple[SX, SX]]:
        """Return the friction of a cluster and its direction, a unit vector of the independent joints, shape (1, d)."""
        coordinates = self.start.kinematics.coordinates[cluster.index]
        assert coordinates is not None
        rows = {name: ca.sparsify(coordinates.G[coordinates.index[name], :]) for name in cluster.friction}
        if len(cluster.rows) == 1:
            whole = sum((SX(friction) * ca.fabs(rows[name]) for name, friction in cluster.friction.items()), SX(0))
            return {self.start.scene.mechanism.robot.independent[cluster.rows[0]]: (whole, SX(1))}
        lengths = {name: ca.sqrt(ca.sumsqr(row) + TINY) for name, row in rows.items()}
        return {name: (lengths[name] * f, rows[name] / lengths[name]) for name, f in cluster.friction.items()}


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
