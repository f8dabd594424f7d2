"""Checks of declared parameters without effect on a robot, at a transmission level or in a scene."""

from __future__ import annotations

from ce_gym.dynamics.forces.motors import MOTORS
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.model.description import Robot
from ce_gym.model.drives import ELASTIC_FACTORS
from ce_gym.model.mechanism import ELASTIC, Mechanism

OF_CONTACTS = "friction", "slip_speed", "stiffness", "damping"
OF_LIMITED = "motor_damping", "motor_friction", "drive_friction", "cogging", "ambient"
OF_BATTERY = "battery_voltage", "battery_resistance"


def check_effects(mechanism: Mechanism, options: StepOptions) -> None:
    """Check that every declared parameter has an effect.

    Raises:
        ValueError: A parameter has no effect; one line.
    """
    for name in options.parameters:
        if expected := _missing(mechanism, options, *name.partition(":")[::2]):
            raise ValueError(f"parameter {name!r} has no effect on {mechanism.robot.name}; expected {expected}")


def _missing(mechanism: Mechanism, options: StepOptions, kind: str, owner: str) -> str:
    """Return the missing requirement of a parameter; "" if the parameter has an effect."""
    robot, limited = mechanism.robot, MOTORS[options.motors].at_motors
    if kind in OF_CONTACTS and not (options.contacts or options.self_collisions):
        return "contacts"
    if kind in ("kp", "kd") and not options.control.endswith("position"):
        return f"position control, here control={options.control!r}"
    if kind in ("rotor_inertia", "ratio"):
        if not any(robot.rotors()):
            return "rotors"
        at_rotors = kind == "ratio" and (limited or options.control.startswith("motor"))
        if mechanism.level == "none" and not at_rotors:
            return "a transmission level that keeps the spin of rotors, not 'none'"
    if kind in ELASTIC_FACTORS:
        figure = kind.removeprefix("drive_")
        if mechanism.level != ELASTIC:
            return f"transmission {ELASTIC!r}, here {mechanism.level!r}"
        if not any(getattr(elastic, figure) for elastic in robot.elastic if owner in ("", elastic.rotor)):
            return f"a {figure} that is not 0"
    if kind in OF_LIMITED + OF_BATTERY and not limited:
        return f"motors='limited', here {options.motors!r}"
    return _missing_in_motors(robot, kind)


def _missing_in_motors(robot: Robot, kind: str) -> str:
    needed = {"drive_friction": "drive_friction", "cogging": "cogging", "ambient": "heat"}
    if kind in needed and not any(getattr(motor, needed[kind]) for motor in robot.motors):
        return f"motors with {needed[kind].replace('_', ' ')} in the robot's file"
    if kind in OF_LIMITED and not robot.motors:
        return "motors"
    return "a battery in the robot's file" if kind in OF_BATTERY and robot.battery is None else ""
