"""Does a robot stand without a policy? A simulation whose position controllers hold the standing pose for 30 s.

The simulation includes soft soles, torque limits, springs and the sag under load. The report also compares the robot
with an inverted pendulum, which stands only if the joints at its feet, all together, are stiffer than weight times
height of the centre of mass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.model.description import Robot
from ce_gym.sim.simulator import Simulator

Array = NDArray[np.float64]
SECONDS, DT = 30.0, 0.005
"""Duration of the simulation and its sub-step [s]."""
PUSH = 0.02
"""Speed of the base at the start, in each of four directions [m/s]."""
TILT, SUNK = 0.5, 0.6
"""A robot has fallen if it tilts by more than this [rad], or if its base is below this share of the standing height."""
FACTORS = np.round(2.0 ** np.arange(0.0, 6.5, 0.5), 1)
"""Factors on the position gains, 1 to 64; velocity gains are scaled by their roots."""
FOOT, ANKLE = "foot", 0.05
"""Contact group of the feet, and the largest distance of an ankle's joints from the foot's own joint [m]."""
MOST_CONTACTS = 24
"""Largest number of simulated contacts: the time to compile grows with its square."""
LATERAL = 1e-3
"""A joint counts as turning about the lateral axis if the lateral part of its axis exceeds this rounding error [-]."""
PUSHES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
LARGEST_GAP = 0.01
"""The text mentions a gap between the lowest contact and the ground that is larger than this [m]."""


@dataclass(frozen=True)
class StandingReport:
    """Whether a robot stands by its position gains, and the larger gains that would hold it.

    Attributes:
        fall_time: Time at which the first copy of the robot has fallen [s]; None if all stand.
        ankles: Joints at the feet.
        ankle_factor: Smallest of `FACTORS` on the gains of the ankles alone with which the robot stands, if any.
        factor: Smallest of `FACTORS` on all gains with which the robot stands, if any.
        toppling: Weight times height of the centre of mass above the ankles [N m/rad].
        stiffness: Sum of the position gains of the ankles that turn about the base's lateral axis [N m/rad].
        gap: Height of the lowest contact above the ground in the standing pose [m].
        contacts: Number of simulated contacts, see `standing_contacts`.
        choice: Which contacts were simulated, in words.
        all_contacts: Number of contacts of the robot.
    """

    fall_time: float | None
    ankles: tuple[str, ...]
    ankle_factor: float | None
    factor: float | None
    toppling: float
    stiffness: float
    gap: float
    contacts: int
    choice: str
    all_contacts: int


def standing_report(model: Model) -> str:
    """Return whether a robot stands by its position gains, or the gains that would hold it, as plain text.

    Args:
        model: Model of a robot with a floating base, feet, a standing pose and gains.
    """
    return as_text(simulate_standing(model))


def simulate_standing(model: Model) -> StandingReport:
    """Simulate a standing robot after small pushes, with its own gains and with larger ones; see `standing_report`."""
    robot, ankles = model.robot, joints_at_feet(model)
    is_ankle = np.array([name in ankles for name in robot.commanded])
    scales = np.where(is_ankle, FACTORS[:, None], 1.0), np.repeat(FACTORS[:, None], len(is_ankle), 1)
    times = fall_times(model, np.concatenate(scales))
    ankle_factor, factor = (_smallest_factor(np.isinf(half)) for half in np.split(times, 2))
    contacts, choice = standing_contacts(model)
    return StandingReport(
        fall_time=None if np.isinf(times[0]) else float(times[0]),
        ankles=ankles,
        ankle_factor=ankle_factor,
        factor=factor,
        toppling=toppling(model, ankles),
        stiffness=pitch_stiffness(model, ankles),
        gap=float(contact_heights(model).min()),
        contacts=len(contacts),
        choice=choice,
        all_contacts=len(robot.contacts),
    )


def standing_contacts(model: Model) -> tuple[tuple[str, ...], str]:
    """Return the contacts to simulate, at most `MOST_CONTACTS`, and the choice in words.

    The first of these that is small enough: all contacts, feet and torso, the feet, the lowest contacts of the feet.
    """
    contacts = model.robot.contacts
    if len(contacts) <= MOST_CONTACTS:
        return model.contact_names, "all"
    feet_and_torso = tuple(contact.name for contact in contacts if contact.group in (FOOT, "torso"))
    feet = tuple(contact.name for contact in contacts if contact.group == FOOT)
    if len(feet_and_torso) <= MOST_CONTACTS:
        return feet_and_torso, "groups foot and torso"
    if len(feet) <= MOST_CONTACTS:
        return feet, "group foot"
    heights = dict(zip(model.contact_names, contact_heights(model), strict=True))
    lowest = set(sorted(feet, key=lambda name: heights[name])[:MOST_CONTACTS])
    return tuple(name for name in feet if name in lowest), "the lowest of group foot"


def seconds_to_compile(model: Model) -> float:
    """Return roughly how long the kernel of a standing robot takes to compile [s]: a fit over 8 to 240 contacts."""
    n = len(standing_contacts(model)[0])
    return 2.0 + 0.3 * n + 0.01 * n**2


def contact_heights(model: Model) -> Array:
    """Return the height of the lowest point of each contact in the standing pose, wheels upright, shape (n,) [m]."""
    centres = model.contact_points(model.standing_q, np.zeros(model.nv))[0]
    return centres[:, 2] - np.array([contact.radius + contact.rim for contact in model.robot.contacts])


def fall_times(model: Model, scales: Array) -> Array:
    """Return when the first of four pushed copies has fallen, shape (n,) [s]; infinite if all stand for `SECONDS`.

    Args:
        model: Model of the robot.
        scales: Factors on the position gains, shape (n, n_joints); their roots scale the velocity gains.
    """
    sim = Simulator(
        model,
        len(scales) * len(PUSHES),
        DT,
        contacts=standing_contacts(model)[0],
        outputs=(),
        parameters=("kp", "kd"),
    )
    gains = {"kp": dict(model.robot.gains.kp), "kd": dict(model.robot.gains.kd)}
    for name, factors in (("kp", scales), ("kd", np.sqrt(scales))):
        nominal = np.array([gains[name].get(joint, 0.0) for joint in model.robot.commanded])
        sim.set_parameter(name, np.repeat(factors * nominal, len(PUSHES), 0))
    v = np.zeros((sim.num_envs, model.nv))
    v[:, 3:5] = PUSH * np.tile(PUSHES, (len(scales), 1))
    sim.set_state(np.broadcast_to(model.standing_q, (sim.num_envs, model.nq)), v)
    target = model.standing_q[model.robot.layout.joints_q :][: len(sim.target_names)]  # stretches come after joints
    times, n_substeps = np.full(sim.num_envs, np.inf), round(0.1 / DT)
    for i in range(round(SECONDS / (n_substeps * DT))):
        sim.step(target, n_substeps)
        down = has_fallen(model.robot, np.asarray(sim.q)) | np.asarray(sim.diverged, bool)
        times[down & np.isinf(times)] = (i + 1) * n_substeps * DT
    return times.reshape(len(scales), len(PUSHES)).min(1)


def has_fallen(robot: Robot, q: Array) -> NDArray[np.bool_]:
    """Return which robots have fallen or are falling, given their positions (n, nq), shape (n,)."""
    upright = 1.0 - 2.0 * (q[:, 4] ** 2 + q[:, 5] ** 2)  # cosine of the angle between the base's z and the world's
    return ~((upright > np.cos(TILT)) & (q[:, 2] > SUNK * robot.pose.height))


def joints_at_feet(model: Model) -> tuple[str, ...]:
    """Return the driven joints of the bodies with foot contacts, and driven joints close to them, as in an ankle."""
    robot = model.robot
    origins = dict(zip(model.body_names, model.body_poses(model.standing_q)[0], strict=True))
    joints = []
    for foot in dict.fromkeys(contact.body for contact in robot.contacts if contact.group == FOOT):
        name: str | None = foot
        while name is not None and np.linalg.norm(origins[name] - origins[foot]) < ANKLE:
            joints += [name] if name in robot.driven else []
            name = robot.body(name).parent
    return tuple(dict.fromkeys(joints))


def toppling(model: Model, joints: tuple[str, ...]) -> float:
    """Return weight times height of the centre of mass above some joints, in the standing pose [N m/rad]."""
    poses = zip(model.body_names, *model.body_poses(model.standing_q), strict=True)
    frames = {name: (origin, rotation) for name, origin, rotation in poses}
    height = float(np.mean([frames[name][0][2] for name in joints])) if joints else 0.0
    moment = 0.0
    for body in model.robot.bodies:
        origin, rotation = frames[body.name]
        moment += body.inertial.mass * ((origin + rotation @ np.array(body.inertial.com))[2] - height)
    return float(np.linalg.norm(model.robot.gravity)) * moment


def pitch_stiffness(model: Model, joints: tuple[str, ...]) -> float:
    """Return the sum of position gains of joints, each times the square of its axis' lateral part [N m/rad]."""
    rotations = dict(zip(model.body_names, model.body_poses(model.standing_q)[1], strict=True))
    kp = dict(model.robot.gains.kp)
    lateral = {name: float(rotations[name][1] @ np.array(model.robot.body(name).joint.axis)) for name in joints}
    return sum(kp.get(name, 0.0) * part**2 for name, part in lateral.items() if abs(part) > LATERAL)


def as_text(report: StandingReport) -> str:
    """Return a report as plain text."""
    if report.fall_time is None:
        lines = [f"Without a policy: stands {SECONDS:g} s by its gains, targets held at the standing pose"]
    else:
        lines = [f"Without a policy: falls within {report.fall_time:.1f} s, targets held at the standing pose."]
        lines += _lines_on_gains(report)
    if abs(report.gap) > LARGEST_GAP:
        side = "above" if report.gap > 0 else "below"
        lines.append(
            f"  In the standing pose its lowest contact is {abs(report.gap):.3f} m {side} the ground: check `pose`."
        )
    if report.contacts < report.all_contacts:
        lines.append(f"  Simulated with {report.contacts} of its {report.all_contacts} contacts: {report.choice}.")
    return "\n".join(lines)


def _lines_on_gains(report: StandingReport) -> list[str]:
    lines = [f"  {_line_on_factor('All position gains', report.factor)}"]
    if not report.ankles:
        return lines
    alone = f"Gains of {', '.join(report.ankles)} alone"
    lines.append(f"  {_line_on_factor(alone, report.ankle_factor)}")
    if report.toppling <= 0:
        lines.append("  Its centre of mass is below these joints, so they do not hold it up as ankles do.")
    elif report.stiffness == 0:
        lines.append("  None of these joints turns about the lateral axis, so their gains do not hold it in pitch.")
    else:
        lines.append(
            f"  Weight times height above these joints is {report.toppling:.3g} N m/rad; their gains hold "
            f"{report.stiffness:.3g} against it."
        )
    return lines


def _line_on_factor(gains: str, factor: float | None) -> str:
    if factor is None:
        return f"{gains} would not hold the robot, not even times {FACTORS[-1]:g}."
    return f"{gains} times {factor:g} would hold the robot."


def _smallest_factor(stands: NDArray[np.bool_]) -> float | None:
    """Return the smallest of `FACTORS` from which on the robot stands, if any; `stands` has shape (n,)."""
    always = np.logical_and.accumulate(stands[::-1])[::-1]
    return float(FACTORS[always.argmax()]) if always.any() else None
