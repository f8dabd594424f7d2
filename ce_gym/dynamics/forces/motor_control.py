"""Control of a robot at its joints or at its motors, and the torques that the motors give for it.

At the motors, a target is an angle or a torque of a rotor, whatever transmission lies between rotor and joints. With
theta the rotors' angles and `W` their speeds for unit joint velocities,

    tau_m = kp_m (target - theta) - kd_m thetad        tau = W^T tau_m

each within the motor's own limits. Every motor has its own loop. Where belts, differentials or rods tie motors and
joints together, the gains at the joints `W^T diag(kp_m) W` couple the joints. The gains of a motor follow from the
gains of its joints with the other motors of the cluster at rest, in the standing pose:

    kp_m,i = e_i^T W^-T diag(kp) W^-1 e_i        kp / N^2 behind a gear of ratio N, where both controls are the same

As in actuation.py torques are taken one step ahead, as a controller much faster than the steps would give them. A
sampled controller reads positions and speeds at the start of the step in which its period ends, and holds its torques
until the next sample. These torques are not implicit: gains that are too large for the period are unstable, as on
hardware.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.actuation import (
    Actuated,
    MotorState,
    actuated_clusters,
    add_motor_torques,
    encoder_map,
    joint_command,
    torques_of_joint_command,
    within_joint_limits,
)
from ce_gym.dynamics.forces.linear import JointForce, is_moment
from ce_gym.dynamics.forces.motors import MOTORS
from ce_gym.dynamics.forces.saturation import SaturatedForce
from ce_gym.dynamics.forces.scene import Scene, target_names
from ce_gym.dynamics.recursion.kinematics import Kinematics, outward_velocity_pass
from ce_gym.model.mechanism import Mechanism


@dataclass
class MotorControl:
    """The motors of a robot over one step, and their controllers.

    Attributes:
        scene: The robot and its surroundings.
        kinematics: Of the robot.
        y: Independent joint positions [rad or m], shape (nj,).
        yd: Their velocities, shape (nj,).
        target: See `target_names`, shape (n_targets,).
        dt: Length of the step [s].
        memory: Of the motors at the start of the step.
    """

    scene: Scene
    kinematics: Kinematics
    y: SX
    yd: SX
    target: SX
    dt: float
    memory: MotorState

    def linearise(self, iterate: SX) -> SaturatedForce:
        """Return the torques at the joints, linearised about an iterate, shape (limit_count,)."""
        at_joints = self.scene.options.control in ("position", "torque")
        force = self._torques_at_joints(iterate) if at_joints else self._torques_at_motors(iterate)
        if self.scene.options.sampled:
            period, remaining = self.scene.options.control_period, self.memory.held[-1]
            force.sampled = ca.vertcat(self._sampled, ca.if_else(self._due, period, remaining) - self.dt)
        return force

    @property
    def _names(self) -> tuple[str, ...]:
        """Names of the targets."""
        return target_names(self.scene.mechanism, self.scene.options.control)

    @property
    def _due(self) -> SX:
        """1 if a sampled controller reads now; multiples of the step may differ from the period by rounding."""
        return SX(1) if is_moment(self.dt) else self.memory.held[-1] < self.dt / 2

    @property
    def _sampled(self) -> SX:
        """Torques commanded by a sampled controller over the step [N m or N], shape (n_targets,)."""
        scene, mechanism = self.scene, self.scene.mechanism
        if scene.options.control == "position":
            encoders = encoder_map(mechanism, self.kinematics)
            command = joint_command(scene, encoders @ self.y, encoders @ self.yd, self.target, 0.0).tau
        else:
            names, command = self._names, SX.zeros(self.target.numel())
            for row, name in enumerate(mechanism.robot.commanded):
                if name in names:
                    command[names.index(name)] = self._undriven_command(names, [row], 0.0).tau[row]
            for cluster in actuated_clusters(mechanism, self.kinematics):
                places = [names.index(motor.rotor) for motor in cluster.motors]
                command[places] = self._position_command(cluster, self.target[places], 0.0).tau
        return ca.densify(ca.if_else(self._due, command, self.memory.held[:-1]))

    def _torques_at_joints(self, iterate: SX) -> SaturatedForce:
        """Return the torques for targets of the joints."""
        encoders = encoder_map(self.scene.mechanism, self.kinematics)
        command = joint_command(self.scene, encoders @ self.y, encoders @ self.yd, self.target, self.dt)
        if self.scene.options.sampled:
            command = constant_torque(self._sampled)
        return torques_of_joint_command(
            self.scene, self.kinematics, command, self.yd, self.dt, iterate, encoders, self.memory
        )

    def _torques_at_motors(self, iterate: SX) -> SaturatedForce:
        """Return the torques for targets of the motors, and of the joints that no motor drives."""
        scene, names, joints = self.scene, self._names, self.scene.mechanism.robot.commanded
        undriven = [row for row, name in enumerate(joints) if name in names]
        force = self._undriven_torques(names, undriven, iterate.numel())
        model, strength = MOTORS[scene.options.motors], scene.values["motor_strength"]
        for cluster in actuated_clusters(scene.mechanism, self.kinematics):
            targets = self.target[[names.index(motor.rotor) for motor in cluster.motors]]
            command = self._motor_command(cluster, targets)
            add_motor_torques(model, force, command, cluster, self.yd, strength, self.dt, iterate, self.memory)
        return within_joint_limits(scene, force, undriven, iterate, SX.eye(self.y.numel()))

    def _motor_command(self, cluster: Actuated, targets: SX) -> JointForce:
        """Return the torques commanded at the motors of a cluster, given their targets, shape (n_motors,) both."""
        strength, n = self.scene.values["motor_strength"], targets.numel()
        if self.scene.options.control == "motor_torque":
            command = JointForce(targets, SX(n, 1))
        elif self.scene.options.sampled:
            places = [self._names.index(motor.rotor) for motor in cluster.motors]
            command = JointForce(self._sampled[places], SX(n, 1))
        else:
            command = self._position_command(cluster, targets, self.dt)
        return JointForce(strength * command.tau, ca.diag(strength * command.slope))

    def _position_command(self, cluster: Actuated, targets: SX, dt: float) -> JointForce:
        """Return the torques of position control at the motors of a cluster, slopes as a column."""
        kp, kd = _gains(self.scene, cluster)
        damping = kd + dt * kp
        tau = kp * (targets - cluster.angles) - damping * (cluster.W @ self.yd[cluster.rows])
        return JointForce(tau, dt * damping)

    def _undriven_torques(self, names: tuple[str, ...], rows: list[int], size: int) -> SaturatedForce:
        """Return the torques of the joints that no motor drives, and none of the others."""
        n, strength, joints = self.y.numel(), self.scene.values["motor_strength"], self.scene.mechanism.robot.commanded
        force = SaturatedForce(SX(n, 1), SX(n, n), size)
        command = self._undriven_command(names, rows, self.dt)
        if self.scene.options.sampled:
            held, tau = self._sampled, SX.zeros(len(joints))
            for row in rows:
                tau[row] = held[names.index(joints[row])]
            command = constant_torque(tau)
        for row in rows:
            force.tau[row], force.slope[row, row] = strength * command.tau[row], strength * command.slope[row, row]
        return force

    def _undriven_command(self, names: tuple[str, ...], rows: list[int], dt: float) -> JointForce:
        """Return the command at the joints that no motor drives, for their own targets."""
        scene, joints = self.scene, self.scene.mechanism.robot.commanded
        control = "position" if scene.options.control == "motor_position" else "torque"
        targets = SX.zeros(len(joints))
        for row in rows:
            targets[row] = self.target[names.index(joints[row])]
        scene = replace(scene, options=replace(scene.options, control=control))
        return joint_command(scene, self.y[: len(joints)], self.yd[: len(joints)], targets, dt)


def constant_torque(tau: SX) -> JointForce:
    """Return torques that do not depend on accelerations."""
    return JointForce(tau, SX(tau.numel(), tau.numel()))


def motor_springs(scene: Scene, kinematics: Kinematics, y: SX, target: SX) -> tuple[SX, SX]:
    """Return stiffness [N m/rad] and stretch [rad] of each spring of position control at the motors, (n_targets,)."""
    names, joints = target_names(scene.mechanism, "motor_position"), scene.mechanism.robot.commanded
    stiffness, at = SX.zeros(len(names)), SX.zeros(len(names))
    for row, name in enumerate(joints):
        if name in names:
            stiffness[names.index(name)], at[names.index(name)] = scene.values["kp"][row], y[row]
    for cluster in actuated_clusters(scene.mechanism, kinematics):
        entries = [names.index(motor.rotor) for motor in cluster.motors]
        stiffness[entries], at[entries] = _gains(scene, cluster)[0], cluster.angles
    return stiffness, target - at


@lru_cache(maxsize=64)
def standing_motors(mechanism: Mechanism) -> dict[str, tuple[float, NDArray[np.float64], NDArray[np.float64]]]:
    """Return the motion of motors in the standing pose of a robot, with nominal ratios and without stretches.

    Returns:
        For each rotor with a motor: its angle [rad]; its speed for unit velocities of the joints of its cluster, shape
        (d,); the speeds of these joints for unit speed of this rotor alone, shape (d,).
    """
    q, still = SX(ca.DM(mechanism.robot.standing_q)), SX(mechanism.robot.layout.nv, 1)
    mechanism = replace(mechanism, ratio=None)
    kinematics = outward_velocity_pass(mechanism, q, still)
    motions = {}
    for cluster in actuated_clusters(mechanism, kinematics):
        W, angles = np.array(ca.evalf(cluster.W[:, : len(cluster.joints)])), np.array(ca.evalf(cluster.angles))[:, 0]
        for i, (motor, back) in enumerate(zip(cluster.motors, np.linalg.pinv(W).T, strict=True)):
            motions[motor.rotor] = float(angles[i]), W[i], back
    return motions


def _gains(scene: Scene, cluster: Actuated) -> tuple[SX, SX]:
    """Return position [N m/rad] and velocity gains [N m s/rad] of a cluster's motors, shape (n_motors,) each."""
    known = standing_motors(scene.mechanism)
    squares = SX(ca.sparsify(ca.DM(np.array([known[motor.rotor][2] for motor in cluster.motors]) ** 2)))
    return squares @ scene.values["kp"][cluster.joints], squares @ scene.values["kd"][cluster.joints]
