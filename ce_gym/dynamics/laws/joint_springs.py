"""Springs of joints, and viscous friction and stops of dependent joints, taken one step ahead."""

from __future__ import annotations

import math

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.linear import JointForce
from ce_gym.dynamics.forces.stops import stop_energy, stop_force, stop_springs
from ce_gym.dynamics.laws.law import ForceLaw, PassiveForces, Start
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.model.description import Joint
from ce_gym.model.mechanism import Mechanism


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


def yielding_joints(mechanism: Mechanism) -> list[tuple[int, Joint, str]]:
    """Return joints with one coordinate that have springs, and dependent ones that are damped or have stops.

    Each with the index of its cluster and the name of the body it moves. `JointStops` has the damping and stops of
    independent joints.
    """
    robot, yielding = mechanism.robot, []
    for k, cluster in enumerate(mechanism.tree.clusters):
        for name in cluster.bodies:
            joint = robot.body(name).joint
            follows = name not in robot.independent and (joint.damping or any(map(math.isfinite, joint.position)))
            if joint.nv == 1 and (joint.stiffness or follows):
                yielding.append((k, joint, name))
    return yielding


def yielding_forces(mechanism: Mechanism, kinematics: Kinematics, dt: float) -> list[JointForce]:
    """Return springs of joints with one coordinate, and viscous friction and stops of dependent ones.

    With `W` the row of the constraint Jacobian of a joint, the joint moves at `W yd` and acts on the independent joints
    with `W^T tau`. Near the end of a loop's reach `W` grows without bound, and with it the load that the stop of a
    dependent joint can resist.
    """
    robot, forces, layout = mechanism.robot, [], mechanism.robot.layout
    for k, joint, name in yielding_joints(mechanism):
        coordinates = kinematics.coordinates[k]
        assert coordinates is not None
        W, row = SX(1, layout.joints), coordinates.index[name]
        W[[row - layout.joints_v for row in kinematics.rows[k]]] = coordinates.G[row, :]
        q, qd, follows = coordinates.q[row], coordinates.qd[row], name not in robot.independent
        damping = (joint.damping if follows else 0.0) + dt * joint.stiffness
        tau, slope = -joint.stiffness * (q - joint.springref) - damping * qd, dt * damping
        if follows:
            push, more = stop_force(q, qd, joint.position, *stop_springs(mechanism)[name], dt)
            tau, slope = tau + push, slope + more
        forces.append(JointForce(tau * W.T, slope * (W.T @ W)))
    return forces
