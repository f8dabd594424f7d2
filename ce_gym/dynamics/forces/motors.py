"""Models of motors, one class each; `MOTORS` names them.

A model has the limits of a motor's torque, taken one step ahead, and the losses of the motor.
"""

from __future__ import annotations

import math
from typing import Protocol, TypeAlias

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.supply import Supply
from ce_gym.dynamics.state import State
from ce_gym.model.description import Robot
from ce_gym.model.drives import DriveFriction, Motor

Line: TypeAlias = tuple[SX, SX]
"""A torque [N m] at the present speed, and how it falls with the rotor's acceleration [kg m^2]."""
STILL = 1e-30
"""Of the Stribeck speed, where a power below 1 is cut off: at rest its derivative is infinite, and gradients NaN."""


class MotorModel(Protocol):
    """A model of motors.

    Attributes:
        at_motors: Whether torques commanded at joints are distributed to the motors and limited there; if not, the
            limits of the joints hold.
    """

    at_motors: bool

    def limits(self, motor: Motor, speed: SX, strength: SX, dt: float) -> tuple[Line, Line] | None:
        """Return the largest and the smallest torque of a motor whose rotor has a speed [rad/s]; None for no limits."""
        ...

    def damping(self, motor: Motor, speed: SX) -> SX:
        """Return the viscous damping of a motor [N m s/rad]."""
        ...

    def friction(self, motor: Motor) -> float | SX:
        """Return the dry friction of a motor [N m]; the number 0 if it has none."""
        ...

    def drive_friction(self, motor: Motor) -> DriveFriction | None:
        """Return the friction that a motor has at rest and under load besides; None if it has none."""
        ...

    def bandwidth(self, motor: Motor) -> float:
        """Return the bandwidth of its torque loop [Hz]; infinite if its torque follows the command at once."""
        ...


class Ideal:
    """Motors without loss that give the commanded torque up to the limits of the joints, at any speed."""

    at_motors = False

    def limits(self, motor: Motor, speed: SX, strength: SX, dt: float) -> tuple[Line, Line] | None:
        """Return the motor's largest torque in both directions."""
        limit = strength * motor.torque
        return ((limit, SX(0)), (-limit, SX(0))) if math.isfinite(motor.torque) else None

    def damping(self, motor: Motor, speed: SX) -> SX:
        """Return no damping."""
        return SX(0)

    def friction(self, motor: Motor) -> float:
        """Return no friction."""
        return 0.0

    def drive_friction(self, motor: Motor) -> None:
        """Return no friction."""
        return None

    def bandwidth(self, motor: Motor) -> float:
        """Return an infinite bandwidth."""
        return math.inf


class Limited:
    """Motors with limits of current and voltage, and friction, at their rotors.

    The current allows `torque`; the voltage `stall (1 - speed / velocity)` forwards and `stall (1 + speed / velocity)`
    backwards, the torque-speed line, but never makes a motor brake. A motor on the line is taken along it to the speed
    at the end of the step, or it would overshoot its no-load speed wherever a step is long.
    """

    at_motors = True

    def limits(self, motor: Motor, speed: SX, strength: SX, dt: float) -> tuple[Line, Line] | None:
        """Return the torques that current and voltage allow."""
        if _endless(motor.torque) and _endless(motor.velocity):
            return None
        limit = SX(math.inf) if _endless(motor.torque) else strength * motor.torque
        stall = strength * motor.line
        if _endless(motor.velocity) or _endless(motor.line):
            return (limit, SX(0)), (-limit, SX(0))
        ends = []
        for side in (1, -1):
            line = stall * (1 - side * speed / motor.velocity)
            on_line = ca.logic_and(line > 0, line <= limit)
            ends.append((side * ca.fmax(0, ca.fmin(limit, line)), ca.if_else(on_line, dt * stall / motor.velocity, 0)))
        return ends[0], ends[1]

    def damping(self, motor: Motor, speed: SX) -> SX:
        """Return the motor's damping, whatever its speed."""
        return SX(motor.damping)

    def friction(self, motor: Motor) -> float | SX:
        """Return the motor's dry friction."""
        return motor.friction

    def drive_friction(self, motor: Motor) -> DriveFriction | None:
        """Return the friction of the motor's description."""
        return motor.drive_friction

    def bandwidth(self, motor: Motor) -> float:
        """Return the bandwidth of the motor's description."""
        return motor.bandwidth


MOTORS: dict[str, MotorModel] = {"ideal": Ideal(), "limited": Limited()}
"""All models, by the name that `Simulator(motors=...)` takes."""


def _endless(figure: float | SX) -> bool:
    return not isinstance(figure, SX) and math.isinf(figure)


def warm_motors(robot: Robot, model: str) -> list[int]:
    """Return the places of the motors that grow warm, by the name of the model of the motors."""
    return [i for i, motor in enumerate(robot.motors) if motor.heat is not None and MOTORS[model].at_motors]


def supply_of(robot: Robot, model: str, state: State) -> Supply:
    """Return temperatures and voltage in a state, given the name of the model of the motors."""
    warm, warmth = warm_motors(robot, model), state["motor_warmth"]
    windings = {place: warmth[i] for i, place in enumerate(warm)}
    housings = {place: warmth[len(warm) + i] for i, place in enumerate(warm)}
    battery = robot.battery if MOTORS[model].at_motors else None
    return Supply(windings, housings, battery, SX(0) if battery is None else state["battery_sag"])


def loaded_motors(robot: Robot, model: str) -> list[int]:
    """Return the places of the motors whose friction depends on torques, by the name of the model of the motors."""
    frictions = [MOTORS[model].drive_friction(motor) for motor in robot.motors]
    return [i for i, friction in enumerate(frictions) if friction is not None and friction.loaded]


def lagging_motors(robot: Robot, model: str) -> list[int]:
    """Return the places of the motors whose torque lags, by the name of the model of the motors."""
    return [i for i, motor in enumerate(robot.motors) if math.isfinite(MOTORS[model].bandwidth(motor))]


def caught_up(bandwidth: float, dt: float) -> SX:
    """Return the share of the way to the commanded torque that a torque covers in a step, taken one step ahead."""
    return SX(dt / (1 / (2 * math.pi * bandwidth) + dt))


def most_friction(constant: float | SX, drive: DriveFriction | None, speed: SX, load: tuple[SX, ...]) -> float | SX:
    """Return the largest dry friction of a motor [N m], see `DriveFriction`.

    Args:
        constant: Friction at any speed and load [N m].
        drive: Friction at rest and under load.
        speed: Of the rotor [rad/s].
        load: Torque of the motor and torque of all else on the rotor [N m]; empty if no friction depends on them.
    """
    if drive is None:
        return constant
    total, at_rest = SX(0), SX(drive.stribeck)
    if load:
        motor, external = load
        total += ca.fabs(drive.load_motor * motor - drive.load_external * external)
        at_rest += ca.fabs(drive.stribeck_load_motor * motor - drive.stribeck_load_external * external)
        losses = 1 / drive.efficiency - 1, 1 - drive.backdriving_efficiency
        total += _by_direction(motor, external, *[loss * ca.fabs(external) for loss in losses])
        squares = drive.stribeck_square_external * external**2, drive.stribeck_square_motor * motor**2
        at_rest += _by_direction(motor, external, *squares)
    if ca.sparsify(at_rest).nnz():
        share = ca.fabs(speed) / drive.stribeck_speed
        if drive.stribeck_exponent < 1:
            share = ca.fmax(share, STILL)
        total += at_rest * ca.exp(-(share**drive.stribeck_exponent))
    return constant + drive.factor * total


def _by_direction(motor: SX, external: SX, driving: SX, driven: SX) -> SX:
    """Return `driving` where a motor drives a load, `driven` where the load drives it back, else 0."""
    if not ca.sparsify(ca.vertcat(driving, driven)).nnz():
        return SX(0)
    ahead = ca.fabs(motor) - ca.fabs(external)
    return ca.if_else(motor * external <= 0, ca.if_else(ahead > 0, driving, ca.if_else(ahead < 0, driven, 0)), 0)
