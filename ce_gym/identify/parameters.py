"""The parameters of a robot that can be identified, with bounds, starting values and scales."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from ce_gym.identify.base_fixed import limbs_of
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
    "delay": "time from command to motors [s], common to all motors",
    "drive_stiffness": "factor on the stiffness of each elastic transmission",
    "drive_damping": "factor on the damping of each elastic transmission",
    "backlash": "factor on the backlash of each elastic transmission",
    "encoder_zero": "offset of each joint's encoder relative to the encoder of its rotor [rad or m]",
}
"""Kinds of parameters."""
OFFSET = "encoder_zero"
ELASTIC_KINDS = *ELASTIC_FACTORS, OFFSET
"""Kinds that only elastic transmissions have."""
LOSSES = "motor_damping", "motor_friction", "joint_damping", "joint_friction"
"""Kinds whose parameter in the simulator has one entry per motor or joint."""
UNITS = {"motor_damping": "N m s/rad", "motor_friction": "N m", "joint_damping": "N m s/rad", "joint_friction": "N m"}
UNITS |= {"added_mass": "kg", "delay": "s", OFFSET: "rad"}
FACTOR_BOUNDS = 0.02, 50.0
OFFSET_SCALE = 0.01
"""Scale of the offset of a joint's encoder [rad or m]."""


@dataclass(frozen=True)
class Parameter:
    """A parameter to identify.

    Attributes:
        kind: One of `KINDS`.
        element: Name of the rotor, joint or link; empty for the delay.
        nominal: Value in the robot's file.
        start: Starting value of the search.
        low: Lower bound.
        high: Upper bound.
        scale: Typical size, by which the optimiser divides the parameter.
        limb: Number of the limb that the parameter changes; -1 for all limbs.
        entry: Entry in the simulator's parameter, if that has one number for each motor or joint.
    """

    kind: str
    element: str
    nominal: float
    start: float
    low: float
    high: float
    scale: float
    limb: int
    entry: int = 0

    @property
    def name(self) -> str:
        """The kind, followed by the element if there is one, as in `rotor_inertia` of `HR_hip_rotor`."""
        return f"{self.kind}:{self.element}" if self.element else self.kind

    @property
    def simulator_parameter(self) -> str:
        """Name of the simulator's parameter; empty for delay and encoder offsets, which act outside the simulator."""
        if self.kind in ("delay", OFFSET):
            return ""
        return self.kind if self.kind in LOSSES else self.name

    @property
    def unit(self) -> str:
        """Unit; "-" for a factor."""
        return UNITS.get(self.kind, "-")


def default_kinds(robot: Robot, measured: Sequence[tuple[str, str]] = ()) -> tuple[str, ...]:
    """Return the kinds of parameters to identify by default.

    Friction of motors, or of joints if there are no motors. If transmissions are elastic, their parameters, too.
    """
    inertia = ("rotor_inertia",) if any(robot.rotors()) else ()
    friction = ("motor_damping", "motor_friction") if robot.motors else ("joint_damping", "joint_friction")
    elastic = tuple(kind for kind in ELASTIC_KINDS if _of_kind(robot, kind, 1.0, measured))
    return (*inertia, *friction, "link_inertia", "delay", *elastic)


def select_parameters(
    robot: Robot,
    kinds: Sequence[str],
    fixed: Sequence[str] = (),
    longest_delay: float = 0.03,
    measured: Sequence[tuple[str, str]] = (),
) -> list[Parameter]:
    """Return the parameters of a robot to identify.

    Args:
        robot: The robot in the log, with a fixed base.
        kinds: Some of `KINDS`.
        fixed: Names of known parameters, such as "rotor_inertia:HR_hip_rotor".
        longest_delay: Upper bound of the delay [s].
        measured: Columns of the log, as `Log.measured`.

    Raises:
        RobotError: There is no such kind or no such parameter.
    """
    by_kind = {kind: _of_kind(robot, kind, longest_delay, measured) for kind in KINDS}
    available = [kind for kind, parameters in by_kind.items() if parameters]
    _check_listed("kind", kinds, KINDS, "a kind of parameter")
    _check_listed("kind", kinds, available, f"a kind that {robot.name} and its log have")
    parameters = [parameter for kind in kinds for parameter in by_kind[kind]]
    _check_listed("fixed", fixed, [parameter.name for parameter in parameters], "a parameter of the chosen kinds")
    free = [parameter for parameter in parameters if parameter.name not in fixed]
    if not free:
        raise RobotError("identify: every parameter is fixed: expected at least one to identify")
    return free


def _check_listed(key: str, names: Sequence[str], known: Collection[str], what: str) -> None:
    for i, name in enumerate(names):
        if name not in known:
            raise unknown_name("identify", key, name, known, what)
        if name in names[:i]:
            raise invalid_value("identify", key, name, "each name once")


def _of_kind(
    robot: Robot, kind: str, longest_delay: float, measured: Sequence[tuple[str, str]] = ()
) -> list[Parameter]:
    limb = limbs_of(robot)
    links = [body for body in robot.bodies if body.kind == "link"]
    if kind == "delay":
        return [Parameter(kind, "", 0.0, longest_delay / 10, 0.0, longest_delay, longest_delay / 3, -1)]
    if kind == OFFSET:
        return [
            Parameter(kind, name, 0.0, 0.0, -10.0, 10.0, OFFSET_SCALE, limb[name])
            for name in _joints_with_two_encoders(robot, measured)
        ]
    if kind == "added_mass":
        masses = [(body.name, body.inertial.mass) for body in links]
        return [Parameter(kind, name, 0.0, 0.0, -0.95 * m, 20 * m, m, limb[name]) for name, m in masses if m > 0]
    if kind in LOSSES:
        return _losses(robot, kind, limb)
    if kind == "rotor_inertia":
        names = [body.name for body in robot.rotors()]
    elif kind == "link_inertia":
        names = [body.name for body in links]
    else:  # no factor on a value that is 0 in the robot's file
        field = kind.removeprefix("drive_")
        names = [e.rotor for e in robot.elastic if e.stretch in robot.independent and getattr(e, field) > 0]
    return [Parameter(kind, name, 1.0, 1.0, *FACTOR_BOUNDS, 1.0, limb[name]) for name in names]


def _joints_with_two_encoders(robot: Robot, measured: Sequence[tuple[str, str]]) -> list[str]:
    """Return the joints behind elastic transmissions whose angle and rotor angle are both in the log."""
    angles = {name for kind, name in measured if kind == "angle"}
    rotors = {e.rotor for e in robot.elastic if e.stretch in robot.independent and e.rotor in angles}
    tied = {name for tie in robot.constraints if rotors & set(tie.bodies) for name in tie.bodies}
    return [name for name in robot.commanded if name in tied & angles]


def _losses(robot: Robot, kind: str, limb: dict[str, int]) -> list[Parameter]:
    """Return the friction of all motors or joints; its scale is 1 % of the largest torque, at the largest speed."""
    is_viscous = kind in ("motor_damping", "joint_damping")
    if kind in ("motor_damping", "motor_friction"):
        axes = {motor.rotor: motor for motor in robot.motors}
    else:
        axes = {name: robot.body(name).joint for name in robot.commanded}
    parameters = []
    for entry, (name, axis) in enumerate(axes.items()):
        value = axis.damping if is_viscous else axis.friction
        scale = 0.01 * axis.torque if 0 < axis.torque < math.inf else 0.1
        if is_viscous:
            scale /= min(axis.velocity, 100.0) if axis.velocity > 0 else 10.0
        scale = max(scale, value)
        start = max(value, 0.1 * scale)
        parameters.append(Parameter(kind, name, value, start, 0.0, 1e4 * scale, scale, limb[name], entry))
    return parameters
