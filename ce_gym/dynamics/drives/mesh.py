"""Torque of a transmission that stretches, implicit in the step: two flanks of a gear, or two strands of a belt.

With x the stretch, how far the rotor is ahead of where the joints would have it, a mesh is two one-sided springs,

    torque = push(x) - push(-x),    push(x) = max(0, k z + d zd),  z = max(0, x - gap)  what the side is pressed in by

A backlash of b is a gap of b / 2 on both sides. A belt with the preload p is two strands of half the stiffness and
damping with a gap of -p / k, which overlap: together they have the whole stiffness until one of them is slack. What
pulls and pushes alike has no sides and is one spring and damper.

One step ahead the side is pressed in by z+ = max(0, x + dt xd+ - gap), at the rate (z+ - z) / dt, so that

    push+ = max(0, k (x - gap) + (dt k + d) xd+ - d max(0, gap - x) / dt)

is a rising function of xd+ with one kink, at which it acts or not: an active set. Its implicit step never gives energy:
the spring's is convex, the damper's work is d (z+ - z)^2 / dt, and a side that lets go early loses what it had.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.law import JointForce, Motion, is_moment
from ce_gym.dynamics.forces.scene import Scene
from ce_gym.model.drives import Elasticity
from ce_gym.model.mechanism import Mechanism

MESH_ITERATIONS = 5
"""How many iterations of a step meshes may ask for after the first until which of their sides act is settled."""


def stretching(mechanism: Mechanism) -> list[tuple[int, Elasticity]]:
    """Return the elastic transmissions that stretch, each with the row of its stretch among the joints' coordinates."""
    robot = mechanism.robot
    rows = {name: row for row, name in enumerate(robot.independent)}
    return [(rows[elastic.stretch], elastic) for elastic in robot.elastic if elastic.stretch in rows]


def mesh_count(mechanism: Mechanism) -> int:
    """Return the size of the iterate of all meshes: what each side would push with, and 1 once there is an iterate."""
    count = sum(2 for _, elastic in stretching(mechanism) if not elastic.linear)
    return count + 1 if count else 0


@dataclass
class Side:
    """A side of a mesh: it pushes with what it would push with, or not at all if that is negative.

    Attributes:
        row: Of the stretch among the joints' coordinates.
        sign: 1 for the side that is pressed where the rotor is ahead, -1 for the other.
        push: What it would push with at zero acceleration [N m].
        slope: By how much that falls for a unit acceleration of its own [kg m^2].
        expected: What decides whether it acts [N m].
    """

    row: int
    sign: int
    push: SX
    slope: SX
    expected: SX

    def after(self, motion: Motion) -> SX:
        """Return what it would push with at the end of the step [N m]."""
        return self.push + self.slope * (self.sign * motion.ydd[self.row])


@dataclass
class MeshForce(JointForce):
    """What all meshes do over one step, some of their sides acting: a `LinearForce`."""

    sides: list[Side]

    def check(self, motion: Motion) -> SX:
        """Return 1 if a side acts that should not or the other way round; else 0."""
        changed = SX(0)
        for side in self.sides:
            changed = ca.logic_or(changed, (side.after(motion) > 0) != (side.expected > 0))
        return changed

    def next_iterate(self, motion: Motion) -> SX:
        """Return what each side pushes with for another iteration, and 1."""
        return ca.vertcat(*[side.after(motion) for side in self.sides], 1) if self.sides else SX(0, 1)


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
        force = MeshForce(SX(n, 1), SX(n, n), [])
        for row, elastic in stretching(self.scene.mechanism):
            k, d, backlash = mesh_figures(self.scene, elastic)
            if elastic.linear:
                force.tau[row] = -k * self.y[row] - (dt * k + d) * self.yd[row]
                force.slope[row, row] = dt * (dt * k + d)
                continue
            for sign in (1, -1):
                side = self._side(row, sign, k, d, gap_of(elastic, k, backlash), iterate, len(force.sides))
                acts = side.expected > 0
                force.tau[row] -= sign * ca.if_else(acts, side.push, 0)
                force.slope[row, row] += ca.if_else(acts, side.slope, 0)
                force.sides.append(side)
        return force

    def _side(self, row: int, sign: int, k: SX, d: SX, gap: SX, iterate: SX, place: int) -> Side:
        dt, beyond, rate = self.dt, sign * self.y[row] - gap, sign * self.yd[row]
        push = k * beyond + (dt * k + d) * rate
        if is_moment(dt):
            push = ca.if_else(beyond > 0, push, 0)
        else:
            push -= d * ca.fmax(-beyond, 0) / dt
        return Side(row, sign, push, dt * (dt * k + d), ca.if_else(iterate[-1] > 0, iterate[place], push))


def mesh_figures(scene: Scene, elastic: Elasticity) -> tuple[SX, SX, SX]:
    """Return stiffness [N m/rad] and damping [N m s/rad] of a side, or of all where there are none, and backlash [rad].

    Those of a belt's strand are half of the belt's.
    """
    figures, share = scene.figures, 1.0 if elastic.linear or elastic.backlash else 0.5
    k, d = share * elastic.stiffness * figures.drive_stiffness, share * elastic.damping * figures.drive_damping
    return k, d, elastic.backlash * elastic.play * figures.backlash


def gap_of(elastic: Elasticity, k: SX, backlash: SX) -> SX:
    """Return the stretch at which a side with stiffness k begins to push [rad]."""
    return backlash / 2 if elastic.backlash else -elastic.preload / (2 * k)


def mesh_energy(scene: Scene, y: SX) -> SX:
    """Return the elastic energy of all transmissions at positions of joints and stretches (n,) [J]."""
    total = SX(0)
    for row, elastic in stretching(scene.mechanism):
        k, _, backlash = mesh_figures(scene, elastic)
        if elastic.linear:
            total += k * y[row] ** 2 / 2
            continue
        gap = gap_of(elastic, k, backlash)
        total += k * (ca.fmax(y[row] - gap, 0) ** 2 + ca.fmax(-y[row] - gap, 0) ** 2) / 2
    return total
