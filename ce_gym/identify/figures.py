"""Which figures of a robot are sought, between which bounds, and in which units they are of order one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ce_gym.identify.held import limbs_of
from ce_gym.model.description import Robot
from ce_gym.model.drives import ELASTIC_FACTORS
from ce_gym.model.errors import RobotError, invalid_value, unknown_name

KINDS = {
    "rotor_inertia": "factor on each rotor's spin inertia",
    "motor_damping": "viscous friction of each motor's rotor [N m s/rad]",
    "motor_friction": "dry friction of each motor's rotor [N m]",
    "joint_damping": "viscous friction of each joint [N m s/rad or N s/m]",
    "joint_friction": "dry friction of each joint [N m or N]",
    "link_inertia": "factor on each link's moments of inertia about its centre of mass",
    "added_mass": "mass added to each link [kg]",
    "delay": "from a command to the motors [s], one for all",
    "drive_stiffness": "factor on the stiffness of each elastic transmission",
    "drive_damping": "factor on its damping",
    "backlash": "factor on its backlash",
    "encoder_zero": "what the encoder of each joint reads too much, beside that of its rotor [rad or m]",
}
"""What can be sought."""
OF_ENCODERS = "encoder_zero"
OF_ELASTIC = *ELASTIC_FACTORS, OF_ENCODERS
"""What there is where transmissions stretch."""
NO_PARAMETERS = "delay", OF_ENCODERS
"""What is no parameter of the simulator."""
UNITS = {"motor_damping": "N m s/rad", "motor_friction": "N m", "joint_damping": "N m s/rad", "joint_friction": "N m"}
UNITS |= {"added_mass": "kg", "delay": "s", OF_ENCODERS: "rad"}
FACTORS = 0.02, 50.0
"""Between which factors are sought."""
LARGE_ZERO = 0.01
"""What is large for the zero of an encoder at a joint [rad or m]."""


@dataclass(frozen=True)
class Figure:
    """A figure that is sought.

    Attributes:
        kind: One of `KINDS`.
        of: The rotor, joint or link that has it; empty for the delay.
        nominal: What the robot's file has.
        start: Where the search begins.
        low: Lower bound.
        high: Upper bound.
        scale: What is large for it: differences are taken over a small part of it.
        limb: Number of the limb that it acts on; -1 for all.
        entry: Its place in a parameter of the simulator that has a number for each motor or joint.
    """

    kind: str
    of: str
    nominal: float
    start: float
    low: float
    high: float
    scale: float
    limb: int
    entry: int = 0

    @property
    def name(self) -> str:
        """Kind and whose it is."""
        return f"{self.kind}:{self.of}" if self.of else self.kind

    @property
    def parameter(self) -> str:
        """The simulator's parameter that has it, perhaps with those of others."""
        return (
            self.kind
            if self.kind in ("motor_damping", "motor_friction", "joint_damping", "joint_friction")
            else self.name
        )

    @property
    def unit(self) -> str:
        """Its unit; a factor has none."""
        return UNITS.get(self.kind, "-")


def default_kinds(robot: Robot, measured: Sequence[tuple[str, str]] = ()) -> tuple[str, ...]:
    """Return what is sought unless one says: friction of motors where there are motors, otherwise of joints.

    Where transmissions stretch, their figures, and what encoders of joints read too much beside those of rotors.
    """
    spins = ("rotor_inertia",) if any(robot.rotors()) else ()
    rubs = "motor" if robot.motors else "joint"
    kinds = (*spins, f"{rubs}_damping", f"{rubs}_friction", "link_inertia", "delay")
    stretch = tuple(kind for kind in OF_ELASTIC if _of_kind(robot, kind, 1.0, measured))
    return (*kinds, *stretch)


def sought(
    robot: Robot,
    kinds: Sequence[str],
    fixed: Sequence[str] = (),
    longest_delay: float = 0.03,
    measured: Sequence[tuple[str, str]] = (),
) -> list[Figure]:
    """Return the figures of a robot.

    Args:
        robot: As the log has it.
        kinds: Some of `KINDS`.
        fixed: Names of figures that are known, such as "rotor_inertia:HR_hip_rotor".
        longest_delay: [s]
        measured: What the log has, as `Log.measured`.

    Raises:
        RobotError: There is no such kind, or no such figure.
    """
    by_kind = {kind: _of_kind(robot, kind, longest_delay, measured) for kind in KINDS}
    usable = [kind for kind, figures in by_kind.items() if figures]
    _check_listed("figure", kinds, KINDS, "a kind of figure")
    _check_listed("figure", kinds, usable, f"a kind that {robot.name} and its log have")
    found = [figure for kind in kinds for figure in by_kind[kind]]
    _check_listed("fixed figure", fixed, [figure.name for figure in found], "a figure that is sought")
    left = [figure for figure in found if figure.name not in fixed]
    if not left:
        raise RobotError("identify: every figure is fixed: expected one that is sought")
    return left


def _check_listed(key: str, names: Sequence[str], known: Sequence[str] | dict[str, str], what: str) -> None:
    for i, name in enumerate(names):
        if name not in known:
            raise unknown_name("identify", key, name, known, what)
        if name in names[:i]:
            raise invalid_value("identify", key, name, "each name once")


def _of_kind(robot: Robot, kind: str, longest_delay: float, measured: Sequence[tuple[str, str]] = ()) -> list[Figure]:
    limb = limbs_of(robot)
    if kind in OF_ELASTIC:
        return _of_elastic(robot, kind, measured)
    if kind == "delay":
        return [Figure(kind, "", 0.0, longest_delay / 10, 0.0, longest_delay, longest_delay / 3, -1)]
    if kind in ("rotor_inertia", "link_inertia"):
        names = {
            "rotor_inertia": [body.name for body in robot.rotors()],
            "link_inertia": [body.name for body in robot.bodies if body.kind == "link"],
        }[kind]
        return [Figure(kind, name, 1.0, 1.0, *FACTORS, 1.0, limb[name]) for name in names]
    if kind == "added_mass":
        links = [body for body in robot.bodies if body.kind == "link"]
        masses = [(body.name, body.inertial.mass) for body in links]
        return [Figure(kind, name, 0.0, 0.0, -0.95 * m, 20 * m, m, limb[name]) for name, m in masses if m > 0]
    return _losses(robot, kind, limb)


def _of_elastic(robot: Robot, kind: str, measured: Sequence[tuple[str, str]]) -> list[Figure]:
    """Return figures of transmissions that stretch; there is no factor on what the robot's file has as 0."""
    limb = limbs_of(robot)
    if kind != OF_ENCODERS:
        field = kind.removeprefix("drive_")
        named = [e.rotor for e in robot.elastic if e.stretch in robot.independent and getattr(e, field) > 0]
        return [Figure(kind, name, 1.0, 1.0, *FACTORS, 1.0, limb[name]) for name in named]
    read = {name for what, name in measured if what == "angle"}
    behind = {e.rotor for e in robot.elastic if e.stretch in robot.independent and e.rotor in read}
    tied = {name for tie in robot.constraints if behind & set(tie.bodies) for name in tie.bodies}
    joints = [name for name in robot.commanded if name in tied & read]
    return [Figure(kind, name, 0.0, 0.0, -10.0, 10.0, LARGE_ZERO, limb[name]) for name in joints]


def _losses(robot: Robot, kind: str, limb: dict[str, int]) -> list[Figure]:
    """Return friction of motors or joints: of the order of a hundredth of the largest torque, at the largest speed."""
    whose, figure = kind.split("_")
    if whose == "motor":
        all_of = [(m.rotor, getattr(m, figure), m.torque, m.velocity) for m in robot.motors]
    else:
        joints = [(name, robot.body(name).joint) for name in robot.commanded]
        all_of = [(name, getattr(j, figure), j.torque, j.velocity) for name, j in joints]
    found = []
    for i, (name, value, torque, velocity) in enumerate(all_of):
        large = 0.01 * torque if 0 < torque < math.inf else 0.1
        if figure == "damping":
            large /= min(velocity, 100.0) if velocity > 0 else 10.0
        large = max(large, value)
        found.append(Figure(kind, name, value, max(value, 0.1 * large), 0.0, 1e4 * large, large, limb[name], i))
    return found
