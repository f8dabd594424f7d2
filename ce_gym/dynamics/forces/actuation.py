"""Torques of motors on the independent coordinates, linearly implicit in the step.

Each is `tau - slope @ ydd` with the torque taken one step ahead, exactly as in contact.py; the slope joins `D` of the
cluster. A saturated motor gives a constant torque and has no slope, see saturation.py.

Controllers ask for torques at the joints, or at the motors, see motor_control.py. Torques `tau_m` and speeds `W yd` of
motors belong to rotors, with `W` the rows of the constraint Jacobian, and what they do to the joints is `W^T tau_m`.
Limits and friction there do not depend on the transmission level.

At the elastic level motors turn rotors, and see of the joints what encoders at the rotors tell: where joints would be
if nothing stretched. That is `E [y; x]`, linear in the stretches x, and torques go back by `E^T`, so that implicit
control is symmetric and takes no energy from nowhere.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.electric.cogging import cogging
from ce_gym.dynamics.electric.supply import Supply
from ce_gym.dynamics.forces.dry_friction import STICK_SPEED, dry_friction, rubs
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
from ce_gym.dynamics.parameters import rubbing_as_declared
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.dynamics.state import State
from ce_gym.model.drives import Motor
from ce_gym.model.mechanism import Mechanism


def limit_count(mechanism: Mechanism, options: StepOptions) -> int:
    """Return the size of the iterate of all motors; 0 if no active set depends on accelerations.

    It has the expected torque of each of the joints, of the motors, and of the motors' dry friction if there is any;
    and 1 once there is an iterate. It is needed if there are limits and what they limit, or the limits themselves,
    answers to accelerations.
    """
    robot, model = rubbing_as_declared(mechanism, options.parameters).robot, MOTORS[options.motors]
    motors = robot.motors if model.at_motors or options.control.startswith("motor") else ()
    ends = [model.limits(motor, SX.sym("speed"), SX(1), 1.0) for motor in motors]
    joints = [math.inf if name in robot.passive else robot.body(name).joint.torque for name in robot.independent]
    limited = any(map(math.isfinite, joints)) or any(end is not None for end in ends)
    answering = any(ca.sparsify(slope).nnz() for end in ends if end is not None for _, slope in end)
    asked = options.control.endswith("position") and limited
    rubbing = any(rubs(model.friction(motor)) or model.drive_friction(motor) for motor in motors)
    return len(joints) + (1 + rubbing) * len(motors) + 1 if asked or answering or rubbing else 0


def controller(scene: Scene, y: SX, yd: SX, target: SX, dt: float) -> JointForce:
    """Return what the motors are asked for at the joints: a torque, or a proportional-derivative position control."""
    robot = scene.mechanism.robot
    works = SX(ca.DM([float(name not in robot.passive) for name in robot.commanded]))
    if scene.options.control == "torque":
        return JointForce(works * target, SX(target.shape[0], target.shape[0]))
    kp, damping = works * scene.values["kp"], works * (scene.values["kd"] + dt * scene.values["kp"])
    return JointForce(kp * (target - y) - damping * yd, ca.diag(dt * damping))


def seen_joints(mechanism: Mechanism, kinematics: Kinematics) -> SX:
    """Return the matrix that takes coordinates of joints and stretches to what motors see of the joints.

    Shape (nj, n), the identity if nothing stretches. A motor that sees a stretch would have its joints move to have it
    go away, least squares if there are not as many motors as joints.
    """
    robot = mechanism.robot
    nj, n = len(robot.commanded), len(robot.independent)
    seen = SX.eye(n)[:nj, :]
    for cluster in actuated_clusters(mechanism, kinematics) if n > nj else ():
        d = len(cluster.joints)
        if cluster.rows[d:]:
            seen[cluster.joints, cluster.rows[d:]] = effort_matrix(cluster.W[:, :d]).T @ cluster.W[:, d:]
    return ca.sparsify(seen)


HOLD = 100.0
"""Dry friction of a rotor at rest of which nobody knows yet what it carries [N m]."""
Carried: TypeAlias = Mapping[int, tuple[SX, SX, SX]]
"""Torque of a motor, what all else does to its rotor [N m], and whether both are known, by the places of motors whose
friction goes by them."""


@dataclass
class Before:
    """What motors go by of the step before, by their places.

    Attributes:
        carried: What friction under load goes by.
        windings: Torques at its end [N m], of those that lag.
        supply: Temperatures and voltage at its end.
        held: What a sampled controller holds, as the field `held_torque` is.
    """

    carried: Carried
    windings: Mapping[int, SX]
    supply: Supply
    held: SX

    @staticmethod
    def of(mechanism: Mechanism, options: StepOptions, carried: SX, state: State) -> Before:
        """Return it, given the state before and a column as the field `motor_load` is."""
        robot, model = mechanism.robot, options.motors
        loaded, lagging = loaded_motors(robot, model), lagging_motors(robot, model)
        torques = {place: (carried[i], carried[len(loaded) + i], carried[-1]) for i, place in enumerate(loaded)}
        windings = {place: state["lagging_torque"][i] for i, place in enumerate(lagging)}
        return Before(torques, windings, supply_of(robot, model, state), state["held_torque"])


def motor_forces(
    scene: Scene,
    kinematics: Kinematics,
    asked: JointForce,
    yd: SX,
    dt: float,
    iterate: SX,
    seen: SX,
    before: Before,
) -> SaturatedForce:
    """Return what the motors deliver of what they are asked for at the joints, which they see as `seen` has it."""
    strength = scene.values["motor_strength"]
    at_joints = SaturatedForce(strength * asked.tau, strength * asked.slope, iterate.numel())
    joints = list(range(seen.shape[0]))
    model = MOTORS[scene.options.motors]
    if not model.at_motors:
        return _lifted(within_joint_limits(scene, at_joints, joints, iterate, seen), seen)
    actuated, force = actuated_clusters(scene.mechanism, kinematics), _lifted(at_joints, seen)
    for cluster in actuated:
        rows, to_motors = cluster.joints, effort_matrix(cluster.W[:, : len(cluster.joints)])
        shares = JointForce(to_motors @ at_joints.tau[rows], to_motors @ at_joints.slope[rows, rows] @ to_motors.T)
        deliver(model, force, shares, cluster, yd, strength, dt, iterate, before)
    driven = {row for cluster in actuated for row in cluster.joints}
    left = [row for row in joints if row not in driven]
    return within_joint_limits(scene, force, left, iterate, SX.eye(yd.numel()))


def _lifted(force: SaturatedForce, seen: SX) -> SaturatedForce:
    """Return a force on what motors see of the joints as one on joints and stretches."""
    return replace(force, tau=seen.T @ force.tau, slope=ca.sparsify(seen.T @ force.slope @ seen))


def within_joint_limits(scene: Scene, force: SaturatedForce, rows: list[int], iterate: SX, seen: SX) -> SaturatedForce:
    """Return a force of the motors that the joints `rows` limit, which it acts on by `seen`; it is changed in place."""
    robot, strength = scene.mechanism.robot, scene.values["motor_strength"]
    for row in rows:
        limit = robot.body(robot.independent[row]).joint.torque
        if not (math.isinf(limit) or robot.independent[row] in robot.passive):
            asked, still = JointForce(force.tau[row], force.slope[row, :] @ seen), SX(1, seen.shape[1])
            ends = JointForce(strength * limit, still), JointForce(-strength * limit, still)
            one = force.limited[row] = Saturation.about(iterate, row, asked, *ends)
            force.slope[row, row] = ca.if_else(one.free, force.slope[row, row], 0)
            force.tau[row] = one.given
    force.slope = ca.sparsify(force.slope)
    return force


@dataclass
class Actuated:
    """A cluster with motors at one state.

    Attributes:
        index: Of the cluster.
        rows: Its rows of `y`, d of them.
        joints: Those of them that are no stretches, which come first.
        motors: Its motors.
        places: Where they are among all motors of the robot.
        angles: Of the motors' rotors [rad], shape (n_motors,).
        W: Speeds of the motors for unit velocities of the independent joints, shape (n_motors, d) (footnote on general
            actuation of arXiv:2311.13732); torques of motors go the other way, `tau = W^T tau_m`.
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
    found = []
    clusters = zip(mechanism.tree.clusters, kinematics.rows, kinematics.coordinates, strict=True)
    for k, (cluster, rows, coordinates) in enumerate(clusters):
        places = [i for i, motor in enumerate(mechanism.robot.motors) if motor.rotor in cluster.bodies]
        motors = [mechanism.robot.motors[i] for i in places]
        if motors and coordinates is not None:
            turning = [coordinates.index[motor.rotor] for motor in motors]
            W = ca.sparsify(coordinates.G[turning, :])
            mine = [row - first for row in rows]
            joints = [row for row in mine if row < count]
            found.append(Actuated(k, mine, joints, motors, places, coordinates.q[turning], W))
    return found


def deliver(
    model: MotorModel,
    force: SaturatedForce,
    asked: JointForce,
    cluster: Actuated,
    yd: SX,
    strength: SX,
    dt: float,
    iterate: SX,
    before: Before,
) -> None:
    """Limit the torques that motors of a cluster are asked for, take friction off each, and carry the sum to `force`.

    Args:
        model: Of the motors.
        force: What all motors deliver; the cluster's part is put in.
        asked: Of the motors [N m], shape (n_motors,).
        cluster: The cluster.
        yd: Velocities of all independent joints, shape (nj,).
        strength: Of all motors, as a multiple of what they should have.
        dt: Length of the step [s].
        iterate: From the iteration before, shape (limit_count,).
        before: What motors go by of the step before.
    """
    W, motors, rows = cluster.W, cluster.motors, cluster.rows
    asked = lagged(model, asked, cluster, dt, before)
    speed, tau, slope = W @ yd[rows], SX(asked.tau), asked.slope
    turning = SX(len(motors), yd.numel())
    turning[:, rows] = W
    free, own, windings = SX.eye(len(motors)), SX(len(motors), len(motors)), []
    for i, (motor, place) in enumerate(zip(motors, cluster.places, strict=True)):
        if (limits := model.limits(before.supply.now(place, motor), speed[i], strength, dt)) is not None:
            (high, forwards), (low, backwards) = limits
            ends = (JointForce(high, forwards * turning[i, :]), JointForce(low, backwards * turning[i, :]))
            one = Saturation.about(iterate, yd.numel() + place, JointForce(tau[i], slope[i, :] @ turning), *ends)
            force.limited[yd.numel() + place] = one
            tau[i], free[i, i] = one.given, one.free
            own[i, i] = ca.if_else(one.at_high, forwards, ca.if_else(one.at_low, backwards, 0))
            backwards_on_line = ca.if_else(one.at_low, backwards > 0, 0)
            force.on_line[place] = ca.if_else(one.at_high, forwards > 0, -backwards_on_line)
        windings.append((place, tau[i], own[i, i]))
        if motor.cogging and model.at_motors:
            teeth, stiffness = cogging(motor.cogging, cluster.angles[i], speed[i], dt)
            tau[i] += teeth
            own[i, i] += stiffness
        damping = model.damping(motor, speed[i])
        tau[i] -= damping * speed[i]
        own[i, i] += dt * damping
        drive = model.drive_friction(motor)
        friction = most_friction(model.friction(motor), drive, speed[i], before.carried.get(place, ())[:2])
        if place in before.carried and not is_moment(dt):
            known = ca.logic_or(before.carried[place][2], ca.fabs(speed[i]) > STICK_SPEED)
            friction = ca.if_else(known, friction, HOLD)
        if rubs(friction):
            last = iterate.numel() - 1  # before it, the frictions of all motors, as many as there are before those
            at, way = (last + yd.numel()) // 2 + place, turning[i, :]
            one, rests, stops = dry_friction(friction, speed[i], way, dt, iterate, at, len(rows) == 1)
            force.limited[at] = one
            tau[i] += one.given
            own[i, i] += ca.if_else(one.free, dt * stops, 0)
            sticks = ca.logic_and(one.free, friction > 0) if isinstance(friction, SX) else one.free
            force.frictions.append(Stick(way, sticks, rests))
    answer = free @ slope @ free
    for i, (place, given, at_limit) in enumerate(windings):
        force.windings[place] = JointForce(given, answer[i, :] @ turning + at_limit * turning[i, :])
    force.tau[rows], force.slope[rows, rows] = W.T @ tau, W.T @ (answer + own) @ W


def lagged(model: MotorModel, asked: JointForce, cluster: Actuated, dt: float, before: Before) -> JointForce:
    """Return what motors of a cluster are asked for [N m], of which torques that lag reach a part within the step.

    Where motors answer to each other's speeds the slope between two goes by the geometric mean of their parts, so that
    it stays symmetric; of a cluster's motors with one bandwidth that is what it is.
    """
    parts, tau = SX.ones(len(cluster.motors)), SX(asked.tau)
    for i, (motor, place) in enumerate(zip(cluster.motors, cluster.places, strict=True)):
        if place in before.windings:
            parts[i] = caught_up(model.bandwidth(motor), dt)
            tau[i] = before.windings[place] + parts[i] * (tau[i] - before.windings[place])
    if not before.windings:
        return asked
    root = ca.diag(ca.sqrt(parts))
    return JointForce(tau, root @ asked.slope @ root)


def effort_matrix(W: SX) -> SX:
    """Return the matrix that takes joint torques to motor torques: inverse of `W^T`, least squares if not square."""
    n, d = W.shape
    if n == d:
        return ca.inv(W.T)
    return W @ ca.inv(W.T @ W) if n > d else ca.inv(W @ W.T) @ W
