"""Forces on the independent coordinates, linearly implicit in the step: motors, damping, joint limits.

Each is `tau - slope @ ydd` with the force taken one step ahead, exactly as in contact.py; the slope joins `D` of the
cluster. A saturated motor gives a constant torque and has no slope.

Controllers ask for torques at the joints. "Ideal" motors deliver them up to the joints' limits. "Limited" motors are
the ones the robot has: their torques `tau_m` and speeds `W yd` belong to rotors, with `W` the rows of the constraint
Jacobian, and what they do to the joints is `W^T tau_m`. Limits and friction there do not depend on the transmission
level. May know CasADi, descriptions, mechanisms and kinematics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.kinematics import Kinematics
from ce_gym.dynamics.scene import Scene
from ce_gym.dynamics.spatial import SX
from ce_gym.model.description import Motor, Robot
from ce_gym.model.mechanism import Mechanism

LIMIT_FREQUENCY = 2 * math.pi * 20.0
"""Stiffness over damping of a soft joint limit [1/s]; the stop relaxes in the inverse of it, 8 ms."""
COULOMB_SPEED = 0.1
"""Rotor speed at which the dry friction of a motor reaches 1/sqrt(2) of its full value [rad/s]."""


@dataclass
class JointForce:
    """A force on coordinates, `tau - slope @ ydd` over the step.

    Attributes:
        tau: At zero acceleration [N m or N], shape (n,).
        slope: Symmetric [kg m^2 or kg], shape (n, n).
    """

    tau: SX
    slope: SX

    def __add__(self, other: JointForce) -> JointForce:
        """Return both acting together."""
        return JointForce(self.tau + other.tau, self.slope + other.slope)


def controller(scene: Scene, y: SX, yd: SX, target: SX, dt: float) -> JointForce:
    """Return what the motors are asked for at the joints: a torque, or a proportional-derivative position control."""
    if scene.options.control == "torque":
        return JointForce(target, SX(target.shape[0], target.shape[0]))
    damping = scene.figures.kd + dt * scene.figures.kp
    return JointForce(scene.figures.kp * (target - y) - damping * yd, ca.diag(dt * damping))


def motor_forces(scene: Scene, kinematics: Kinematics, asked: JointForce, yd: SX, dt: float) -> JointForce:
    """Return what the motors deliver of the torques they are asked for."""
    strength = scene.figures.strength
    force = JointForce(strength * asked.tau, strength * asked.slope)
    actuated = actuated_clusters(scene.mechanism, kinematics) if scene.options.motors == "limited" else []
    for cluster in actuated:
        rows = cluster.rows
        local = JointForce(force.tau[rows], force.slope[rows, rows])
        local = _through_motors(local, cluster, yd, strength, dt)
        force.tau[rows], force.slope[rows, rows] = local.tau, local.slope
    driven = {row for cluster in actuated for row in cluster.rows}
    return within_joint_limits(scene, force, [row for row in range(yd.numel()) if row not in driven])


def within_joint_limits(scene: Scene, force: JointForce, rows: list[int]) -> JointForce:
    """Return a force of the motors that the joints `rows` limit; it is changed in place."""
    robot, strength = scene.mechanism.robot, scene.figures.strength
    for row in rows:
        limit = robot.body(robot.independent[row]).joint.torque
        if not math.isinf(limit):
            tau, limit = force.tau[row], strength * limit
            force.slope[row, row] = ca.if_else(ca.fabs(tau) > limit, 0, force.slope[row, row])
            force.tau[row] = ca.fmax(-limit, ca.fmin(limit, tau))
    return JointForce(force.tau, ca.sparsify(force.slope))


@dataclass
class Actuated:
    """A cluster with motors at one state.

    Attributes:
        rows: Its rows of `y`, d of them.
        motors: Its motors.
        angles: Of the motors' rotors [rad], shape (n_motors,).
        W: Speeds of the motors for unit velocities of the independent joints, shape (n_motors, d) (footnote on general
            actuation of arXiv:2311.13732); torques of motors go the other way, `tau = W^T tau_m`.
    """

    rows: list[int]
    motors: list[Motor]
    angles: SX
    W: SX


def actuated_clusters(mechanism: Mechanism, kinematics: Kinematics) -> list[Actuated]:
    """Return the clusters with motors."""
    first = 6 if mechanism.robot.floating else 0
    found = []
    for cluster, rows, coordinates in zip(
        mechanism.tree.clusters, kinematics.rows, kinematics.coordinates, strict=True
    ):
        motors = [motor for motor in mechanism.robot.motors if motor.rotor in cluster.bodies]
        if motors and coordinates is not None:
            turning = [coordinates.index[motor.rotor] for motor in motors]
            W = ca.sparsify(coordinates.G[turning, :])
            found.append(Actuated([row - first for row in rows], motors, coordinates.q[turning], W))
    return found


def _through_motors(asked: JointForce, cluster: Actuated, yd: SX, strength: SX, dt: float) -> JointForce:
    """Share joint torques out to motors and carry back to the joints what those deliver."""
    to_motors = _effort_matrix(cluster.W)
    shares = JointForce(to_motors @ asked.tau, to_motors @ asked.slope @ to_motors.T)
    return delivered(shares, cluster, yd, strength, dt)


def delivered(asked: JointForce, cluster: Actuated, yd: SX, strength: SX, dt: float) -> JointForce:
    """Limit the torques that motors are asked for, take friction off each, and carry the sum to the joints."""
    W, motors, speed = cluster.W, cluster.motors, cluster.W @ yd[cluster.rows]
    tau, slope = SX(asked.tau), asked.slope
    free, own = SX.eye(len(motors)), SX(len(motors), len(motors))
    for i, motor in enumerate(motors):
        if math.isfinite(motor.torque) or math.isfinite(motor.velocity):
            tau[i], free[i, i], own[i, i] = _limited(motor, tau[i], speed[i], strength, dt)
        drag = motor.damping + (motor.friction / ca.sqrt(speed[i] ** 2 + COULOMB_SPEED**2) if motor.friction else 0)
        tau[i] -= drag * speed[i]
        own[i, i] += dt * drag
    return JointForce(W.T @ tau, W.T @ (free @ slope @ free + own) @ W)


def _effort_matrix(W: SX) -> SX:
    """Return the matrix that takes joint torques to motor torques: inverse of `W^T`, least squares if not square."""
    n, d = W.shape
    if n == d:
        return ca.inv(W.T)
    return W @ ca.inv(W.T @ W) if n > d else ca.inv(W @ W.T) @ W


def _limited(motor: Motor, tau: SX, speed: SX, strength: SX, dt: float) -> tuple[SX, SX, SX]:
    """Return the torque that a motor can give of what it is asked for [N m], and how it answers to its acceleration.

    The current allows `torque`; the voltage `stall (1 - speed / velocity)` forwards and `stall (1 + speed / velocity)`
    backwards, the torque-speed line, but never makes a motor brake. A motor on the line is taken along it to the speed
    at the end of the step, or it would overshoot its no-load speed wherever a step is long.

    Returns:
        The torque; 1 if it is what was asked for, else 0; and the slope of the line if the motor is on it [kg m^2].
    """
    limit = strength * motor.torque if math.isfinite(motor.torque) else SX(math.inf)
    stall = strength * (motor.torque if motor.stall is None else motor.stall)
    if math.isinf(motor.velocity) or math.isinf(motor.torque if motor.stall is None else motor.stall):
        return ca.fmax(-limit, ca.fmin(limit, tau)), ca.fabs(tau) <= limit, SX(0)
    forwards, backwards = stall * (1 - speed / motor.velocity), stall * (1 + speed / motor.velocity)
    high, low = ca.fmax(0, ca.fmin(limit, forwards)), -ca.fmax(0, ca.fmin(limit, backwards))
    given = ca.fmax(low, ca.fmin(high, tau))
    line = ca.if_else(tau > 0, forwards, backwards)
    on_line = ca.logic_and(given != tau, ca.logic_and(line > 0, line <= limit))
    return given, given == tau, ca.if_else(on_line, dt * stall / motor.velocity, 0)


def passive_forces(robot: Robot, y: SX, yd: SX, dt: float) -> JointForce:
    """Return viscous friction and stops of all independent joints."""
    total = [_viscous_damping(yd[i], robot.body(name).joint.damping, dt) for i, name in enumerate(robot.independent)]
    for i, name in enumerate(robot.independent):
        stiffness, damping = limit_stiffness(robot, name)
        tau, slope = _stop(y[i], yd[i], robot.body(name).joint.position, stiffness, damping, dt)
        total[i] = total[i][0] + tau, total[i][1] + slope
    tau, slopes = ca.vertcat(SX(0, 1), *[t for t, _ in total]), ca.vertcat(SX(0, 1), *[s for _, s in total])
    return JointForce(tau, ca.diag(slopes))


def limit_stiffness(robot: Robot, name: str) -> tuple[float, float]:
    """Return stiffness [N m/rad] and damping [N m s/rad] of a joint's stops: full torque at 0.02 rad, well damped."""
    torque = robot.body(name).joint.torque
    stiffness = 50.0 * torque if math.isfinite(torque) else 1e3
    return stiffness, stiffness / LIMIT_FREQUENCY


def _viscous_damping(yd: SX, damping: float, dt: float) -> tuple[SX, SX]:
    return SX(-damping * yd), SX(dt * damping)


def _stop(y: SX, yd: SX, limits: tuple[float, float], stiffness: float, damping: float, dt: float) -> tuple[SX, SX]:
    """One-sided springs at the ends of a joint's range, active if it will be beyond one by the end of the step."""
    tau, total, slope = SX(0), SX(0), damping + dt * stiffness
    for bound, side in ((limits[0], 1.0), (limits[1], -1.0)):
        if math.isinf(bound):
            continue
        depth, speed = side * (bound - y), side * yd
        push = stiffness * depth - slope * speed
        active = ca.logic_and(depth - dt * speed > 0, push > 0)
        tau, total = tau + side * ca.if_else(active, push, 0), total + ca.if_else(active, dt * slope, 0)
    return tau, total
