"""Mechanical energy of a robot in a scene: what moves, what can fall, and what is bent.

Without motors nothing that the scene contains can give energy to the robot, so this sum must not grow.
"""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.integration import rotation_vector
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.drives.stretch import mesh_energy
from ce_gym.dynamics.electric.cogging import cogging_energy
from ce_gym.dynamics.forces.actuation import actuated_clusters, seen_joints
from ce_gym.dynamics.forces.motor_control import motor_springs
from ce_gym.dynamics.forces.motors import MOTORS
from ce_gym.dynamics.forces.passive import stop_springs, yielding_joints
from ce_gym.dynamics.forces.scene import Scene, State
from ce_gym.dynamics.recursion.derived import kinetic_and_potential
from ce_gym.dynamics.recursion.kinematics import outward_velocity_pass
from ce_gym.dynamics.stepping.step import meeting_pairs, touching
from ce_gym.model.mechanism import Mechanism


def mechanical_energy(scene: Scene, state: State, target: SX) -> SX:
    """Return kinetic, potential and elastic energy, and that of cogging [J].

    Elastic are the springs and bristles of contacts, stops and springs of joints, transmissions, and position control,
    the last as if motors had no limits.

    Args:
        scene: The robot and what surrounds it.
        state: Of the robot.
        target: Targets, or torques, which have no energy, shape (n_targets,), see `target_names`.
    """
    kinetic, potential = kinetic_and_potential(scene.mechanism, state.q, state.v, state.dependent)
    total = kinetic + potential + contact_energy(scene, state) + joint_energy(scene, state, target)
    total += spring_energy(scene, state) + mesh_energy(scene, state.q[scene.mechanism.robot.layout.joints_q :])
    return total + teeth_energy(scene, state)


def teeth_energy(scene: Scene, state: State) -> SX:
    """Return the potential of the motors' cogging [J]."""
    robot, total = scene.mechanism.robot, SX(0)
    if MOTORS[scene.options.motors].at_motors and any(motor.cogging for motor in robot.motors):
        kinematics = outward_velocity_pass(scene.mechanism, state.q, state.v, state.dependent)
        for cluster in actuated_clusters(scene.mechanism, kinematics):
            for i, motor in enumerate(cluster.motors):
                total += cogging_energy(motor.cogging, cluster.angles[i])
    return total


def contact_energy(scene: Scene, state: State) -> SX:
    """Return the energy of contact springs and bristles, those between links too [J]."""
    kinematics = outward_velocity_pass(scene.mechanism, state.q, state.v, state.dependent)
    k, k_t = scene.figures.compliance.stiffness, scene.figures.compliance.bristle
    touches = [contact.touch for contact in touching(scene, kinematics, state, 0.0)]
    touches += [pair.touch for pair in meeting_pairs(scene, kinematics, state, 0.0)]
    return sum((k * ca.fmax(t.depth, 0) ** 2 + k_t * ca.sumsqr(t.anchor) for t in touches), SX(0)) / 2


def spring_energy(scene: Scene, state: State) -> SX:
    """Return the energy of the springs of joints with one coordinate, and of the stops of dependent ones [J]."""
    total, yielding = SX(0), yielding_joints(scene.mechanism)
    if yielding:
        kinematics = outward_velocity_pass(scene.mechanism, state.q, state.v, state.dependent)
        for k, joint, name in yielding:
            coordinates = kinematics.coordinates[k]
            assert coordinates is not None
            angle = coordinates.position(name)
            total += joint.stiffness * (angle - joint.springref) ** 2 / 2
            if name not in scene.mechanism.robot.independent:
                total += stop_energy(scene.mechanism, name, angle)
    return total


def stop_energy(mechanism: Mechanism, name: str, angle: SX) -> SX:
    """Return the energy of the stops of a joint with one coordinate, at an angle [rad] or a way [m], in J."""
    (low, high), beyond = mechanism.robot.body(name).joint.position, SX(0)
    for bound, side in ((low, 1.0), (high, -1.0)):
        if math.isfinite(bound):
            beyond += ca.fmax(side * (bound - angle), 0)
    return stop_springs(mechanism)[name][0] * beyond**2 / 2


def joint_energy(scene: Scene, state: State, target: SX) -> SX:
    """Return the energy of the stops of independent and ball joints, and of position control [J]."""
    robot, total = scene.mechanism.robot, SX(0)
    y = state.q[robot.layout.joints_q :]
    for name, (row, _) in zip(robot.balls, robot.layout.ball_turns, strict=True):
        joint, turned = robot.body(name).joint, rotation_vector(state.q[row : row + 4])
        total += joint.stiffness * ca.sumsqr(turned) / 2
        if math.isfinite(joint.position[1]):
            beyond = ca.fmax(ca.norm_2(turned) - joint.position[1], 0)
            total += stop_springs(scene.mechanism)[name][0] * beyond**2 / 2
    for i, name in enumerate(robot.independent):
        total += stop_energy(scene.mechanism, name, y[i])
    if scene.options.control == "position":
        kinematics = outward_velocity_pass(scene.mechanism, state.q, state.v, state.dependent)
        at = seen_joints(scene.mechanism, kinematics) @ y
        total += ca.sum1(scene.figures.strength * scene.figures.kp * (target - at) ** 2) / 2
    if scene.options.control == "motor_position":
        kinematics = outward_velocity_pass(scene.mechanism, state.q, state.v, state.dependent)
        stiffness, stretch = motor_springs(scene, kinematics, y, target)
        total += ca.sum1(scene.figures.strength * stiffness * stretch**2) / 2
    return total
