"""Figures of a scene that may differ from robot to robot: constants folded into the code, or inputs when declared."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.algebra.spatial import SX, skew
from ce_gym.dynamics.forces.contact import Compliance
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import ContactMaterial, Robot
from ce_gym.model.mechanism import Mechanism, MovingBody

PARAMETERS = {
    "gravity": "acceleration of free fall in the world [m/s^2], 3",
    "friction": "Coulomb coefficient of the contacts [-], 1",
    "slip_speed": "speed at which the damping of friction alone carries its full force [m/s], 1",
    "stiffness": "normal stiffness of the contacts [N/m], 1",
    "damping": "normal damping of the contacts [N s/m], 1",
    "kp": "position gains of the joints [N m/rad or N/m], n_joints",
    "kd": "velocity gains of the joints [N m s/rad or N s/m], n_joints",
    "motor_strength": "factor on motor torques and their limits [-], 1",
    "rotor_inertia": "factor on the spin inertia of symmetric rotors [-], 1",
    "ratio": "factor on the gear ratios: how far rotors turn for a motion of the joints [-], 1",
    "drive_stiffness": "factor on the stiffness of elastic transmissions [-], 1",
    "drive_damping": "factor on their damping [-], 1",
    "backlash": "factor on their backlash [-], 1",
    "added_mass:BODY": "mass added at the centre of mass of a body [kg], 1",
    "com_shift:BODY": "shift of the centre of mass of a body, in its frame [m], 3",
}
"""What can be declared, with unit and size; BODY stands for the name of a link."""


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


def parameter_defaults(robot: Robot, material: ContactMaterial, names: tuple[str, ...]) -> dict[str, NDArray]:
    """Return the value that leaves the robot as it is, for each declared parameter, shape (size,).

    Raises:
        ValueError: If a name is not a parameter of the robot.
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
    }
    links = [body.name for body in robot.bodies if body.kind == "link"]
    plain |= {f"added_mass:{link}": np.zeros(1) for link in links}
    plain |= {f"com_shift:{link}": np.zeros(3) for link in links}
    for name in names:
        if name not in plain:
            raise ValueError(f"parameters={name!r}; expected one of {', '.join(PARAMETERS)}, BODY being a link")
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
    if kind in ("gravity", "com_shift"):
        good, expected = np.isfinite(numbers), "finite numbers"
    elif kind in ("ratio", "slip_speed", "drive_stiffness"):
        good, expected = numbers > 0, "more than 0"
    elif kind == "added_mass":
        mass = robot.body(name.split(":")[1]).inertial.mass
        good, expected = numbers > -mass, f"more than -{mass:g} kg, what the body has"
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
    factor = given.get("rotor_inertia")
    spins = mechanism.spins
    if factor is not None:
        spins = tuple(tuple(replace(spin, inertia=spin.inertia * factor) for spin in group) for group in spins)
    ratio, gravity = given.get("ratio", mechanism.ratio), given.get("gravity", mechanism.gravity)
    return replace(mechanism, bodies=bodies, spins=spins, gravity=gravity, ratio=ratio)


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


def _with_ballast(body: MovingBody, robot: Robot, given: dict[str, SX]) -> MovingBody:
    """Add mass and move the centre of mass; the moments of inertia about it stay."""
    added, shift = given.get(f"added_mass:{body.name}"), given.get(f"com_shift:{body.name}")
    if added is None and shift is None:
        return body
    inertial = robot.body(body.name).inertial
    mass, com = inertial.mass, SX(inertial.com)
    before = _point_mass(mass, com)
    after = _point_mass(mass + (added if added is not None else 0), com + (shift if shift is not None else 0))
    inertia = SX(ca.sparsify(ca.DM(body.inertia))) + after - before
    return replace(body, inertia=inertia)  # type: ignore[arg-type]


def _point_mass(mass: SX | float, at: SX) -> SX:
    """Spatial inertia of a point mass, shape (6, 6)."""
    c = skew(at)
    return ca.blockcat([[mass * c @ c.T, mass * c], [mass * c.T, mass * SX.eye(3)]])
