"""Parameters of a robot and its scene that may differ from robot to robot: constants, or inputs if they are declared.

Force laws declare their own parameters. This file declares inertia, gravity, gears, motors and joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.algebra.spatial import SX, skew
from ce_gym.dynamics.recursion.kinematics import constant
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import ContactMaterial, Robot
from ce_gym.model.drives import ELASTIC_FACTORS, Elasticity, Motor
from ce_gym.model.mechanism import EliminatedRotor, Mechanism, MovingBody, smallest_spin_factor, spin_inertia
from ce_gym.model.ranges import FINITE, NOT_NEGATIVE, POSITIVE, TEMPERATURE

RANGES = {"finite": FINITE, "positive": POSITIVE, "0 or more": NOT_NEGATIVE, "a temperature": TEMPERATURE}
"""Allowed values by the word for them in `Parameter`."""


@dataclass(frozen=True)
class Parameter:
    """A number or a column of numbers that robots of a batch may have different values of.

    Attributes:
        name: "friction"; "added_mass:BODY" or "backlash:ROTOR" for one per body or rotor.
        meaning: One line for readers.
        unit: Of each number.
        size: How many numbers it has, for readers.
        default: Value that leaves a robot unchanged, shape (size,), given the robot and the material of its contacts.
        allowed: Which values are allowed.
        owners: Names of bodies or rotors that have such a parameter; None for a parameter of the whole robot.
    """

    name: str
    meaning: str
    unit: str
    size: str
    default: Callable[[Robot, ContactMaterial], ArrayLike]
    allowed: Literal["finite", "positive", "0 or more", "a temperature"] = "0 or more"
    owners: Callable[[Robot], Iterable[str]] | None = None

    @property
    def kind(self) -> str:
        """The name without its owner."""
        return self.name.split(":")[0]

    def __str__(self) -> str:
        """Return meaning, unit and size."""
        return f"{self.meaning} [{self.unit}], {self.size}"

    def names(self, robot: Robot) -> list[str]:
        """Return the names of such parameters of a robot."""
        return [self.name] if self.owners is None else [f"{self.kind}:{owner}" for owner in self.owners(robot)]


def unit_factor(robot: Robot, material: ContactMaterial) -> ArrayLike:
    """Return the factor 1, which changes nothing."""
    return np.ones(1)


def _links(robot: Robot) -> list[str]:
    return [body.name for body in robot.bodies if body.kind == "link"]


def _elastic_rotors(robot: Robot) -> list[str]:
    return [elastic.rotor for elastic in robot.elastic]


def _of_motors(field: str) -> Callable[[Robot, ContactMaterial], ArrayLike]:
    return lambda robot, material: [getattr(motor, field) for motor in robot.motors]


def _of_joints(field: str) -> Callable[[Robot, ContactMaterial], ArrayLike]:
    return lambda robot, material: [getattr(robot.body(name).joint, field) for name in robot.commanded]


def _ambient(robot: Robot, material: ContactMaterial) -> ArrayLike:
    return [motor.heat.ambient for motor in robot.motors if motor.heat is not None][:1] or [25.0]


def _of_battery(field: str, otherwise: float) -> Callable[[Robot, ContactMaterial], ArrayLike]:
    return lambda robot, material: [getattr(robot.battery, field) if robot.battery else otherwise]


MODEL_PARAMETERS = (
    Parameter(
        "gravity", "acceleration of free fall in the world", "m/s^2", "3", lambda robot, _: robot.gravity, "finite"
    ),
    Parameter("rotor_inertia", "factor on the spin inertia of rotors", "-", "1", unit_factor),
    Parameter(
        "rotor_inertia:ROTOR",
        "factor on the spin inertia of one rotor",
        "-",
        "1",
        unit_factor,
        owners=lambda robot: [rotor.name for rotor in robot.rotors()],
    ),
    Parameter(
        "ratio", "factor on the gear ratios: rotor angles for a motion of the joints", "-", "1", unit_factor, "positive"
    ),
    Parameter(
        "drive_stiffness:ROTOR",
        "factor on the stiffness of the elastic transmission of one rotor",
        "-",
        "1",
        unit_factor,
        "positive",
        _elastic_rotors,
    ),
    Parameter(
        "drive_damping:ROTOR",
        "factor on the damping of the elastic transmission of one rotor",
        "-",
        "1",
        unit_factor,
        owners=_elastic_rotors,
    ),
    Parameter(
        "backlash:ROTOR",
        "factor on the backlash of the elastic transmission of one rotor",
        "-",
        "1",
        unit_factor,
        owners=_elastic_rotors,
    ),
    Parameter(
        "motor_damping",
        "viscous friction of the rotors of limited motors",
        "N m s/rad",
        "n_motors",
        _of_motors("damping"),
    ),
    Parameter(
        "motor_friction", "dry friction of the rotors of limited motors", "N m", "n_motors", _of_motors("friction")
    ),
    Parameter(
        "drive_friction", "factor on the friction of limited motors at rest and under load", "-", "1", unit_factor
    ),
    Parameter("cogging", "factor on the cogging of limited motors", "-", "1", unit_factor),
    Parameter(
        "ambient",
        "temperature of the air around limited motors that grow warm",
        "deg C",
        "1",
        _ambient,
        "a temperature",
    ),
    Parameter(
        "battery_voltage",
        "voltage of the battery of limited motors without load",
        "V",
        "1",
        _of_battery("voltage", 1.0),
        "positive",
    ),
    Parameter(
        "battery_resistance", "resistance of the battery and its wires", "ohm", "1", _of_battery("resistance", 1.0)
    ),
    Parameter(
        "joint_damping", "viscous friction of the joints", "N m s/rad or N s/m", "n_joints", _of_joints("damping")
    ),
    Parameter("joint_friction", "dry friction of the joints", "N m or N", "n_joints", _of_joints("friction")),
    Parameter(
        "link_inertia:BODY",
        "factor on the moments of inertia of a body about its centre of mass",
        "-",
        "1",
        unit_factor,
        owners=_links,
    ),
    Parameter(
        "added_mass:BODY",
        "mass added at the centre of mass of a body",
        "kg",
        "1",
        lambda robot, _: np.zeros(1),
        owners=_links,
    ),
    Parameter(
        "com_shift:BODY",
        "shift of the centre of mass of a body, in its frame",
        "m",
        "3",
        lambda robot, _: np.zeros(3),
        "finite",
        _links,
    ),
)
"""The parameters that no force law declares."""


def least_value(robot: Robot, name: str) -> tuple[float, str]:
    """Return the bound below which a body would have no mass or no inertia, and the requirement as a text; else 0."""
    kind, _, owner = name.partition(":")
    if kind == "added_mass":
        mass = robot.body(owner).inertial.mass
        return -mass, f"more than -{mass:g} kg, what the body has"
    if kind == "rotor_inertia":
        rotors = [rotor for rotor in robot.rotors() if owner in ("", rotor.name)]
        least, rotor = max(((smallest_spin_factor(rotor), rotor.name) for rotor in rotors), default=(0.0, ""))
        if least > 0.0:
            return least, f"{least:.6g} or more, for a tensor of {rotor} that a body can have"
    return 0.0, ""


def with_parameters(mechanism: Mechanism, given: Mapping[str, SX]) -> Mechanism:
    """Return a mechanism with symbols in place of its parameters; parameters of force laws are ignored.

    Args:
        mechanism: The robot at a transmission level.
        given: Parameters by name.
    """
    bodies = {name: _with_ballast(body, mechanism.robot, given) for name, body in mechanism.bodies.items()}
    _scale_spins(bodies, mechanism.robot, given)
    rotors = tuple(tuple(_with_factor(rotor, given) for rotor in group) for group in mechanism.eliminated_rotors)
    ratio, gravity = given.get("ratio", mechanism.ratio), given.get("gravity", mechanism.gravity)
    robot = with_drives(mechanism.robot, given)
    return replace(mechanism, robot=robot, bodies=bodies, eliminated_rotors=rotors, gravity=gravity, ratio=ratio)


def with_drives(robot: Robot, given: Mapping[str, SX]) -> Robot:
    """Return a robot with numbers or symbols for the friction of motors and joints, and the stiffness of drives.

    Args:
        robot: The robot.
        given: Parameters by name; other parameters are ignored.
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


def with_declared_friction(mechanism: Mechanism, names: tuple[str, ...]) -> Mechanism:
    """Return a mechanism in which whatever has dry friction by declared parameters has some."""
    n = {"motor_friction": len(mechanism.robot.motors), "joint_friction": len(mechanism.robot.commanded)}
    given = {name: SX.ones(n[name]) for name in names if name in n}
    return replace(mechanism, robot=with_drives(mechanism.robot, given)) if given else mechanism


def check_ratios(robot: Robot) -> None:
    """Check that the angles of all rotors depend linearly on joint angles, so that a factor scales them.

    Raises:
        ValueError: A rotor is an independent joint, or is tied by something else than gears and belts.
    """
    rotors = {rotor.name for rotor in robot.rotors()}
    other = {name for tie in robot.constraints if not isinstance(tie, LinearConstraint) for name in tie.bodies}
    if bad := sorted(rotors & (other | set(robot.independent))):
        expected = "expected rotors that follow from links by gears and belts alone"
        raise ValueError(f"parameters='ratio': {bad[0]} of {robot.name}; {expected}")


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


def _with_factor(rotor: EliminatedRotor, given: Mapping[str, SX]) -> EliminatedRotor:
    for factor in _spin_factors(rotor.name, given):
        rotor = replace(rotor, inertia=rotor.inertia * factor)
    return rotor


def _spin_factors(rotor: str, given: Mapping[str, SX]) -> list[SX]:
    return [given[name] for name in ("rotor_inertia", f"rotor_inertia:{rotor}") if name in given]


def _scale_spins(bodies: dict[str, MovingBody], robot: Robot, given: Mapping[str, SX]) -> None:
    """Scale the spin inertia of rotors that are bodies, in place; the inertia of their carriers is unchanged."""
    for rotor in robot.rotors():
        factors = _spin_factors(rotor.name, given)
        if not factors or rotor.name not in bodies:
            continue
        change, axis = (math.prod(factors) - 1) * spin_inertia(rotor), np.array(rotor.joint.axis)
        _add_moment(bodies, rotor.name, change, axis)
        if rotor.parent is not None:
            _add_moment(bodies, rotor.parent, -change, np.array(rotor.placement.rotation) @ axis)


def _add_moment(bodies: dict[str, MovingBody], name: str, moment: SX | float, axis: NDArray) -> None:
    """Add a moment of inertia about an axis of a body, in place."""
    more = ca.diagcat(moment * constant(np.outer(axis, axis)), SX(3, 3))
    bodies[name] = replace(bodies[name], inertia=constant(bodies[name].inertia) + more)  # type: ignore[arg-type]


def _with_ballast(body: MovingBody, robot: Robot, given: Mapping[str, SX]) -> MovingBody:
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
