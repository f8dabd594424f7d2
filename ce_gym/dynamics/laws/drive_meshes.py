"""Transmissions that stretch: meshes with backlash, belts and springs; `drives/mesh.py` has the equations."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.drives.mesh import MESH_ITERATIONS, Meshes, MeshForce, mesh_count, stretch_resistances
from ce_gym.dynamics.drives.stretch import mesh_energy, stretching
from ce_gym.dynamics.forces.linear import JointForce, Motion
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.parameters import Parameter
from ce_gym.model.description import ContactMaterial, Robot


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

    @property
    def acts(self) -> bool:
        """Whether a transmission stretches."""
        return bool(stretching(self.mechanism))

    @property
    def size(self) -> int:
        """Size of the iterate: an acceleration for each mesh with two sides, and 1 once there is an iterate."""
        return mesh_count(self.mechanism)

    @property
    def iterations(self) -> int:
        """How many iterations meshes may need until it is settled which of their sides act."""
        return MESH_ITERATIONS if self.size else 0

    def place(self, start: Start) -> PlacedMeshes:
        """Return the meshes at the start of a step."""
        return PlacedMeshes(start)

    def energy(self, start: Start) -> SX:
        """Return the elastic energy of all transmissions [J]."""
        return mesh_energy(start.scene, start.y)


@dataclass
class PlacedMeshes(PlacedForce):
    """The meshes at the start of a step."""

    start: Start

    def linearise(self, iterate: SX) -> MeshForces:
        """Linearise about an iterate."""
        start = self.start
        return MeshForces(start, Meshes(start.scene, start.y, start.yd, start.dt).linearise(iterate), iterate)


@dataclass
class MeshForces(LinearForce):
    """The torques of all meshes, linear in the accelerations.

    Attributes:
        start: The robot at the start of the step.
        force: On the joints and stretches.
        iterate: Of the iteration before.
        others: The sum of all other forces on the joints and stretches.
    """

    start: Start
    force: MeshForce
    iterate: SX
    others: JointForce = field(init=False)

    def add_to(self, loads: Loads) -> None:
        """Add the torques to the joints and stretches; meshes are the last law."""
        self.others = loads.joints
        loads.joints = loads.joints + self.force

    def check(self, motion: Motion) -> SX:
        """Return 1 if a side acts that was assumed not to, or the reverse; else 0."""
        return self.force.check(motion)

    def next_iterate(self, motion: Motion, unconverged: SX) -> SX:
        """Return the accelerations of stretches to expect."""
        found = motion.articulation
        if not self.iterate.numel() or found is None:
            return self.iterate
        mechanism, kinematics = self.start.scene.mechanism, self.start.kinematics
        resistances = stretch_resistances(mechanism, kinematics, found.D, found.inertia, self.others.slope)
        return ca.if_else(unconverged, self.force.next_iterate(motion, resistances), self.iterate)
