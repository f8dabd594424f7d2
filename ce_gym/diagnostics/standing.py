"""Whether a robot's position gains carry it: targets held at the standing pose, no policy, half a minute.

Simulated, since soft soles, torque limits, springs and what sags count besides the gains. Beside it stands what an
inverted pendulum needs: it is upright only while the joints next to the feet, all together, are stiffer than its weight
is high.
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
"""How long it must stand, and the sub-step [s]."""
PUSH = 0.02
"""Speed of the base at the start, in each of four directions [m/s]."""
TILT, SUNK = 0.5, 0.6
"""When it has fallen: more than this off upright [rad], or its base below this share of the standing height."""
FACTORS = np.round(2.0 ** np.arange(0.0, 6.5, 0.5), 1)
"""Factors on gains that are tried, 1 to 64; the velocity gains go with their root."""
FOOT, ANKLE = "foot", 0.05
"""Group of the contacts that carry, and how far from a foot's own joint others count as next to it [m]."""
MOST_CONTACTS = 24
"""How many contacts a robot stands with at most: the time to compile grows with their square."""
LATERAL = 1e-3
"""Lateral part of a joint's axis from which the joint turns about the lateral axis; below, it is rounding [-]."""
PUSHES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True)
class StandingReport:
    """Whether a robot stands by its position gains, and what would carry it.

    Attributes:
        after: When the first of its copies has fallen [s]; None if all stand.
        ankles: The joints next to the feet.
        ankle_factor: Smallest of `FACTORS` on their gains alone with which it stands; None if there is none.
        factor: The same of all gains.
        toppling: Weight times height of the centre of mass above those joints [N m/rad].
        stiffness: Sum of the position gains of those of them that turn about the base's lateral axis [N m/rad].
        gap: Height of the lowest contact above the ground in the standing pose [m].
        contacts: How many contacts it stood with, see `carrying_contacts`.
        which: Which they are, in words.
        of_contacts: How many the robot has.
    """

    after: float | None
    ankles: tuple[str, ...]
    ankle_factor: float | None
    factor: float | None
    toppling: float
    stiffness: float
    gap: float
    contacts: int
    which: str
    of_contacts: int


def report_standing(model: Model) -> StandingReport:
    """Let a robot stand, pushed a little each way, with the gains that it has and with stiffer ones.

    Args:
        model: Of a robot that tasks can have: with a floating base, feet, a standing pose and gains.
    """
    robot, ankles = model.robot, joints_at_feet(model)
    near = np.array([name in ankles for name in robot.commanded])
    scales = np.where(near, FACTORS[:, None], 1.0), np.repeat(FACTORS[:, None], len(near), 1)
    falls = fallen_after(model, np.concatenate(scales))
    alone, all_ = (_smallest(np.isinf(part)) for part in np.split(falls, 2))
    after = None if np.isinf(falls[0]) else float(falls[0])
    contacts, which = carrying_contacts(model)
    return StandingReport(
        after=after,
        ankles=ankles,
        ankle_factor=alone,
        factor=all_,
        toppling=toppling(model, ankles),
        stiffness=pitch_stiffness(model, ankles),
        gap=float(contact_heights(model).min()),
        contacts=len(contacts),
        which=which,
        of_contacts=len(robot.contacts),
    )


def carrying_contacts(model: Model) -> tuple[tuple[str, ...], str]:
    """Return the contacts that a robot stands with, and which they are in words: all of them up to `MOST_CONTACTS`.

    Of more, those of the feet and the torso; of the feet alone if these are too many; and of those the lowest.
    """
    contacts = model.robot.contacts
    if len(contacts) <= MOST_CONTACTS:
        return model.contact_names, "all"
    both = tuple(contact.name for contact in contacts if contact.group in (FOOT, "torso"))
    feet = tuple(contact.name for contact in contacts if contact.group == FOOT)
    if len(both) <= MOST_CONTACTS:
        return both, "those of the groups foot and torso"
    if len(feet) <= MOST_CONTACTS:
        return feet, "those of the group foot"
    heights = dict(zip(model.contact_names, contact_heights(model), strict=True))
    lowest = set(sorted(feet, key=lambda name: heights[name])[:MOST_CONTACTS])
    return tuple(name for name in feet if name in lowest), "the lowest of the group foot"


def seconds_to_compile(model: Model) -> float:
    """Return roughly how long the kernel of a standing robot takes to compile [s]: measured with 8 to 240 contacts."""
    n = len(carrying_contacts(model)[0])
    return 2.0 + 0.3 * n + 0.01 * n**2


def contact_heights(model: Model) -> Array:
    """Return the height of the lowest point of each contact in the standing pose, upright wheels aside [m]."""
    centres = model.contact_points(model.standing_q, np.zeros(model.nv))[0]
    return centres[:, 2] - np.array([contact.radius + contact.rim for contact in model.robot.contacts])


def fallen_after(model: Model, scales: Array) -> Array:
    """Return when the first of four copies has fallen, shape (n,) [s]; infinite where all stand for `SECONDS`.

    Args:
        model: Of the robot.
        scales: Factors on the position gains, shape (n, n_joints); those on the velocity gains are their roots.
    """
    sim = Simulator(
        model,
        len(scales) * len(PUSHES),
        DT,
        contacts=carrying_contacts(model)[0],
        outputs=(),
        parameters=("kp", "kd"),
    )
    gains = {"kp": dict(model.robot.gains.kp), "kd": dict(model.robot.gains.kd)}
    for name, factors in (("kp", scales), ("kd", np.sqrt(scales))):
        own = np.array([gains[name].get(joint, 0.0) for joint in model.robot.commanded])
        sim.set_parameter(name, np.repeat(factors * own, len(PUSHES), 0))
    v = np.zeros((sim.num_envs, model.nv))
    v[:, 3:5] = PUSH * np.tile(PUSHES, (len(scales), 1))
    sim.set_state(np.broadcast_to(model.standing_q, (sim.num_envs, model.nq)), v)
    standing = model.standing_q[model.robot.layout.joints_q :][: len(sim.target_names)]  # what stretches comes after
    after, every = np.full(sim.num_envs, np.inf), round(0.1 / DT)
    for i in range(round(SECONDS / (every * DT))):
        sim.step(standing, every)
        now = has_fallen(model.robot, np.asarray(sim.q)) | np.asarray(sim.diverged, bool)
        after[now & np.isinf(after)] = (i + 1) * every * DT
    return after.reshape(len(scales), len(PUSHES)).min(1)


def has_fallen(robot: Robot, q: Array) -> NDArray[np.bool_]:
    """Return which robots are down or on the way, given their positions, shape (n, nq)."""
    upright = 1.0 - 2.0 * (q[:, 4] ** 2 + q[:, 5] ** 2)  # cosine of the angle between the base's z and the world's
    return ~((upright > np.cos(TILT)) & (q[:, 2] > SUNK * robot.pose.height))


def joints_at_feet(model: Model) -> tuple[str, ...]:
    """Return the driven joints of the bodies with foot contacts, and those that lie next to these, as in an ankle."""
    robot, at = model.robot, dict(zip(model.body_names, model.body_poses(model.standing_q)[0], strict=True))
    found = []
    for body in dict.fromkeys(contact.body for contact in robot.contacts if contact.group == FOOT):
        name: str | None = body
        while name is not None and np.linalg.norm(at[name] - at[body]) < ANKLE:
            found += [name] if name in robot.driven else []
            name = robot.body(name).parent
    return tuple(dict.fromkeys(found))


def toppling(model: Model, joints: tuple[str, ...]) -> float:
    """Return weight times height of the centre of mass above some joints, in the standing pose [N m/rad]."""
    places = zip(model.body_names, *model.body_poses(model.standing_q), strict=True)
    placed = {name: (origin, rotation) for name, origin, rotation in places}
    mean = float(np.mean([placed[name][0][2] for name in joints])) if joints else 0.0
    moment = 0.0
    for body in model.robot.bodies:
        origin, rotation = placed[body.name]
        moment += body.inertial.mass * ((origin + rotation @ np.array(body.inertial.com))[2] - mean)
    return float(np.linalg.norm(model.robot.gravity)) * moment


def pitch_stiffness(model: Model, joints: tuple[str, ...]) -> float:
    """Return the sum of position gains of joints, each by the square of its axis' lateral part [N m/rad]."""
    rotations = dict(zip(model.body_names, model.body_poses(model.standing_q)[1], strict=True))
    kp = dict(model.robot.gains.kp)
    lateral = {name: float(rotations[name][1] @ np.array(model.robot.body(name).joint.axis)) for name in joints}
    return sum(kp.get(name, 0.0) * part**2 for name, part in lateral.items() if abs(part) > LATERAL)


def _smallest(stands: NDArray[np.bool_]) -> float | None:
    """Return the smallest factor with which it stands, as it does with all larger ones; None if there is none."""
    lasting = np.logical_and.accumulate(stands[::-1])[::-1]
    return float(FACTORS[lasting.argmax()]) if lasting.any() else None
