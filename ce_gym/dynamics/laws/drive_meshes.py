"""Torque of a transmission that stretches, implicit in the step: two flanks of a gear, or two strands of a belt.

Let x be the stretch: how far the rotor is ahead of the angle that follows from the joints. A mesh is two one-sided
springs with dampers,

    torque = push(x) - push(-x),    push(x) = max(0, k z + d zd),    z = max(0, x - gap) the compression of a side.

A backlash of b is a gap of b / 2 on both sides. A belt with the preload p is two strands of half the stiffness and
damping with a gap of -p / k, which overlap: together they have the whole stiffness until one of them is slack. A
transmission without backlash and preload has no sides and is one spring and damper.

One step ahead the compression is z+ = max(0, x + dt xd+ - gap), at the rate (z+ - z) / dt. The force

    push+ = max(0, k (x - gap) + (dt k + d) xd+ - d max(0, gap - x) / dt) = max(0, pull - high),

with the force `pull` of a spring without sides, rises with xd+ and has one kink, at which the side begins to act: an
active set. The implicit step never adds energy: the energy of the spring is convex, the damper dissipates
d (z+ - z)^2 / dt, and a side that opens early loses its energy.

The expected acceleration of a stretch decides which sides act. It is zero in the first iteration. After that it is the
acceleration of the last iteration, without the mesh, while only the stretch's own cluster responds. If it is beyond the
kink of a side, the side acts. For a single drive this is exact, for others nearly. From the second iteration on, an
error counts only if it exceeds the torque of the motor: a smaller one changes a step by less than its own error
(docs/explanation/numerics.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, solve_positive_definite
from ce_gym.dynamics.forces.linear import JointForce, Motion, is_moment
from ce_gym.dynamics.forces.scene import Scene
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.parameters import Parameter, unit_factor
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.model.drives import Elasticity
from ce_gym.model.mechanism import Mechanism

MESH_ITERATIONS = 5
"""How many iterations of a step meshes may need after the first until it is settled which of their sides act."""


def stretching(mechanism: Mechanism) -> list[tuple[int, Elasticity]]:
    """Return the elastic transmissions that stretch, each with the row of its stretch among the joints' coordinates."""
    robot = mechanism.robot
    rows = {name: row for row, name in enumerate(robot.independent)}
    return [(rows[elastic.stretch], elastic) for elastic in robot.elastic if elastic.stretch in rows]


def mesh_parameters(scene: Scene, elastic: Elasticity) -> tuple[SX, SX, SX]:
    """Return stiffness [N m/rad] and damping [N m s/rad] of a side, and backlash [rad].

    A transmission without sides has one spring and damper. A strand has half the stiffness and damping of its belt.
    """
    values, share = scene.values, 1.0 if elastic.linear or elastic.backlash else 0.5
    k, d = share * elastic.stiffness * values["drive_stiffness"], share * elastic.damping * values["drive_damping"]
    return k, d, elastic.backlash * elastic.play * values["backlash"]


def gap_of(elastic: Elasticity, k: SX, backlash: SX) -> SX:
    """Return the stretch at which a side with stiffness k begins to push [rad]."""
    return backlash / 2 if elastic.backlash else -elastic.preload / (2 * k)


def mesh_energy(scene: Scene, y: SX) -> SX:
    """Return the elastic energy of all transmissions at positions of joints and stretches (n,) [J]."""
    total = SX(0)
    for row, elastic in stretching(scene.mechanism):
        k, _, backlash = mesh_parameters(scene, elastic)
        if elastic.linear:
            total += k * y[row] ** 2 / 2
            continue
        gap = gap_of(elastic, k, backlash)
        total += k * (ca.fmax(y[row] - gap, 0) ** 2 + ca.fmax(-y[row] - gap, 0) ** 2) / 2
    return total


class DriveMeshes(ForceLaw):
    """The elastic transmissions of a robot."""

    parameters = (
        Parameter(
            "drive_stiffness", "factor on the stiffness of elastic transmissions", "-", "1", unit_factor, "positive"
        ),
        Parameter("drive_damping", "factor on the damping of elastic transmissions", "-", "1", unit_factor),
        Parameter("backlash", "factor on the backlash of elastic transmissions", "-", "1", unit_factor),
    )

    def declare(self) -> None:
        """Iterate over an acceleration for each mesh with two sides; the last entry is 1 once there is an iterate."""
        elastic = stretching(self.mechanism)
        two_sided = sum(not drive.linear for _, drive in elastic)
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
        pull: Torque of a spring and damper without sides at zero acceleration [N m].
        slope: By how much `pull` grows for a unit acceleration of the stretch [kg m^2].
        high, low: The side ahead gives `pull - high` where `pull` is above `high`; the side behind gives `pull - low`
            where `pull` is below `low` [N m].
        ahead, behind: Whether the sides are assumed to act.
        harmless: Error of a side's torque that is accepted after the first iteration [N m].
        overlaps: Whether both sides can act at the same time.
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
        """Torque on the stretch at zero acceleration [N m], and by how much it falls with the acceleration [kg m^2]."""
        tau = -ca.if_else(self.ahead, self.pull - self.high, 0) - ca.if_else(self.behind, self.pull - self.low, 0)
        if self.overlaps:
            return tau, ca.if_else(self.ahead, self.slope, 0) + ca.if_else(self.behind, self.slope, 0)
        return tau, ca.if_else(ca.logic_or(self.ahead, self.behind), self.slope, 0)

    def beyond(self, motion: Motion) -> tuple[SX, SX]:
        """Return the torques of both sides at the end of the step, negative where a side does not act [N m]."""
        after = self.pull + self.slope * motion.ydd[self.row]
        return after - self.high, self.low - after

    def wrong(self, motion: Motion, again: SX) -> SX:
        """Return 1 if the assumption about a side is wrong by more than the accepted error, else 0."""
        (over, under), accepted = self.beyond(motion), ca.if_else(again > 0, self.harmless, 0)
        ahead_is_wrong = ca.if_else(self.ahead, -over, over) > accepted
        return ca.logic_or(ahead_is_wrong, ca.if_else(self.behind, -under, under) > accepted)

    def free_acceleration(self, motion: Motion, resistance: SX) -> SX:
        """Return the acceleration of the stretch without the mesh; where sides overlap, with it."""
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
            k, d, backlash = mesh_parameters(start.scene, elastic)
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
        if is_moment(self.start.dt):  # a side that is not compressed gives no force at any speed
            return ca.if_else(x > gap, k * gap, pull), ca.if_else(x < -gap, -k * gap, pull)
        return k * gap + d / self.start.dt * ca.fmax(gap - x, 0), d / self.start.dt * ca.fmin(-gap - x, 0) - k * gap

    def _harmless(self, elastic: Elasticity) -> float:
        """Return the largest torque of the motor of a transmission [N m]; 0 if it is unknown."""
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
        articulation = motion.articulation
        if not self.meshes or articulation is None:
            return self.iterate
        mechanism, kinematics = self.start.scene.mechanism, self.start.kinematics
        inertias = articulation.D, articulation.inertia
        resistances = stretch_resistances(mechanism, kinematics, *inertias, self.others.slope)
        expected = [mesh.free_acceleration(motion, resistances[mesh.row]) for mesh in self.meshes]
        return ca.if_else(unconverged, ca.vertcat(*expected, 1), self.iterate)


def stretch_resistances(
    mechanism: Mechanism, kinematics: Kinematics, whole: dict[int, SX], bare: dict[int, SX], slope: SX
) -> dict[int, SX]:
    """Return the inertia of stretches with sides without their mesh, while only their own clusters respond.

    Args:
        mechanism: The robot.
        kinematics: At the start of the step.
        whole: Inertias of clusters with the slopes of all forces on their coordinates, shape (d, d) each.
        bare: Inertias of clusters without these slopes, shape (d, d) each.
        slope: Slopes of all forces on coordinates except meshes, shape (n, n) [kg m^2].

    Returns:
        Inertias, by the stretch's row among the joints' coordinates [kg m^2].
    """
    base = mechanism.robot.layout.base_nv
    with_sides, resistances = {row for row, elastic in stretching(mechanism) if not elastic.linear}, {}
    for k, D in whole.items():
        for i, row in enumerate(row - base for row in kinematics.rows[k]):
            if row in with_sides:  # subtracting the slope of a stiff mesh would lose digits
                others = [j for j in range(D.shape[0]) if j != i]
                alone = bare[k][i, i] + slope[row, row]
                resistances[row] = alone - D[i, others] @ solve_positive_definite(D[others, others], D[others, i])
    return resistances
