"""Models of motors, one class each; `MOTORS` names them.

A model says between which limits a motor's torque can be, taken one step ahead, and what the motor takes for itself.
"""

from __future__ import annotations

import math
from typing import Protocol, TypeAlias

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.model.description import Motor

Line: TypeAlias = tuple[SX, SX]
"""A torque [N m] at the present speed, and how it falls with the rotor's acceleration [kg m^2]."""


class MotorModel(Protocol):
    """A model of motors.

    Attributes:
        at_motors: Whether torques that are asked for at joints are shared out to the motors and limited there; if not,
            the joints' own limits hold.
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


class Ideal:
    """Motors that deliver what joints are asked for up to the joints' limits, at any speed and without loss."""

    at_motors = False

    def limits(self, motor: Motor, speed: SX, strength: SX, dt: float) -> tuple[Line, Line] | None:
        """Return the motor's largest torque in both directions."""
        limit = strength * motor.torque
        return ((limit, SX(0)), (-limit, SX(0))) if math.isfinite(motor.torque) else None

    def damping(self, motor: Motor, speed: SX) -> SX:
        """Return none."""
        return SX(0)

    def friction(self, motor: Motor) -> float:
        """Return none."""
        return 0.0


class Limited:
    """Motors as they are: limits of current and voltage, and friction, at their rotors.

    The current allows `torque`; the voltage `stall (1 - speed / velocity)` forwards and `stall (1 + speed / velocity)`
    backwards, the torque-speed line, but never makes a motor brake. A motor on the line is taken along it to the speed
    at the end of the step, or it would overshoot its no-load speed wherever a step is long.
    """

    at_motors = True

    def limits(self, motor: Motor, speed: SX, strength: SX, dt: float) -> tuple[Line, Line] | None:
        """Return the torques that current and voltage allow."""
        if math.isinf(motor.torque) and math.isinf(motor.velocity):
            return None
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

    def damping(self, motor: Motor, speed: SX) -> SX:
        """Return the motor's damping, whatever its speed."""
        return SX(motor.damping)

    def friction(self, motor: Motor) -> float | SX:
        """Return the motor's dry friction."""
        return motor.friction


MOTORS: dict[str, MotorModel] = {"ideal": Ideal(), "limited": Limited()}
"""All models, by the name that `Simulator(motors=...)` takes."""
