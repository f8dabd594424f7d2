"""Springs of joints, and viscous friction and stops of dependent joints; see `forces/passive.py`."""

from __future__ import annotations

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.passive import stop_energy, yielding_forces, yielding_joints
from ce_gym.dynamics.laws.law import ForceLaw, PassiveForces, Start


class JointSprings(ForceLaw):
    """Springs of joints with one coordinate, and viscous friction and stops of dependent joints."""

    def declare(self) -> None:
        """Act if the robot has such joints."""
        self.acts = bool(yielding_joints(self.mechanism))

    def place(self, start: Start) -> PassiveForces:
        """Return the forces at the start of a step."""
        return PassiveForces(yielding_forces(start.scene.mechanism, start.kinematics, start.dt))

    def energy(self, start: Start) -> SX:
        """Return the energy of the springs, and of the stops of dependent joints [J]."""
        total = SX(0)
        for k, joint, name in yielding_joints(start.scene.mechanism):
            coordinates = start.kinematics.coordinates[k]
            assert coordinates is not None
            angle = coordinates.position(name)
            total += joint.stiffness * (angle - joint.springref) ** 2 / 2
            if name not in start.scene.mechanism.robot.independent:
                total += stop_energy(start.scene.mechanism, name, angle)
        return total
