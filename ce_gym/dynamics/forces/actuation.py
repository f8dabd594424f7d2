"""Torques of motors on the independent coordinates, linearly implicit in the step.

A torque is `tau - slope @ ydd`, taken one step ahead as the forces in contact.py are; the slope joins `D` of the
cluster. A saturated motor gives a constant torque and has no slope, see saturation.py.

Controllers command torques at the joints or at the motors, see motor_control.py. With `W` the rows of the constraint
Jacobian that belong to rotors, rotors turn at `W yd`, and motor torques act on the joints as `W^T tau_m`. Limits and
friction at the rotors do not depend on the transmission level.

At the elastic level a controller knows the joints only through the encoders of the motors. They report where the joints
would be if nothing stretched, `E [y; x]`, linear in the stretches x. Torques act by `E^T`, so that implicit control is
symmetric and gains no energy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.cogging import cogging
from ce_gym.dynamics.forces.dry_friction import STICK_SPEED, dry_friction, has_dry_friction
from ce_gym.dynamics.forces.linear import JointForce, is_moment
from ce_gym.dynamics.forces.motors import (
    MOTORS,
    MotorModel,
    caught_up,
    lagging_motors,
    loaded_motors,
    most_friction,
    supply_of,
)
from ce_gym.dynamics.forces.saturation import SaturatedForce, Saturation, Stick
from ce_gym.dynamics.forces.scene import Scene, StepOptions
from ce_gym.dynamics.forces.supply import Supply
from ce_gym.dynamics.parameters import with_declared_friction
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.dynamics.state import State
from ce_gym.model.drives import Motor
from ce_gym.model.mechanism import Mechanism


def limit_count(mechanism: Mechanism, options: StepOptions) -> int:
    """Return the size of the iterate of all motors; 0 if no active set depends on accelerations.

    The iterate has the expected torques of the joints, of the motors, and of the motors' dry friction if there is any;
    and 1 once there is an iterate.
    """
    robot, model = with_declared_friction(mechanism, options.parameters).robot, MOTORS[options.motors]
    motors = robot.motors if model.at_motors or options.control.startswith("motor") else ()
    ends = [model.limits(motor, SX.sym("speed"), SX(1), 1.0) for motor in motors]
    joints = [math.inf if name in robot.passive else robot.body(name).joint.torque for name in robot.independent]
    limited = any(map(math.isfinite, joints)) or any(end is not None for end in ends)
    falling = any(ca.sparsify(slope).nnz() for end in ends if end is not None for _, slope in end)
    implicit = options.control.endswith("position") and limited
    rubbing = any(has_dry_friction(model.friction(motor)) or model.drive_friction(motor) for motor in motors)
    return len(joints) + (1 + rubbing) * len(motors) + 1 if implicit or falling or rubbing else 0


def joint_command(scene: Scene, y: SX, yd: SX, target: SX, dt: float) -> JointForce:
    """Return the torque commanded at the joints: the target, or a control's of position or velocity.

    Position control has the torque `kp (target - y) - kd yd`, velocity control `kd (target - yd)`, both at the end of
    the step `dt`.
    """
    robot = scene.mechanism.robot
    works = SX(ca.DM([float(name not in robot.passive) for name in robot.commanded]))
    if scene.options.control == "torque":
        return JointForce(works * target, SX(target.shape[0], target.shape[0]))
    if scene.options.joint_control:
        return _mixed_command(scene, y, yd, target, dt)
    kp, damping = works * scene.values["kp"], works * (scene.values["kd"] + dt * scene.values["kp"])
    return JointForce(kp * (target - y) - damping * yd, ca.diag(dt * damping))


def _mixed_command(scene: Scene, y: SX, yd: SX, target: SX, dt: float) -> JointForce:
    """Return the torque commanded at the joints where the kind of control differs from joint to joint."""
    robot, kinds, n = scene.mechanism.robot, dict(scene.options.joint_control), target.numel()
    tau, slope = SX.zeros(n), SX(n, n)
    for i, name in enumerate(robot.commanded):
        kind, kp, kd = kinds.get(name, "position"), scene.values["kp"][i], scene.values["kd"][i]
        if name in robot.passive:
            continue
        if kind == "torque":
            tau[i] = target[i]
        elif kind == "velocity":
            tau[i], slope[i, i] = kd * (target[i] - yd[i]), dt * kd
        else:
            tau[i], slope[i, i] = kp * (target[i] - y[i]) - (kd + dt * kp) * yd[i], dt * (kd + dt * kp)
    return JointForce(tau, slope)


def encoder_map(mechanism: Mechanism, kinematics: Kinematics) -> SX:
    """Return the matrix from coordinates of joints and stretches to joint positions as the motors' encoders report.

    Shape (nj, n), the identity if nothing stretches. A cluster with fewer or more motors than joints reports the least
    squares solution.
    """
    robot = mechanism.robot
    nj, n = len(robot.commanded), len(robot.independent)
    reported = SX.eye(n)[:nj, :]
    for cluster in actuated_clusters(mechanism, kinematics) if n > nj else ():
        d = len(cluster.joints)
        if cluster.rows[d:]:
            reported[cluster.joints, cluster.rows[d:]] = effort_matrix(cluster.W[:, :d]).T @ cluster.W[:, d:]
    return ca.sparsify(reported)


HOLD = 100.0
"""Dry friction of a rotor at rest whose load is not known yet [N m]."""


@dataclass
class MotorState:
    """The memory of the motors at the start of a step, by their places among all motors.

    Attributes:
        load: For each motor with load-dependent friction its torque [N m], the torque of all else on its rotor [N m],
            and whether both are known.
        windings: Torques at the end of the last step of motors whose torque lags [N m].
        supply: Temperatures and voltage.
        held: The field `held_torque`.
    """

    load: Mapping[int, tuple[SX, SX, SX]]
    windings: Mapping[int, SX]
    supply: Supply
    held: SX

    @staticmethod
    def of(mechanism: Mechanism, options: StepOptions, load: SX, state: State) -> MotorState:
        """Return the memory in a state, with a column for the field `motor_load`."""
        robot, model = mechanism.robot, options.motors
        loaded, lagging = loaded_motors(robot, model), lagging_motors(robot, model)
        loads = {place: (load[i], load[len(loaded) + i], load[-1]) for i, place in enumerate(loaded)}
        windings = {place: state["lagging_torque"][i] for i, place in enumerate(lagging)}
        return MotorState(loads, windings, supply_of(robot, model, state), state["held_torque"])


def torques_of_joint_command(
    scene: Scene,
    kinematics: Kinematics,
    command: JointForce,
    yd: SX,
    dt: float,
    iterate: SX,
    encoders: SX,
    memory: MotorState,
) -> SaturatedForce:
    """Return the torques that motors give for a command at the joints, which act by the matrix `encoders`."""
    strength = scene.values["motor_strength"]
    at_joints = SaturatedForce(strength * command.tau, strength * command.slope, iterate.numel())
    joints = list(range(encoders.shape[0]))
    model = MOTORS[scene.options.motors]
    if not model.at_motors:
        return _on_coordinates(within_joint_limits(scene, at_joints, joints, iterate, encoders), encoders)
    actuated, force = actuated_clusters(scene.mechanism, kinematics), _on_coordinates(at_joints, encoders)
    for cluster in actuated:
        rows, to_motors = cluster.joints, effort_matrix(cluster.W[:, : len(cluster.joints)])
        shares = JointForce(to_motors @ at_joints.tau[rows], to_motors @ at_joints.slope[rows, rows] @ to_motors.T)
        add_motor_torques(model, force, shares, cluster, yd, strength, dt, iterate, memory)
    driven = {row for cluster in actuated for row in cluster.joints}
    undriven = [row for row in joints if row not in driven]
    return within_joint_limits(scene, force, undriven, iterate, SX.eye(yd.numel()))


def _on_coordinates(force: SaturatedForce, encoders: SX) -> SaturatedForce:
    """Return a force on the joints that encoders report as a force on joints and stretches."""
    return replace(force, tau=encoders.T @ force.tau, slope=ca.sparsify(encoders.T @ force.slope @ encoders))


def within_joint_limits(
    scene: Scene, force: SaturatedForce, rows: list[int], iterate: SX, encoders: SX
) -> SaturatedForce:
    """Limit the torques of the joints `rows`, in place, which act by the matrix `encoders`; return the force."""
    robot, strength = scene.mechanism.robot, scene.values["motor_strength"]
    for row in rows:
        limit = robot.body(robot.independent[row]).joint.torque
        if not (math.isinf(limit) or robot.independent[row] in robot.passive):
            command, still = JointForce(force.tau[row], force.slope[row, :] @ encoders), SX(1, encoders.shape[1])
            ends = JointForce(strength * limit, still), JointForce(-strength * limit, still)
            limited = force.limited[row] = Saturation.about(iterate, row, command, *ends)
            force.slope[row, row] = ca.if_else(limited.free, force.slope[row, row], 0)
            force.tau[row] = limited.given
    force.slope = ca.sparsify(force.slope)
    return force


@dataclass
class Actuated:
    """A cluster with motors at one state.

    Attributes:
        index: Of the cluster.
        rows: Rows of `y` that belong to the cluster, d rows.
        joints: The rows among them that are joints, which come before stretches.
        motors: Motors of the cluster.
        places: Places of these motors among all motors of the robot.
        angles: Of the motors' rotors [rad], shape (n_motors,).
        W: Speeds of the motors for unit velocities of the independent joints, shape (n_motors, d) (footnote on general
            actuation of arXiv:2311.13732).
    """

    index: int
    rows: list[int]
    joints: list[int]
    motors: list[Motor]
    places: list[int]
    angles: SX
    W: SX


def actuated_clusters(mechanism: Mechanism, kinematics: Kinematics) -> list[Actuated]:
    """Return the clusters with motors."""
    first, count = mechanism.robot.layout.joints_v, len(mechanism.robot.commanded)
    actuated = []
    clusters = zip(mechanism.tree.clusters, kinematics.rows, kinematics.coordinates, strict=True)
    for k, (cluster, rows_of_v, coordinates) in enumerate(clusters):
        places = [i for i, motor in enumerate(mechanism.robot.motors) if motor.rotor in cluster.bodies]
        motors = [mechanism.robot.motors[i] for i in places]
        if motors and coordinates is not None:
            rotors = [coordinates.index[motor.rotor] for motor in motors]
            W = ca.sparsify(coordinates.G[rotors, :])
            rows = [row - first for row in rows_of_v]
            joints = [row for row in rows if row < count]
            actuated.append(Actuated(k, rows, joints, motors, places, coordinates.q[rotors], W))
    return actuated


@dataclass
class MotorAxis:
    """The torque of one motor on its rotor, while limits and losses are applied one after the other.

    Attributes:
        motor: The motor, with the limits that temperature and voltage leave it.
        place: Of the motor among all motors.
        angle: Of the rotor [rad].
        speed: Of the rotor [rad/s].
        direction: Speed of the rotor for unit velocities of all independent joints, shape (1, nj).
        torque: At zero acceleration [N m].
        slope: By how much limits, cogging and losses fall with the rotor's acceleration [kg m^2].
        free: 1 if the commanded torque is within the limits, else 0.
    """

    motor: Motor
    place: int
    angle: SX
    speed: SX
    direction: SX
    torque: SX
    slope: SX
    free: SX


def add_motor_torques(
    model: MotorModel,
    force: SaturatedForce,
    command: JointForce,
    cluster: Actuated,
    yd: SX,
    strength: SX,
    dt: float,
    iterate: SX,
    memory: MotorState,
) -> None:
    """Limit the commanded torques of a cluster's motors, subtract losses, and add the torques on the joints to `force`.

    Args:
        model: Of the motors.
        force: Torques of all motors on the joints; changed in place.
        command: Of the cluster's motors [N m], shape (n_motors,).
        cluster: The cluster.
        yd: Velocities of all independent joints, shape (nj,).
        strength: Factor on the torques of all motors [-].
        dt: Length of the step [s].
        iterate: Of the iteration before, shape (limit_count,).
        memory: Of the motors.
    """
    command = lagging_command(model, command, cluster, dt, memory)
    speeds, slope = cluster.W @ yd[cluster.rows], command.slope
    directions = SX(len(cluster.motors), yd.numel())
    directions[:, cluster.rows] = cluster.W
    axes, windings = [], []
    for i, (motor, place) in enumerate(zip(cluster.motors, cluster.places, strict=True)):
        fed = memory.supply.now(place, motor)
        of_axis = cluster.angles[i], speeds[i], directions[i, :]
        axis = MotorAxis(fed, place, *of_axis, torque=command.tau[i], slope=SX(0), free=SX(1))
        limit_torque(axis, model, slope[i, :] @ directions, strength, dt, iterate, force)
        windings.append((axis.torque, axis.slope))
        if motor.cogging and model.at_motors:
            torque, stiffness = cogging(motor.cogging, axis.angle, axis.speed, dt)
            axis.torque += torque
            axis.slope += stiffness
        damping = model.damping(motor, axis.speed)
        axis.torque -= damping * axis.speed
        axis.slope += dt * damping
        add_dry_friction(axis, model, motor, dt, iterate, memory, len(cluster.rows) == 1, force)
        axes.append(axis)
    free = ca.diag(ca.vertcat(*[axis.free for axis in axes]))
    commanded = free @ slope @ free
    for i, (torque, at_limit) in enumerate(windings):
        force.windings[axes[i].place] = JointForce(torque, commanded[i, :] @ directions + at_limit * directions[i, :])
    total = commanded + ca.diag(ca.vertcat(*[axis.slope for axis in axes]))
    rows, W = cluster.rows, cluster.W
    force.tau[rows] = W.T @ ca.vertcat(*[axis.torque for axis in axes])
    force.slope[rows, rows] = W.T @ total @ W


def limit_torque(
    axis: MotorAxis, model: MotorModel, slope: SX, strength: SX, dt: float, iterate: SX, force: SaturatedForce
) -> None:
    """Keep the torque of a motor within its limits, in place.

    Args:
        axis: The motor.
        model: Of the motors.
        slope: By how much the command falls with the accelerations of the independent joints, shape (1, nj).
        strength: Factor on the torques of all motors [-].
        dt: Length of the step [s].
        iterate: Of the iteration before.
        force: Receives the limits of the motor.
    """
    limits = model.limits(axis.motor, axis.speed, strength, dt)
    if limits is None:
        return
    (high, forwards), (low, backwards) = limits
    ends = JointForce(high, forwards * axis.direction), JointForce(low, backwards * axis.direction)
    at = axis.direction.numel() + axis.place
    limited = force.limited[at] = Saturation.about(iterate, at, JointForce(axis.torque, slope), *ends)
    axis.torque, axis.free = limited.given, limited.free
    axis.slope = ca.if_else(limited.at_high, forwards, ca.if_else(limited.at_low, backwards, 0))
    backwards_on_line = ca.if_else(limited.at_low, backwards > 0, 0)
    force.on_line[axis.place] = ca.if_else(limited.at_high, forwards > 0, -backwards_on_line)


def add_dry_friction(
    axis: MotorAxis,
    model: MotorModel,
    motor: Motor,
    dt: float,
    iterate: SX,
    memory: MotorState,
    alone: bool,
    force: SaturatedForce,
) -> None:
    """Add the dry friction of a rotor to its torque, in place.

    Args:
        axis: The motor.
        model: Of the motors.
        motor: The motor as its description has it.
        dt: Length of the step [s].
        iterate: Of the iteration before.
        memory: Of the motors.
        alone: Whether the cluster has one degree of freedom.
        force: Receives the limits of the friction.
    """
    load = memory.load.get(axis.place, ())
    friction = most_friction(model.friction(motor), model.drive_friction(motor), axis.speed, load[:2])
    if load and not is_moment(dt):
        known = ca.logic_or(load[2], ca.fabs(axis.speed) > STICK_SPEED)
        friction = ca.if_else(known, friction, HOLD)
    if not has_dry_friction(friction):
        return
    before_last = iterate.numel() - 1  # joints, motors, then the frictions of all motors
    at = (before_last + axis.direction.numel()) // 2 + axis.place
    limited, rests, damping = dry_friction(friction, axis.speed, axis.direction, dt, iterate, at, alone)
    force.limited[at] = limited
    axis.torque += limited.given
    axis.slope += ca.if_else(limited.free, dt * damping, 0)
    sticks = ca.logic_and(limited.free, friction > 0) if isinstance(friction, SX) else limited.free
    force.frictions.append(Stick(axis.direction, sticks, rests))


def lagging_command(
    model: MotorModel, command: JointForce, cluster: Actuated, dt: float, memory: MotorState
) -> JointForce:
    """Return the torques that motors of a cluster reach within the step of those commanded [N m].

    Where the commands of two motors depend on each other's speeds, the slope between them is scaled by the geometric
    mean of both shares, so that it stays symmetric.
    """
    shares, tau = SX.ones(len(cluster.motors)), SX(command.tau)
    for i, (motor, place) in enumerate(zip(cluster.motors, cluster.places, strict=True)):
        if place in memory.windings:
            shares[i] = caught_up(model.bandwidth(motor), dt)
            tau[i] = memory.windings[place] + shares[i] * (tau[i] - memory.windings[place])
    if not memory.windings:
        return command
    root = ca.diag(ca.sqrt(shares))
    return JointForce(tau, root @ command.slope @ root)


def effort_matrix(W: SX) -> SX:
    """Return the matrix from joint torques to motor torques: the inverse of `W^T`, least squares if not square."""
    n, d = W.shape
    if n == d:
        return ca.inv(W.T)
    return W @ ca.inv(W.T @ W) if n > d else ca.inv(W @ W.T) @ W
