"""Dry friction of joints and rotors, linearly implicit in the step: it sticks or slips.

Which of the two it is follows from the state at the end of the step, see saturation.py, so that friction never takes
more than it has, however long the step. Dependent joints rub, too: with `W` its row of the constraint Jacobian, a joint
moves at `W yd`, and its friction is `W^T tau` to the independent joints of its cluster. All friction of a cluster with
one degree of freedom is one, `sum |W_i| f_i`.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.law import JointForce
from ce_gym.dynamics.forces.parameters import rubbing_as_declared
from ce_gym.dynamics.forces.saturation import SaturatedForce, Saturation
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.model.mechanism import Mechanism

STICK_SPEED = 1e-4
"""Speed at which dry friction that sticks carries its full torque [rad/s or m/s]."""
STICK_ITERATIONS = 8
"""How many iterations of a step joints may ask for after the first until which of them stick is settled.

If it is not by then, as in one step of a thousand of long chains, each has the torque that was expected, up to its own.
"""
TINY = 1e-18
"""Of the square of how far a joint moves for a unit of the independent ones; one that does not move rubs nothing."""


@dataclass
class Rubbing:
    """A cluster with dry friction.

    Attributes:
        index: Of the cluster.
        rows: Its rows of `y`, d of them.
        friction: Of its joints, by the name of the body that each moves [N m or N].
    """

    index: int
    rows: list[int]
    friction: dict[str, float]

    @property
    def declared(self) -> bool:
        """Whether some of it is a parameter, which may turn out to be 0: no friction holds nothing."""
        return any(isinstance(friction, SX) for friction in self.friction.values())

    @property
    def count(self) -> int:
        """How many torques its friction has."""
        return 1 if len(self.rows) == 1 else len(self.friction)


def rubbing_clusters(mechanism: Mechanism) -> list[Rubbing]:
    """Return the clusters with dry friction."""
    robot, found = mechanism.robot, []
    for k, cluster in enumerate(mechanism.tree.clusters):
        joints = {name: robot.body(name).joint for name in cluster.bodies}
        friction = {n: joint.friction for n, joint in joints.items() if joint.type != "free" and rubs(joint.friction)}
        if friction:
            found.append(Rubbing(k, [robot.independent.index(name) for name in cluster.independent], friction))
    return found


def rubs(friction: float | SX) -> bool:
    """Return whether something has dry friction: a number that is not 0, or a symbol that may not be."""
    return isinstance(friction, SX) or bool(friction)


def friction_count(mechanism: Mechanism, declared: tuple[str, ...] = ()) -> int:
    """Return the size of the iterate of the joints' dry friction: its torques, and 1 once there is an iterate.

    Args:
        mechanism: The robot.
        declared: Names of the scene's parameters, of which the joints' friction may be one.
    """
    mechanism = rubbing_as_declared(mechanism, declared)
    count = sum(rubbing.count for rubbing in rubbing_clusters(mechanism))
    return count + 1 if count else 0


@dataclass
class JointFriction:
    """What the dry friction of all joints does over one step: a `ForceLaw`.

    An independent joint that friction holds does not move at all: by its own, or by any in a cluster with one degree of
    freedom. Where friction of dependent joints holds several, they creep by less than `STICK_SPEED`.

    Attributes:
        mechanism: The robot.
        kinematics: Of it.
        yd: Velocities of the independent joints [rad/s or m/s], shape (nj,).
        dt: Length of the step [s].
    """

    mechanism: Mechanism
    kinematics: Kinematics
    yd: SX
    dt: float

    @property
    def size(self) -> int:
        """How many numbers its iterate has."""
        return friction_count(self.mechanism)

    def linearise(self, iterate: SX) -> SaturatedForce:
        """Linearise about an iterate, shape (size,)."""
        n, last = self.yd.numel(), iterate[-1] > STICK_ITERATIONS - 0.5
        force = SaturatedForce(SX(n, 1), SX(n, n), iterate.numel(), count=iterate[-1] + 1)
        for cluster in rubbing_clusters(self.mechanism):
            for name, (friction, own) in self._torques(cluster).items():
                way, place = SX(1, n), len(force.limited)
                way[cluster.rows] = own
                one = dry_friction(friction, way @ self.yd, way, self.dt, iterate, place)
                force.limited[place] = one
                acts = one.free if not cluster.declared else ca.logic_and(one.free, friction > 0)
                sticks = ca.logic_and(acts, ca.logic_not(last))
                force.tau += way.T @ ca.if_else(last, ca.fmax(-friction, ca.fmin(friction, one.expected)), one.given)
                force.slope += way.T @ ca.if_else(sticks, self.dt * friction / STICK_SPEED, 0) @ way
                if name in self.mechanism.robot.independent:
                    force.held[self.mechanism.robot.independent.index(name)] = sticks
        return force

    def _torques(self, cluster: Rubbing) -> dict[str, tuple[SX, SX]]:
        """Return what a cluster's friction has, along which unit vector of its independent joints, shape (1, d)."""
        coordinates = self.kinematics.coordinates[cluster.index]
        assert coordinates is not None
        ways = {name: ca.sparsify(coordinates.G[coordinates.index[name], :]) for name in cluster.friction}
        if len(cluster.rows) == 1:
            whole = sum((SX(friction) * ca.fabs(ways[name]) for name, friction in cluster.friction.items()), SX(0))
            return {self.mechanism.robot.independent[cluster.rows[0]]: (whole, SX(1))}
        lengths = {name: ca.sqrt(ca.sumsqr(way) + TINY) for name, way in ways.items()}
        return {name: (lengths[name] * f, ways[name] / lengths[name]) for name, f in cluster.friction.items()}


def dry_friction(friction: SX | float, speed: SX, turning: SX, dt: float, iterate: SX, place: int) -> Saturation:
    """Return the dry friction of a joint or a rotor: what would stop it, up to what friction has.

    It sticks by a damping so large that it is at rest at the end of the step but for `STICK_SPEED`; where that
    would take more than it has it slips, and is a constant torque against the motion at the end of the step.

    Args:
        friction: What it has [N m or N].
        speed: Of the joint or rotor [rad/s or m/s].
        turning: The same for unit velocities of all independent joints, shape (1, nj).
        dt: Length of the step [s].
        iterate: From the iteration before, shape (limit_count,).
        place: Of this torque in it.
    """
    sticking, still = friction / STICK_SPEED, SX(1, turning.numel())
    ends = JointForce(SX(friction), still), JointForce(SX(-friction), still)
    return Saturation.about(iterate, place, JointForce(-sticking * speed, dt * sticking * turning), *ends)
