"""Control of a robot at its joints or at its motors, up to what the motors deliver to the joints.

At the motors, a target is an angle or a torque of a rotor, whatever lies between it and the joints: with theta the
rotors' angles and `W` their speeds for unit joint velocities,

    tau_m = kp_m (target - theta) - kd_m thetad        tau = W^T tau_m

each within the motor's own limits. Every motor has a loop of its own, so that where belts, differentials or rods tie
motors and joints together the gains at the joints are `W^T diag(kp_m) W`, and couple. The gains of a motor are those of
its joints as it feels them alone, the other motors of the cluster at rest, in the standing pose:

    kp_m,i = e_i^T W^-T diag(kp) W^-1 e_i        kp / N^2 behind a gear of ratio N, where both controls are the same

As in actuation.py forces are taken one step ahead: what a controller that is much faster than the steps does. One that
is slower looks at positions and speeds at the start of the step in which its time has come, and holds what it asks for
until it looks again; nothing of that is implicit, and gains that are too large for its period are unstable, as they are
in hardware.
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
    Before,
    actuated_clusters,
    controller,
    deliver,
    limit_count,
    motor_forces,
    seen_joints,
    within_joint_limits,
)
from ce_gym.dynamics.forces.linear import JointForce, is_moment
from ce_gym.dynamics.forces.motors import MOTORS
from ce_gym.dynamics.forces.saturation import SaturatedForce
from ce_gym.dynamics.forces.scene import Scene, target_names
from ce_gym.dynamics.recursion.kinematics import Kinematics, outward_velocity_pass
from ce_gym.model.mechanism import Mechanism


@dataclass
class Motors:
    """What the motors of a robot do over one step: a `ForceLaw`.

    Attributes:
        scene: The robot and what surrounds it.
        kinematics: Of the robot.
        y: Independent joint positions [rad or m], shape (nj,).
        yd: Their velocities, shape (nj,).
        target: See `target_names`, shape (n_targets,).
        dt: Length of the step [s].
        before: What motors go by of the step before.
    """

    scene: Scene
    kinematics: Kinematics
    y: SX
    yd: SX
    target: SX
    dt: float
    before: Before

    @property
    def size(self) -> int:
        """How many numbers its iterate has."""
        return limit_count(self.scene.mechanism, self.scene.options)

    def linearise(self, iterate: SX) -> SaturatedForce:
        """Linearise about an iterate, shape (size,)."""
        force = self._delivered(iterate)
        if self.scene.options.sampled:
            period, left = self.scene.options.control_period, self.before.held[-1]
            force.sampled = ca.vertcat(self._sampled, ca.if_else(self._due, period, left) - self.dt)
        return force

    @property
    def _due(self) -> SX:
        """1 if a sampled controller looks now; steps and samples need not be the same numbers to rounding."""
        return SX(1) if is_moment(self.dt) else self.before.held[-1] < self.dt / 2

    @property
    def _sampled(self) -> SX:
        """What a sampled controller asks for over the step [N m or N], shape (n_targets,)."""
        scene = self.scene
        if scene.options.control == "position":
            seen = seen_joints(scene.mechanism, self.kinematics)
            now = controller(scene, seen @ self.y, seen @ self.yd, self.target, 0.0).tau
        else:
            names, now = target_names(scene.mechanism, scene.options.control), SX.zeros(self.target.numel())
            for row, name in enumerate(scene.mechanism.robot.commanded):
                if name in names:
                    now[names.index(name)] = self._joints_ask(names, [row], 0.0).tau[row]
            for cluster in actuated_clusters(scene.mechanism, self.kinematics):
                places = [names.index(motor.rotor) for motor in cluster.motors]
                now[places] = self._motors_ask(cluster, self.target[places], 0.0).tau
        return ca.densify(ca.if_else(self._due, now, self.before.held[:-1]))

    def _delivered(self, iterate: SX) -> SaturatedForce:
        scene, y, yd, dt = self.scene, self.y, self.yd, self.dt
        if scene.options.control in ("position", "torque"):
            seen = seen_joints(scene.mechanism, self.kinematics)
            asked = controller(scene, seen @ y, seen @ yd, self.target, dt)
            if scene.options.sampled:
                asked = unanswering(self._sampled)
            return motor_forces(scene, self.kinematics, asked, yd, dt, iterate, seen, self.before)
        names, joints = target_names(scene.mechanism, scene.options.control), scene.mechanism.robot.commanded
        undriven = [row for row, name in enumerate(joints) if name in names]
        force = self._at_joints(names, undriven, iterate.numel())
        for cluster in actuated_clusters(scene.mechanism, self.kinematics):
            own = self.target[[names.index(motor.rotor) for motor in cluster.motors]]
            asked, model = self._at_motors(cluster, own), MOTORS[scene.options.motors]
            deliver(model, force, asked, cluster, yd, scene.values["motor_strength"], dt, iterate, self.before)
        return within_joint_limits(scene, force, undriven, iterate, SX.eye(y.numel()))

    def _at_motors(self, cluster: Actuated, own: SX) -> JointForce:
        """Return what the motors of a cluster are asked for, given their targets, shape (n_motors,) both."""
        strength = self.scene.values["motor_strength"]
        if self.scene.options.control == "motor_torque":
            asked = JointForce(own, SX(own.numel(), 1))
        elif self.scene.options.sampled:
            names = target_names(self.scene.mechanism, self.scene.options.control)
            places = [names.index(motor.rotor) for motor in cluster.motors]
            asked = JointForce(self._sampled[places], SX(own.numel(), 1))
        else:
            asked = self._motors_ask(cluster, own, self.dt)
        return JointForce(strength * asked.tau, ca.diag(strength * asked.slope))

    def _motors_ask(self, cluster: Actuated, own: SX, dt: float) -> JointForce:
        """Return what position control asks the motors of a cluster for, slopes as a column."""
        kp, kd = _gains(self.scene, cluster)
        damping = kd + dt * kp
        tau = kp * (own - cluster.angles) - damping * (cluster.W @ self.yd[cluster.rows])
        return JointForce(tau, dt * damping)

    def _at_joints(self, names: tuple[str, ...], rows: list[int], size: int) -> SaturatedForce:
        """Return what is asked of the joints that no motor drives, and nothing of the others."""
        n, strength, joints = self.y.numel(), self.scene.values["motor_strength"], self.scene.mechanism.robot.commanded
        force = SaturatedForce(SX(n, 1), SX(n, n), size)
        asked = self._joints_ask(names, rows, self.dt)
        if self.scene.options.sampled:
            held, full = self._sampled, SX.zeros(len(joints))
            for row in rows:
                full[row] = held[names.index(joints[row])]
            asked = unanswering(full)
        for row in rows:
            force.tau[row], force.slope[row, row] = strength * asked.tau[row], strength * asked.slope[row, row]
        return force

    def _joints_ask(self, names: tuple[str, ...], rows: list[int], dt: float) -> JointForce:
        """Return what control asks for at the joints that no motor drives, their own targets being followed."""
        scene, joints = self.scene, self.scene.mechanism.robot.commanded
        control = "position" if scene.options.control == "motor_position" else "torque"
        full = SX.zeros(len(joints))
        for row in rows:
            full[row] = self.target[names.index(joints[row])]
        scene = replace(scene, options=replace(scene.options, control=control))
        return controller(scene, self.y[: len(joints)], self.yd[: len(joints)], full, dt)


def unanswering(tau: SX) -> JointForce:
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
    """Return what motors do in the standing pose of a robot that is as it should be.

    Returns:
        For each rotor with a motor its angle [rad], its speed for unit velocities of the joints of its cluster, shape
        (d,), and the speeds of those joints for unit speed of it alone, shape (d,); nothing stretches.
    """
    q, still = SX(ca.DM(mechanism.robot.standing_q)), SX(mechanism.robot.layout.nv, 1)
    mechanism = replace(mechanism, ratio=None)
    kinematics = outward_velocity_pass(mechanism, q, still)
    found = {}
    for cluster in actuated_clusters(mechanism, kinematics):
        W, angles = np.array(ca.evalf(cluster.W[:, : len(cluster.joints)])), np.array(ca.evalf(cluster.angles))[:, 0]
        for i, (motor, back) in enumerate(zip(cluster.motors, np.linalg.pinv(W).T, strict=True)):
            found[motor.rotor] = float(angles[i]), W[i], back
    return found


def _gains(scene: Scene, cluster: Actuated) -> tuple[SX, SX]:
    """Return position [N m/rad] and velocity gains [N m s/rad] of a cluster's motors, shape (n_motors,) each."""
    known = standing_motors(scene.mechanism)
    squares = SX(ca.sparsify(ca.DM(np.array([known[motor.rotor][2] for motor in cluster.motors]) ** 2)))
    return squares @ scene.values["kp"][cluster.joints], squares @ scene.values["kd"][cluster.joints]
