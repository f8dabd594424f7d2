"""Forces on the independent coordinates, linearly implicit in the step: motors, damping, joint limits.

Each is `tau - slope @ ydd` with the force taken one step ahead, exactly as in contact.py; the slope joins `D` of the
cluster. A saturated motor gives a constant torque and has no slope. Whether it is saturated depends on the
acceleration, and that on it: an attempt at a step goes by what is asked for at no acceleration, or by what the attempt
before has found, and says afterwards whether that was right (`MotorForce.found`). It matters where links are light:
what is beyond the limit at first may be little by the end of the step, and full torque over a whole step a blow.

Controllers ask for torques at the joints. "Ideal" motors deliver them up to the joints' limits. "Limited" motors are
the ones the robot has: their torques `tau_m` and speeds `W yd` belong to rotors, with `W` the rows of the constraint
Jacobian, and what they do to the joints is `W^T tau_m`. Limits and friction there do not depend on the transmission
level. May know CasADi, descriptions, mechanisms, scenes and kinematics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import Scene, StepOptions
from ce_gym.dynamics.recursion.kinematics import Kinematics
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


@dataclass
class Limited:
    """A torque that is kept within limits, of a joint or of a motor.

    Attributes:
        asked: What is asked for at zero acceleration [N m or N], and how it answers: `tau - slope @ ydd`.
        high, low: Limits likewise; a torque-speed line answers to accelerations too.
        expected: What it is judged by, see `found`.
    """

    asked: JointForce
    high: JointForce
    low: JointForce
    expected: SX

    @staticmethod
    def judged(asked: JointForce, high: JointForce, low: JointForce, hints: SX, place: int) -> Limited:
        """Return a torque as the attempt before has found it, or, if there was none, judged at zero acceleration."""
        one = Limited(asked, high, low, asked.tau)
        return replace(one, expected=ca.if_else(hints[-1] > 0, hints[place], asked.tau)) if one.answers else one

    @property
    def answers(self) -> bool:
        """Whether accelerations have a say in it at all."""
        return any(ca.sparsify(force.slope).nnz() for force in (self.asked, self.high, self.low))

    @property
    def at_high(self) -> SX:
        """1 if it is taken to be at its upper limit, else 0."""
        return self.expected > self.high.tau

    @property
    def at_low(self) -> SX:
        """1 if it is taken to be at its lower limit, else 0."""
        return self.expected < self.low.tau

    @property
    def free(self) -> SX:
        """1 if what is asked for is given, else 0."""
        return ca.logic_not(ca.logic_or(self.at_high, self.at_low))

    @property
    def given(self) -> SX:
        """What is given at zero acceleration [N m or N]."""
        return ca.if_else(self.at_high, self.high.tau, ca.if_else(self.at_low, self.low.tau, self.asked.tau))

    def found(self, ydd: SX) -> Limited:
        """Return it judged by what will be asked for at the end of the step, given the accelerations.

        What is expected then is beyond a limit as far as what is asked for will be. It never goes from beyond one limit
        to beyond the other: what is between has not been tried then.
        """
        asked = self.asked.tau - self.asked.slope @ ydd
        if ca.sparsify(self.high.slope).nnz() or ca.sparsify(self.low.slope).nnz():
            over = asked - (self.high.tau - self.high.slope @ ydd)
            under = self.low.tau - self.low.slope @ ydd - asked
            within = ca.fmax(self.low.tau, ca.fmin(self.high.tau, asked))
            asked = ca.if_else(over > 0, self.high.tau + over, ca.if_else(under > 0, self.low.tau - under, within))
        kept = ca.if_else(self.at_low, ca.fmin(asked, self.high.tau), asked)
        return replace(self, expected=ca.if_else(self.at_high, ca.fmax(asked, self.low.tau), kept))


@dataclass
class MotorForce(JointForce):
    """What motors deliver to the joints.

    Attributes:
        limited: All torques that are kept within limits, at the places of `limit_count`.
    """

    limited: dict[int, Limited]

    def found(self, ydd: SX, n_hints: int) -> tuple[SX, SX]:
        """Return hints for another attempt, and 1 if a torque did not do what it was taken to do, else 0."""
        hints, misjudged = SX(n_hints, 1), SX(0)
        for place, one in self.limited.items():
            if one.answers:
                after = one.found(ydd)
                hints[place] = after.expected
                elsewhere = ca.logic_or(after.at_high != one.at_high, after.at_low != one.at_low)
                misjudged = ca.logic_or(misjudged, elsewhere)
        if n_hints:
            hints[-1] = 1
        return hints, misjudged


def limit_count(mechanism: Mechanism, options: StepOptions) -> int:
    """Return how many torques an attempt may be wrong about: those of all joints, and after them those of all motors.

    Last comes whether there was an attempt before. They have limits, and they or their limits answer to accelerations;
    if there are none of the kind, 0.
    """
    robot = mechanism.robot
    motors = robot.motors if options.motors == "limited" or options.control.startswith("motor") else ()
    joints = [robot.body(name).joint.torque for name in robot.independent]
    asked = options.control.endswith("position") and any(
        map(math.isfinite, (*joints, *(motor.torque for motor in motors)))
    )
    lines = options.motors == "limited" and any(math.isfinite(motor.velocity) for motor in motors)
    return len(joints) + len(motors) + 1 if asked or lines else 0


def controller(scene: Scene, y: SX, yd: SX, target: SX, dt: float) -> JointForce:
    """Return what the motors are asked for at the joints: a torque, or a proportional-derivative position control."""
    if scene.options.control == "torque":
        return JointForce(target, SX(target.shape[0], target.shape[0]))
    damping = scene.figures.kd + dt * scene.figures.kp
    return JointForce(scene.figures.kp * (target - y) - damping * yd, ca.diag(dt * damping))


def motor_forces(scene: Scene, kinematics: Kinematics, asked: JointForce, yd: SX, dt: float, hints: SX) -> MotorForce:
    """Return what the motors deliver of the torques they are asked for."""
    strength = scene.figures.strength
    force = MotorForce(strength * asked.tau, strength * asked.slope, {})
    actuated = actuated_clusters(scene.mechanism, kinematics) if scene.options.motors == "limited" else []
    for cluster in actuated:
        rows, to_motors = cluster.rows, _effort_matrix(cluster.W)
        shares = JointForce(to_motors @ force.tau[rows], to_motors @ force.slope[rows, rows] @ to_motors.T)
        deliver(force, shares, cluster, yd, strength, dt, hints)
    driven = {row for cluster in actuated for row in cluster.rows}
    return within_joint_limits(scene, force, [row for row in range(yd.numel()) if row not in driven], hints)


def within_joint_limits(scene: Scene, force: MotorForce, rows: list[int], hints: SX) -> MotorForce:
    """Return a force of the motors that the joints `rows` limit; it is changed in place."""
    robot, strength = scene.mechanism.robot, scene.figures.strength
    for row in rows:
        limit = robot.body(robot.independent[row]).joint.torque
        if not math.isinf(limit):
            asked, still = JointForce(force.tau[row], force.slope[row, :]), SX(1, force.tau.numel())
            ends = JointForce(strength * limit, still), JointForce(-strength * limit, still)
            one = force.limited[row] = Limited.judged(asked, *ends, hints, row)
            force.slope[row, row] = ca.if_else(one.free, force.slope[row, row], 0)
            force.tau[row] = one.given
    force.slope = ca.sparsify(force.slope)
    return force


@dataclass
class Actuated:
    """A cluster with motors at one state.

    Attributes:
        rows: Its rows of `y`, d of them.
        motors: Its motors.
        places: Where they are among all motors of the robot.
        angles: Of the motors' rotors [rad], shape (n_motors,).
        W: Speeds of the motors for unit velocities of the independent joints, shape (n_motors, d) (footnote on general
            actuation of arXiv:2311.13732); torques of motors go the other way, `tau = W^T tau_m`.
    """

    rows: list[int]
    motors: list[Motor]
    places: list[int]
    angles: SX
    W: SX


def actuated_clusters(mechanism: Mechanism, kinematics: Kinematics) -> list[Actuated]:
    """Return the clusters with motors."""
    first = 6 if mechanism.robot.floating else 0
    found = []
    for cluster, rows, coordinates in zip(
        mechanism.tree.clusters, kinematics.rows, kinematics.coordinates, strict=True
    ):
        places = [i for i, motor in enumerate(mechanism.robot.motors) if motor.rotor in cluster.bodies]
        motors = [mechanism.robot.motors[i] for i in places]
        if motors and coordinates is not None:
            turning = [coordinates.index[motor.rotor] for motor in motors]
            W = ca.sparsify(coordinates.G[turning, :])
            found.append(Actuated([row - first for row in rows], motors, places, coordinates.q[turning], W))
    return found


def deliver(
    force: MotorForce, asked: JointForce, cluster: Actuated, yd: SX, strength: SX, dt: float, hints: SX
) -> None:
    """Limit the torques that motors of a cluster are asked for, take friction off each, and carry the sum to `force`.

    Args:
        force: What all motors deliver; the cluster's part is put in.
        asked: Of the motors [N m], shape (n_motors,).
        cluster: The cluster.
        yd: Velocities of all independent joints, shape (nj,).
        strength: Of all motors, as a multiple of what they should have.
        dt: Length of the step [s].
        hints: What the attempt before has found, shape (limit_count,).
    """
    W, motors, rows = cluster.W, cluster.motors, cluster.rows
    speed, tau, slope = W @ yd[rows], SX(asked.tau), asked.slope
    turning = SX(len(motors), yd.numel())
    turning[:, rows] = W
    free, own = SX.eye(len(motors)), SX(len(motors), len(motors))
    for i, motor in enumerate(motors):
        if math.isfinite(motor.torque) or math.isfinite(motor.velocity):
            place = yd.numel() + cluster.places[i]
            (high, forwards), (low, backwards) = _limits(motor, speed[i], strength, dt)
            ends = (JointForce(high, forwards * turning[i, :]), JointForce(low, backwards * turning[i, :]))
            one = Limited.judged(JointForce(tau[i], slope[i, :] @ turning), *ends, hints, place)
            force.limited[place] = one
            tau[i], free[i, i] = one.given, one.free
            own[i, i] = ca.if_else(one.at_high, forwards, ca.if_else(one.at_low, backwards, 0))
        drag = motor.damping + (motor.friction / ca.sqrt(speed[i] ** 2 + COULOMB_SPEED**2) if motor.friction else 0)
        tau[i] -= drag * speed[i]
        own[i, i] += dt * drag
    force.tau[rows], force.slope[rows, rows] = W.T @ tau, W.T @ (free @ slope @ free + own) @ W


def _effort_matrix(W: SX) -> SX:
    """Return the matrix that takes joint torques to motor torques: inverse of `W^T`, least squares if not square."""
    n, d = W.shape
    if n == d:
        return ca.inv(W.T)
    return W @ ca.inv(W.T @ W) if n > d else ca.inv(W @ W.T) @ W


def _limits(motor: Motor, speed: SX, strength: SX, dt: float) -> tuple[tuple[SX, SX], tuple[SX, SX]]:
    """Return the largest and the smallest torque of a motor [N m], and how each falls with acceleration [kg m^2].

    The current allows `torque`; the voltage `stall (1 - speed / velocity)` forwards and `stall (1 + speed / velocity)`
    backwards, the torque-speed line, but never makes a motor brake. A motor on the line is taken along it to the speed
    at the end of the step, or it would overshoot its no-load speed wherever a step is long.
    """
    limit = strength * motor.torque if math.isfinite(motor.torque) else SX(math.inf)
    stall = strength * (motor.torque if motor.stall is None else motor.stall)
    if math.isinf(motor.velocity) or math.isinf(motor.torque if motor.stall is None else motor.stall):
        return (limit, SX(0)), (-limit, SX(0))
    ends = []
    for side in (1, -1):
        line = stall * (1 - side * speed / motor.velocity)
        on_line = ca.logic_and(line > 0, line <= limit)
        ends.append((side * ca.fmax(0, ca.fmin(limit, line)), ca.if_else(on_line, dt * stall / motor.velocity, 0)))
    return ends[0], ends[1]


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
