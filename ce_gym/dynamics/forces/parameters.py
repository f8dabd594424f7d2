"""Figures of a scene that may differ from robot to robot: constants folded into the code, or inputs when declared."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.algebra.spatial import SX, skew
from ce_gym.dynamics.forces.contact import Compliance
from ce_gym.dynamics.recursion.kinematics import constant
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import ContactMaterial, Robot
from ce_gym.model.drives import ELASTIC_FACTORS, Battery, Elasticity, Motor
from ce_gym.model.errors import check_names
from ce_gym.model.mechanism import Mechanism, MovingBody, Spin, smallest_spin_factor, spin_inertia

PARAMETERS = {
    "gravity": "acceleration of free fall in the world [m/s^2], 3",
    "friction": "Coulomb coefficient of the contacts [-], 1",
    "slip_speed": "speed at which the damping of friction alone carries its full force [m/s], 1",
    "stiffness": "normal stiffness of the contacts [N/m], 1",
    "damping": "normal damping of the contacts under Kelvin and Voigt's law [N s/m], 1",
    "kp": "position gains of the joints [N m/rad or N/m], n_joints",
    "kd": "velocity gains of the joints [N m s/rad or N s/m], n_joints",
    "motor_strength": "factor on motor torques and their limits [-], 1",
    "rotor_inertia": "factor on the spin inertia of rotors [-], 1",
    "rotor_inertia:ROTOR": "the same of one rotor [-], 1",
    "ratio": "factor on the gear ratios: how far rotors turn for a motion of the joints [-], 1",
    "drive_stiffness": "factor on the stiffness of elastic transmissions [-], 1",
    "drive_damping": "factor on their damping [-], 1",
    "backlash": "factor on their backlash [-], 1",
    "drive_stiffness:ROTOR": "factor on the stiffness of the elastic transmission of one rotor [-], 1",
    "drive_damping:ROTOR": "the same on its damping [-], 1",
    "backlash:ROTOR": "the same on its backlash [-], 1",
    "motor_damping": "viscous friction of the rotors of limited motors [N m s/rad], n_motors",
    "motor_friction": "dry friction of the rotors of limited motors [N m], n_motors",
    "drive_friction": "factor on what friction of limited motors has more of at rest and under load [-], 1",
    "cogging": "factor on the cogging of limited motors [-], 1",
    "ambient": "temperature of the air around limited motors that grow warm [deg C], 1",
    "battery_voltage": "of the battery of limited motors, without load [V], 1",
    "battery_resistance": "of it and of its wires [ohm], 1",
    "joint_damping": "viscous friction of the joints [N m s/rad or N s/m], n_joints",
    "joint_friction": "dry friction of the joints [N m or N], n_joints",
    "link_inertia:BODY": "factor on the moments of inertia of a body about its centre of mass [-], 1",
    "added_mass:BODY": "mass added at the centre of mass of a body [kg], 1",
    "com_shift:BODY": "shift of the centre of mass of a body, in its frame [m], 3",
}
"""What can be declared, with unit and size; BODY stands for the name of a link, ROTOR for that of a rotor."""


@dataclass
class Figures:
    """Figures of a scene, each a number or a symbol.

    Attributes:
        compliance: Of the contacts.
        kp: Position gain of each independent joint, shape (nj,); empty if the robot has none.
        kd: Velocity gain of each independent joint, shape (nj,); likewise.
        strength: Factor on motor torques.
        drive_stiffness: Factor on the stiffness of elastic transmissions.
        drive_damping: Factor on their damping.
        backlash: Factor on their backlash.
    """

    compliance: Compliance
    kp: SX
    kd: SX
    strength: SX
    drive_stiffness: SX
    drive_damping: SX
    backlash: SX


def parameter_defaults(
    robot: Robot, material: ContactMaterial, names: Sequence[str], argument: str = "parameters"
) -> dict[str, NDArray]:
    """Return the value that leaves the robot as it is, for each declared parameter, shape (size,).

    Args:
        robot: The robot.
        material: Of its contacts.
        names: The declared parameters.
        argument: What an error calls them.

    Raises:
        ValueError: If a name is not a parameter of the robot, or is listed twice.
    """
    gains = {"kp": dict(robot.gains.kp), "kd": dict(robot.gains.kd)}
    plain = {
        "gravity": np.array(robot.gravity),
        "friction": np.array([material.friction]),
        "slip_speed": np.array([material.slip_speed]),
        "stiffness": np.array([material.stiffness]),
        "damping": np.array([material.damping]),
        "kp": np.array([gains["kp"].get(name, 0.0) for name in robot.commanded]),
        "kd": np.array([gains["kd"].get(name, 0.0) for name in robot.commanded]),
        "motor_strength": np.ones(1),
        "rotor_inertia": np.ones(1),
        "ratio": np.ones(1),
        "drive_stiffness": np.ones(1),
        "drive_damping": np.ones(1),
        "backlash": np.ones(1),
        "motor_damping": np.array([motor.damping for motor in robot.motors]),
        "motor_friction": np.array([motor.friction for motor in robot.motors]),
        "drive_friction": np.ones(1),
        "cogging": np.ones(1),
        "joint_damping": np.array([robot.body(name).joint.damping for name in robot.commanded]),
        "joint_friction": np.array([robot.body(name).joint.friction for name in robot.commanded]),
    }
    airs = [motor.heat.ambient for motor in robot.motors if motor.heat is not None]
    plain["ambient"] = np.array(airs[:1] or [25.0])
    battery = robot.battery or Battery(1.0, 0.0, 1.0)
    plain |= {f"battery_{name}": np.array([getattr(battery, name)]) for name in ("voltage", "resistance")}
    links = [body.name for body in robot.bodies if body.kind == "link"]
    plain |= {f"added_mass:{link}": np.zeros(1) for link in links}
    plain |= {f"com_shift:{link}": np.zeros(3) for link in links}
    plain |= {f"link_inertia:{link}": np.ones(1) for link in links}
    plain |= {f"rotor_inertia:{rotor.name}": np.ones(1) for rotor in robot.rotors()}
    plain |= {f"{kind}:{elastic.rotor}": np.ones(1) for kind in ELASTIC_FACTORS for elastic in robot.elastic}
    check_names(argument, names, plain, "one of", listed=f"{', '.join(PARAMETERS)}, BODY being a link, ROTOR a rotor")
    if "ratio" in names:
        check_ratios(robot)
    return {name: plain[name] for name in names}


def check_parameter(robot: Robot, name: str, values: ArrayLike) -> None:
    """Check the values of a parameter.

    Args:
        robot: The robot.
        name: Of a parameter of it.
        values: What robots are given, any shape.

    Raises:
        ValueError: If a value is not finite or out of range; one line.
    """
    numbers, kind = np.asarray(values, dtype=float), name.split(":")[0]
    good, expected = numbers >= 0, "0 or more"
    if kind in ("gravity", "com_shift", "ambient"):
        good, expected = np.isfinite(numbers), "finite numbers"
    elif kind in ("ratio", "slip_speed", "drive_stiffness", "battery_voltage"):
        good, expected = numbers > 0, "more than 0"
    elif kind == "added_mass":
        mass = robot.body(name.partition(":")[2]).inertial.mass
        good, expected = numbers > -mass, f"more than -{mass:g} kg, what the body has"
    elif kind == "rotor_inertia":
        rotors = [rotor for rotor in robot.rotors() if name in (kind, f"{kind}:{rotor.name}")]
        least, which = max(((smallest_spin_factor(rotor), rotor.name) for rotor in rotors), default=(0.0, ""))
        if least > 0.0:
            good, expected = numbers >= least, f"{least:.6g} or more, for a tensor of {which} that a body can have"
    if wrong := numbers[~(good & np.isfinite(numbers))].tolist():
        raise ValueError(f"{name}={wrong[0]:g}; expected {expected}")


def figures(robot: Robot, material: ContactMaterial, names: tuple[str, ...], values: SX) -> Figures:
    """Return the figures of a scene, the declared ones taken from `values`, stacked in the order of `names`."""
    given = _split(robot, material, names, values)
    defaults = parameter_defaults(robot, material, ("kp", "kd"))

    def chosen(name: str, default: float | NDArray) -> SX:
        return given.get(name, SX(default))

    compliance = Compliance(
        stiffness=chosen("stiffness", material.stiffness),
        damping=chosen("damping", material.damping),
        dissipation=None if material.dissipation is None else SX(material.dissipation),
        friction=chosen("friction", material.friction),
        slip_speed=chosen("slip_speed", material.slip_speed),
        bristle=SX(material.bristle),
    )
    kp, kd = chosen("kp", defaults["kp"]), chosen("kd", defaults["kd"])
    factors = [chosen(name, 1.0) for name in ("motor_strength", "drive_stiffness", "drive_damping", "backlash")]
    return Figures(compliance, kp, kd, *factors)


def with_parameters(mechanism: Mechanism, names: tuple[str, ...], values: SX) -> Mechanism:
    """Return a mechanism with symbols in place of the figures that are declared parameters."""
    given = _split(mechanism.robot, mechanism.robot.material, names, values)
    bodies = {name: _with_ballast(body, mechanism.robot, given) for name, body in mechanism.bodies.items()}
    _scale_spins(bodies, mechanism.robot, given)
    spins = tuple(tuple(_with_factor(spin, given) for spin in group) for group in mechanism.spins)
    ratio, gravity = given.get("ratio", mechanism.ratio), given.get("gravity", mechanism.gravity)
    robot = with_drives(mechanism.robot, given)
    return replace(mechanism, robot=robot, bodies=bodies, spins=spins, gravity=gravity, ratio=ratio)


def with_drives(robot: Robot, given: Mapping[str, SX]) -> Robot:
    """Return a robot with numbers or symbols for the friction of motors and joints, and the stiffness of drives.

    Args:
        robot: The robot.
        given: Parameters by name; those of other kinds are passed over.
    """
    changed: dict[str, Any] = {}
    if motors := _each(robot.motors, given, {"motor_damping": "damping", "motor_friction": "friction"}):
        changed["motors"] = motors
    if "drive_friction" in given:
        changed["motors"] = tuple(_with_rubbing(motor, given["drive_friction"]) for motor in motors or robot.motors)
    if "ambient" in given or "cogging" in given:
        changed["motors"] = tuple(_with_air(motor, given) for motor in changed.get("motors", robot.motors))
    feeding = {name: given[f"battery_{name}"] for name in ("voltage", "resistance") if f"battery_{name}" in given}
    if feeding and robot.battery is not None:
        changed["battery"] = replace(robot.battery, **feeding)  # type: ignore[arg-type]
    joints = [robot.body(name).joint for name in robot.commanded]
    if rubbing := _each(joints, given, {"joint_damping": "damping", "joint_friction": "friction"}):
        moved = dict(zip(robot.commanded, rubbing, strict=True))
        changed["bodies"] = tuple(replace(b, joint=moved.get(b.name, b.joint)) for b in robot.bodies)
    if any(name.split(":")[0] in ELASTIC_FACTORS and ":" in name for name in given):
        changed["elastic"] = tuple(_with_factors(elastic, given) for elastic in robot.elastic)
    return replace(robot, **changed) if changed else robot


def rubbing_as_declared(mechanism: Mechanism, names: tuple[str, ...]) -> Mechanism:
    """Return a mechanism in which whatever has dry friction by declared parameters has some."""
    n = {"motor_friction": len(mechanism.robot.motors), "joint_friction": len(mechanism.robot.commanded)}
    given = {name: SX.ones(n[name]) for name in names if name in n}
    return replace(mechanism, robot=with_drives(mechanism.robot, given)) if given else mechanism


def check_ratios(robot: Robot) -> None:
    """Check that the angles of all rotors follow from those of links by linear ties, so that a factor scales them.

    Raises:
        ValueError: A rotor is an independent joint, or is tied by something else than gears and belts.
    """
    rotors = {rotor.name for rotor in robot.rotors()}
    other = {name for tie in robot.constraints if not isinstance(tie, LinearConstraint) for name in tie.bodies}
    if bad := sorted(rotors & (other | set(robot.independent))):
        expected = "expected rotors that follow from links by gears and belts alone"
        raise ValueError(f"parameters='ratio': {bad[0]} of {robot.name}; {expected}")


def _split(robot: Robot, material: ContactMaterial, names: tuple[str, ...], values: SX) -> dict[str, SX]:
    sizes = [len(default) for default in parameter_defaults(robot, material, names).values()]
    return dict(zip(names, ca.vertsplit(values, np.cumsum([0, *sizes]).tolist()), strict=True)) if names else {}


def _each(things: Sequence[Any], given: Mapping[str, SX], fields: Mapping[str, str]) -> tuple[Any, ...]:
    """Return motors or joints, each with its entry of the parameters that stand for fields; none without them."""
    if not given.keys() & fields.keys():
        return ()
    for name, field in fields.items():
        if name in given:
            things = [replace(thing, **{field: given[name][i]}) for i, thing in enumerate(things)]
    return tuple(things)


def _with_rubbing(motor: Motor, factor: SX) -> Motor:
    drive = motor.drive_friction
    return motor if drive is None else replace(motor, drive_friction=replace(drive, factor=drive.factor * factor))


def _with_air(motor: Motor, given: Mapping[str, SX]) -> Motor:
    if "ambient" in given and motor.heat is not None:
        motor = replace(motor, heat=replace(motor.heat, ambient=given["ambient"]))  # type: ignore[arg-type]
    if "cogging" in given and motor.cogging:
        motor = replace(motor, cogging=tuple((n, given["cogging"] * size, at) for n, size, at in motor.cogging))  # type: ignore[misc]
    return motor


def _with_factors(elastic: Elasticity, given: Mapping[str, SX]) -> Elasticity:
    stiffness, damping, play = (given.get(f"{kind}:{elastic.rotor}", 1.0) for kind in ELASTIC_FACTORS)
    figures = {"stiffness": elastic.stiffness * stiffness, "damping": elastic.damping * damping}
    return replace(elastic, **figures, play=elastic.play * play)  # type: ignore[arg-type]


def _with_factor(spin: Spin, given: Mapping[str, SX]) -> Spin:
    for factor in _spin_factors(spin.rotor, given):
        spin = replace(spin, inertia=spin.inertia * factor)
    return spin


def _spin_factors(rotor: str, given: Mapping[str, SX]) -> list[SX]:
    return [given[name] for name in ("rotor_inertia", f"rotor_inertia:{rotor}") if name in given]


def _scale_spins(bodies: dict[str, MovingBody], robot: Robot, given: Mapping[str, SX]) -> None:
    """Scale the spin inertia of rotors that are bodies, in place; as a load of the carrier it stays what it is."""
    for rotor in robot.rotors():
        factors = _spin_factors(rotor.name, given)
        if not factors or rotor.name not in bodies:
            continue
        change, axis = (math.prod(factors) - 1) * spin_inertia(rotor), np.array(rotor.joint.axis)
        _add_moment(bodies, rotor.name, change, axis)
        if rotor.parent is not None:
            _add_moment(bodies, rotor.parent, -change, np.array(rotor.placement.rotation) @ axis)


def _add_moment(bodies: dict[str, MovingBody], name: str, moment: SX, axis: NDArray) -> None:
    """Add a moment of inertia about an axis of a body, in place."""
    more = ca.diagcat(moment * constant(np.outer(axis, axis)), SX(3, 3))
    bodies[name] = replace(bodies[name], inertia=constant(bodies[name].inertia) + more)  # type: ignore[arg-type]


def _with_ballast(body: MovingBody, robot: Robot, given: dict[str, SX]) -> MovingBody:
    """Add mass and move the centre of mass, which leaves the moments of inertia about it; these have a factor."""
    figures = ("added_mass", "com_shift", "link_inertia")
    added, shift, factor = (given.get(f"{figure}:{body.name}") for figure in figures)
    if added is None and shift is None and factor is None:
        return body
    inertial = robot.body(body.name).inertial
    mass, com = inertial.mass, SX(inertial.com)
    inertia = constant(body.inertia)
    if added is not None or shift is not None:
        before = _point_mass(mass, com)
        after = _point_mass(mass + (added if added is not None else 0), com + (shift if shift is not None else 0))
        inertia = inertia + after - before
    if factor is not None:
        own = SX(ca.sparsify(ca.DM(np.array(inertial.inertia))))
        inertia = inertia + ca.diagcat((factor - 1) * own, SX(3, 3))
    return replace(body, inertia=inertia)  # type: ignore[arg-type]


def _point_mass(mass: SX | float, at: SX) -> SX:
    """Spatial inertia of a point mass, shape (6, 6)."""
    c = skew(at)
    return ca.blockcat([[mass * c @ c.T, mass * c], [mass * c.T, mass * SX.eye(3)]])
