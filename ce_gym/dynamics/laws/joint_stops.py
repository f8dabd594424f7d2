"""Viscous friction and stops of independent joints, and the springs of ball joints; see `forces/passive.py`."""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.integration import rotation_vector
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.passive import ball_forces, passive_forces, stop_energy, stop_springs
from ce_gym.dynamics.laws.law import ForceLaw, PassiveForces, Start


class JointStops(ForceLaw):
    """Viscous friction and stops of independent joints, and springs of ball joints."""

    def place(self, start: Start) -> PassiveForces:
        """Return the forces at the start of a step."""
        mechanism, dt = start.scene.mechanism, start.dt
        balls = ball_forces(mechanism, start.state.q, start.state.v, dt)
        return PassiveForces([passive_forces(mechanism, start.y, start.yd, dt)], balls)

    def energy(self, start: Start) -> SX:
        """Return the energy of stops, and of the springs of ball joints [J]."""
        mechanism, total = start.scene.mechanism, SX(0)
        robot, springs = mechanism.robot, stop_springs(mechanism)
        for name, (row, _) in zip(robot.balls, robot.layout.ball_turns, strict=True):
            joint, turned = robot.body(name).joint, rotation_vector(start.state.q[row : row + 4])
            total += joint.stiffness * ca.sumsqr(turned) / 2
            if math.isfinite(joint.position[1]):
                beyond = ca.fmax(ca.norm_2(turned) - joint.position[1], 0)
                total += springs[name][0] * beyond**2 / 2
        for i, name in enumerate(robot.independent):
            total += stop_energy(mechanism, name, start.y[i])
        return total
