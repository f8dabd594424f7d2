"""Torque of a transmission that stretches, implicit in the step: two flanks of a gear, or two strands of a belt.

With x the stretch, how far the rotor is ahead of where the joints would have it, a mesh is two one-sided springs,

    torque = push(x) - push(-x),    push(x) = max(0, k z + d zd),  z = max(0, x - gap)  what the side is pressed in by

A backlash of b is a gap of b / 2 on both sides. A belt with the preload p is two strands of half the stiffness and
damping with a gap of -p / k, which overlap: together they have the whole stiffness until one of them is slack. What
pulls and pushes alike has no sides and is one spring and damper.

One step ahead the side is pressed in by z+ = max(0, x + dt xd+ - gap), at the rate (z+ - z) / dt, so that

    push+ = max(0, k (x - gap) + (dt k + d) xd+ - d max(0, gap - x) / dt) = max(0, pull - high)

with `pull` what a spring without sides would do, is a rising function of xd+ with one kink, at which it acts or not: an
active set. Its implicit step never gives energy: the spring's is convex, the damper's work is d (z+ - z)^2 / dt, and a
side that lets go early loses what it had.

Which sides act is said by the acceleration that a stretch is expected to have, at first none, then that which the
iteration before says it would have if the mesh let go of it and all but its own cluster moved on as it does. Is that
beyond the kink of a side, the side acts, which is right for a drive on its own and nearly so for others. What is still
wrong in the second iteration counts only if it is more than the motor could do: less changes a step by less than its
own error, and takes energy, or gives what the next step takes (docs/explanation/numerics.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, solve_positive_definite
from ce_gym.dynamics.drives.stretch import gap_of, mesh_figures, stretching
from ce_gym.dynamics.forces.linear import JointForce, Motion, is_moment
from ce_gym.dynamics.forces.scene import Scene
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.model.drives import Elasticity
from ce_gym.model.mechanism import Mechanism

MESH_ITERATIONS = 5
"""How many iterations of a step meshes may ask for after the first until which of their sides act is settled."""


def mesh_count(mechanism: Mechanism) -> int:
    """Return the size of the iterate of all meshes with sides: an acceleration each, and 1 once there is an iterate."""
    count = sum(not elastic.linear for _, elastic in stretching(mechanism))
    return count + 1 if count else 0


@dataclass
class Mesh:
    """A mesh with sides over one step.

    Attributes:
        row: Of the stretch among the joints' coordinates.
        pull: What a spring and damper without sides would do at zero acceleration [N m].
        slope: By how much that grows for a unit acceleration of the stretch [kg m^2].
        high, low: The side ahead acts where that is above the first, with as much as it is above it; the other one
            where it is below the second [N m].
        ahead, behind: Whether they are taken to act.
        harmless: By how much a side may be wrong after the first iteration [N m].
        overlaps: Whether both can act.
    """

    row: int
    pull: SX
    slope: SX
    high: SX
    low: SX
    ahead: SX
    behind: SX
    harmless: float
    overlaps: bool

    @property
    def force(self) -> tuple[SX, SX]:
        """What it does to the joints' rotor at zero acceleration [N m], and by how much that falls [kg m^2]."""
        tau = -ca.if_else(self.ahead, self.pull - self.high, 0) - ca.if_else(self.behind, self.pull - self.low, 0)
        if self.overlaps:
            return tau, ca.if_else(self.ahead, self.slope, 0) + ca.if_else(self.behind, self.slope, 0)
        return tau, ca.if_else(ca.logic_or(self.ahead, self.behind), self.slope, 0)

    def beyond(self, motion: Motion) -> tuple[SX, SX]:
        """Return by how much a step ends beyond where the side ahead acts, and short of the other's [N m]."""
        after = self.pull + self.slope * motion.ydd[self.row]
        return after - self.high, self.low - after

    def wrong(self, motion: Motion, again: SX) -> SX:
        """Return 1 if a side acts that should not or the other way round, and it matters; else 0."""
        (over, under), most = self.beyond(motion), ca.if_else(again > 0, self.harmless, 0)
        one = ca.if_else(self.ahead, -over, over) > most
        return ca.logic_or(one, ca.if_else(self.behind, -under, under) > most)

    def let_go(self, motion: Motion, resistance: SX) -> SX:
        """Return the acceleration that the stretch would have without the mesh, or as it is where sides overlap."""
        ydd, (over, under) = motion.ydd[self.row], self.beyond(motion)
        pushes = ca.if_else(self.ahead, over, 0) - ca.if_else(self.behind, under, 0)
        return ydd if self.overlaps else ydd + pushes / resistance


@dataclass
class MeshForce(JointForce):
    """What all meshes do over one step, some of their sides acting: a `LinearForce`.

    Attributes:
        meshes: Those with sides.
        again: 1 if there was an iteration before.
    """

    meshes: list[Mesh]
    again: SX

    def check(self, motion: Motion) -> SX:
        """Return 1 if a side acts that should not or the other way round; else 0."""
        changed = SX(0)
        for mesh in self.meshes:
            changed = ca.logic_or(changed, mesh.wrong(motion, self.again))
        return changed

    def next_iterate(self, motion: Motion, resistances: dict[int, SX]) -> SX:
        """Return what accelerations of stretches to expect, and 1; resistances as of `stretch_resistances`."""
        if not self.meshes:
            return SX(0, 1)
        return ca.vertcat(*[mesh.let_go(motion, resistances[mesh.row]) for mesh in self.meshes], 1)


@dataclass
class Meshes:
    """What the elastic transmissions of a robot do over one step: a `ForceLaw`.

    Attributes:
        scene: The robot and what surrounds it.
        y: Positions of joints and stretches [rad or m], shape (n,).
        yd: Their velocities, shape (n,).
        dt: Length of the step [s].
    """

    scene: Scene
    y: SX
    yd: SX
    dt: float

    @property
    def size(self) -> int:
        """How many numbers its iterate has."""
        return mesh_count(self.scene.mechanism)

    def linearise(self, iterate: SX) -> MeshForce:
        """Linearise about an iterate, shape (size,)."""
        n, dt = self.y.numel(), self.dt
        force = MeshForce(SX(n, 1), SX(n, n), [], iterate[-1] if iterate.numel() else SX(0))
        for row, elastic in stretching(self.scene.mechanism):
            k, d, backlash = mesh_figures(self.scene, elastic)
            pull, slope = k * self.y[row] + (dt * k + d) * self.yd[row], dt * (dt * k + d)
            if elastic.linear:
                force.tau[row], force.slope[row, row] = -pull, slope
                continue
            high, low = self._kinks(self.y[row], pull, k, d, gap_of(elastic, k, backlash))
            expected = pull + slope * iterate[len(force.meshes)]
            known = expected > high, expected < low, self._harmless(elastic), not elastic.backlash
            mesh = Mesh(row, pull, slope, high, low, *known)
            force.tau[row], force.slope[row, row] = mesh.force
            force.meshes.append(mesh)
        return force

    def _kinks(self, x: SX, pull: SX, k: SX, d: SX, gap: SX) -> tuple[SX, SX]:
        """Return `Mesh.high` and `Mesh.low`."""
        if is_moment(self.dt):  # a side that is not pressed does nothing, however fast
            return ca.if_else(x > gap, k * gap, pull), ca.if_else(x < -gap, -k * gap, pull)
        return k * gap + d / self.dt * ca.fmax(gap - x, 0), d / self.dt * ca.fmin(-gap - x, 0) - k * gap

    def _harmless(self, elastic: Elasticity) -> float:
        """Return what the motor of a transmission can do at most [N m]; 0 if that is not known."""
        most = [motor.torque for motor in self.scene.mechanism.robot.motors if motor.rotor == elastic.rotor]
        return next((torque for torque in most if torque < float("inf")), 0.0)


def stretch_resistances(
    mechanism: Mechanism, kinematics: Kinematics, whole: dict[int, SX], bare: dict[int, SX], slope: SX
) -> dict[int, SX]:
    """Return the inertia that stretches with sides have if nothing but their own clusters answers, without the mesh.

    Args:
        mechanism: The robot.
        kinematics: At the start of the step.
        whole: Inertias of clusters with all that acts on their coordinates, shape (d, d) each.
        bare: The same without what acts on them.
        slope: What acts on coordinates but for meshes, shape (n, n) [kg m^2].

    Returns:
        Inertias, by the stretch's row among the joints' coordinates [kg m^2].
    """
    base = mechanism.robot.layout.base_nv
    with_sides, found = {row for row, elastic in stretching(mechanism) if not elastic.linear}, {}
    for k, D in whole.items():
        for i, row in enumerate(row - base for row in kinematics.rows[k]):
            if row in with_sides:  # what a stiff mesh adds is not taken away again, for rounding
                own, others = bare[k][i, i] + slope[row, row], [j for j in range(D.shape[0]) if j != i]
                found[row] = own - D[i, others] @ solve_positive_definite(D[others, others], D[others, i])
    return found
