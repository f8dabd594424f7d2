"""Robots with transmissions of every kind, for tests of those that stretch."""

from __future__ import annotations

from dataclasses import replace

from linkages import four_bar

from ce_gym.model import Body, Elasticity, Inertial, Joint, LinearConstraint, Motor, Placement, Robot, load_robot
from ce_gym.model.description import Gains

RATIO, LINK, ROTOR = 8.0, 0.02, 1e-5
"""Of the turntable: gear ratio, and moments of inertia of link and rotor [kg m^2]."""


def elastic(robot: Robot, stiffness: float, **figures: float) -> Robot:
    """A robot all of whose transmissions give way."""
    return replace(robot, elastic=tuple(Elasticity(rotor.name, stiffness, **figures) for rotor in robot.rotors()))


def _about_z(name: str, moment: float, kind: str = "link") -> Body:
    inertial = Inertial(1.0, (0.0, 0.0, 0.0), ((moment, 0.0, 0.0), (0.0, moment, 0.0), (0.0, 0.0, moment)))
    return Body(name, kind, None, Placement(), Joint("revolute", (0.0, 0.0, 1.0)), inertial)  # type: ignore[arg-type]


def turntable(stiffness: float, **figures: float) -> Robot:
    """One geared joint on the world, without gravity."""
    gear = LinearConstraint("gear", (("rotor", 1.0), ("table", -RATIO)))
    bodies = (_about_z("table", LINK), _about_z("rotor", ROTOR, "rotor"))
    robot = Robot("turntable", bodies, (gear,), ("table",), motors=(Motor("rotor"),), gravity=(0.0, 0.0, 0.0))
    return elastic(robot, stiffness, **figures)


def differential() -> Robot:
    """Two tables that two rotors turn together and against each other, without gravity: constant inertias."""
    bodies = [_about_z(name, LINK) for name in ("left", "right")]
    rotors = [_about_z(name, 2e-4, "rotor") for name in ("sum", "difference")]
    ties = [
        LinearConstraint("sums", (("sum", 1.0), ("left", -3.0), ("right", -4.0))),
        LinearConstraint("differences", (("difference", 1.0), ("left", -3.0), ("right", 4.0))),
    ]
    gains = Gains((("left", 5.0), ("right", 8.0)), (("left", 0.1), ("right", 0.2)))
    motors = (Motor("sum"), Motor("difference"))
    names = ("left", "right")
    return Robot("both", (*bodies, *rotors), tuple(ties), names, motors=motors, gains=gains, gravity=(0.0, 0.0, 0.0))


KINDS = {
    "gears and a belt": lambda: load_robot("mit_humanoid_leg"),
    "a differential": differential,
    "a gear on a closed loop": lambda: replace(four_bar(), motors=(Motor("motor"),)),
}
"""A robot for every kind of transmission."""


def _as_link(body: Body) -> Body:
    """A rotor as a link, which must have some mass."""
    return replace(body, kind="link", inertial=replace(body.inertial, mass=max(body.inertial.mass, 1e-14)))


def untied(robot: Robot) -> Robot:
    """The same bodies with every rotor free to turn, a link like others."""
    rotors = [rotor.name for rotor in robot.rotors()]
    return replace(
        robot,
        bodies=tuple(_as_link(body) for body in robot.bodies),
        constraints=tuple(tie for tie in robot.constraints if not set(tie.bodies) & set(rotors)),
        independent=(*robot.independent, *rotors),
        motors=(),
        gains=Gains(),
    )
