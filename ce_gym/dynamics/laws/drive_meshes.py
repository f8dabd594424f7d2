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

from dataclasses import dataclass, field

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, solve_positive_definite
from ce_gym.dynamics.drives.stretch import gap_of, mesh_energy, mesh_figures, stretching
from ce_gym.dynamics.forces.linear import JointForce, Motion, is_moment
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.parameters import Parameter
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.model.description import ContactMaterial, Robot
from ce_gym.model.drives import Elasticity
from ce_gym.model.mechanism import Mechanism

MESH_ITERATIONS = 5
"""How many iterations of a step meshes may ask for after the first until which of their sides act is settled."""


def ONE(robot: Robot, material: ContactMaterial) -> list[float]:
    """Return the factor that changes nothing."""
    return [1.0]


class DriveMeshes(ForceLaw):
    """The elastic transmissions of a robot."""

    parameters = (
        Parameter("drive_stiffness", "factor on the stiffness of elastic transmissions", "-", "1", ONE, "positive"),
        Parameter("drive_damping", "factor on the damping of elastic transmissions", "-", "1", ONE),
        Parameter("backlash", "factor on the backlash of elastic transmissions", "-", "1", ONE),
    )

    def declare(self) -> None:
        """Iterate over an acceleration for each mesh with two sides; the last entry is 1 once there is an iterate."""
        elastic = stretching(self.mechanism)
        two_sided = sum(not one.linear for _, one in elastic)
        self.acts = bool(elastic)
        self.size, self.iterations = two_sided + (two_sided > 0), MESH_ITERATIONS if two_sided else 0

    def place(self, start: Start) -> Meshes:
        """Return the meshes at the start of a step."""
        return Meshes(start)

    def energy(self, start: Start) -> SX:
        """Return the elastic energy of all transmissions [J]."""
        return mesh_energy(start.scene, start.y)


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
class Meshes(PlacedForce):
    """The elastic transmissions of a robot at the start of a step."""

    start: Start

    def linearise(self, iterate: SX) -> MeshForces:
        """Linearise about an iterate, shape (size,)."""
        start, dt = self.start, self.start.dt
        n, y, yd = start.y.numel(), start.y, start.yd
        force, meshes = JointForce(SX(n, 1), SX(n, n)), []
        for row, elastic in stretching(start.scene.mechanism):
            k, d, backlash = mesh_figures(start.scene, elastic)
            pull, slope = k * y[row] + (dt * k + d) * yd[row], dt * (dt * k + d)
            if elastic.linear:
                force.tau[row], force.slope[row, row] = -pull, slope
                continue
            high, low = self._kinks(y[row], pull, k, d, gap_of(elastic, k, backlash))
            expected = pull + slope * iterate[len(meshes)]
            known = expected > high, expected < low, self._harmless(elastic), not elastic.backlash
            mesh = Mesh(row, pull, slope, high, low, *known)
            force.tau[row], force.slope[row, row] = mesh.force
            meshes.append(mesh)
        return MeshForces(start, force, meshes, iterate)

    def _kinks(self, x: SX, pull: SX, k: SX, d: SX, gap: SX) -> tuple[SX, SX]:
        """Return `Mesh.high` and `Mesh.low`."""
        if is_moment(self.start.dt):  # a side that is not pressed does nothing, however fast
            return ca.if_else(x > gap, k * gap, pull), ca.if_else(x < -gap, -k * gap, pull)
        return k * gap + d / self.start.dt * ca.fmax(gap - x, 0), d / self.start.dt * ca.fmin(-gap - x, 0) - k * gap

    def _harmless(self, elastic: Elasticity) -> float:
        """Return what the motor of a transmission can do at most [N m]; 0 if that is not known."""
        most = [motor.torque for motor in self.start.scene.mechanism.robot.motors if motor.rotor == elastic.rotor]
        return next((torque for torque in most if torque < float("inf")), 0.0)


@dataclass
class MeshForces(LinearForce):
    """The torques of all meshes, linear in the accelerations.

    Attributes:
        start: The robot at the start of the step.
        force: On the joints and stretches.
        meshes: Those with two sides.
        iterate: Of the iteration before.
        others: The sum of all other forces on the joints and stretches.
    """

    start: Start
    force: JointForce
    meshes: list[Mesh]
    iterate: SX
    others: JointForce = field(init=False)

    def add_to(self, loads: Loads) -> None:
        """Add the torques to the joints and stretches; meshes are the last law."""
        self.others = loads.joints
        loads.joints = loads.joints + self.force

    def check(self, motion: Motion) -> SX:
        """Return 1 if a side acts that was assumed not to, or the reverse; else 0."""
        changed = SX(0)
        for mesh in self.meshes:
            changed = ca.logic_or(changed, mesh.wrong(motion, self.iterate[-1]))
        return changed

    def next_iterate(self, motion: Motion, unconverged: SX) -> SX:
        """Return the accelerations of stretches to expect, and 1."""
        found = motion.articulation
        if not self.meshes or found is None:
            return self.iterate
        mechanism, kinematics = self.start.scene.mechanism, self.start.kinematics
        resistances = stretch_resistances(mechanism, kinematics, found.D, found.inertia, self.others.slope)
        expected = [mesh.let_go(motion, resistances[mesh.row]) for mesh in self.meshes]
        return ca.if_else(unconverged, ca.vertcat(*expected, 1), self.iterate)


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
