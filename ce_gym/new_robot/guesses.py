"""Guesses of the feet, trunk, standing pose, limits and gains of a robot whose files lack them.

These rules of thumb only fill the template of `python -m ce_gym new`, which a person then checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ce_gym.dynamics.model import Model
from ce_gym.dynamics.standing import Standing, standing_pose
from ce_gym.dynamics.standing_load import load_of, placeholders
from ce_gym.model.description import ContactSphere, Pose, Robot
from ce_gym.model.formats.pose import touching_height
from ce_gym.new_robot.contacts import GuessedContact, foot_contacts, is_wheel, trunk_contacts
from ce_gym.new_robot.gains import likely_gains, likely_torque, velocity_settings
from ce_gym.new_robot.legs import Foot, bend_legs, find_feet, leg_of, limb_of, trunk_of
from ce_gym.new_robot.solids import Floats, Solids, place

MOST_CONTACTS = 60
"""More contacts of an MJCF file than this are replaced: the time to compile grows with the square of their number."""
UNEVEN = 0.002
"""Largest difference of the heights of feet in the standing pose [m]."""
BACKWARDS = 0.01
"""Feet point backwards if the middle of each sole is further behind the ankle [m]."""
CLEAR = 0.01
"""A torso contact that is lower in the standing pose is reported [m]."""


@dataclass(frozen=True)
class Guesses:
    """Guessed data; empty for data that the files have.

    Attributes:
        contacts: Feet and trunk; empty if the contacts of the MJCF file are used.
        replaced: Why the contacts of an MJCF file are not used; "" if they are, or if there are none.
        pose: Joint angles [rad], and the height at which the feet just touch the ground [m].
        has_auto_height: Whether the reader of YAML files finds that height.
        pose_basis: Basis of the pose in words.
        torques: Torque limits in place of placeholders, by joint [N m].
        given_torques: The placeholders, by joint [N m].
        gains: Position and velocity gains, by joint.
        task: Arguments of the velocity task.
        wheels: Bodies that are wheels.
        warnings: A line for each thing that a person has to check.
    """

    contacts: tuple[GuessedContact, ...]
    replaced: str
    pose: Pose
    has_auto_height: bool
    pose_basis: str
    torques: dict[str, float]
    given_torques: dict[str, float]
    gains: dict[str, tuple[float, float]]
    task: dict[str, Any]
    wheels: tuple[str, ...]
    warnings: tuple[str, ...]


def guess(robot: Robot, has_pose: bool) -> Guesses:
    """Guess the data that tasks need and that the files of a robot lack.

    Args:
        robot: The robot as its file describes it.
        has_pose: Whether the standing pose comes from the file; if not, legs are bent.
    """
    solids, trunk = Solids(robot), trunk_of(robot)
    angles = dict(robot.pose.joints)
    is_drawn_at_zero = not (has_pose or robot.assembly or any(not tie.linear for tie in robot.constraints))
    drawn = place(robot, {} if is_drawn_at_zero else angles)
    feet, warnings = find_feet(robot, solids, trunk, drawn)
    wheels = [foot.body for foot in feet if is_wheel(robot, foot, solids, drawn)]
    pose_basis, standing = "as in the file", place(robot, angles)
    if not has_pose:
        for _ in range(2):  # the lowest point of a round foot depends on the pose
            soles = _soles(robot, feet, solids, drawn, standing, wheels)
            legs = [leg for foot in feet if (leg := leg_of(robot, foot, trunk, drawn, foot.body in wheels))]
            bent, pose_basis = bend_legs(robot, legs, drawn, soles)
            standing = place(robot, angles | bent)
        angles |= bent
    contacts = [c for foot in feet for c in foot_contacts(robot, foot, solids, standing, foot.body in wheels)]
    contacts += trunk_contacts(robot, trunk, solids) if robot.floating else []
    replaced = _reason_to_replace(robot, feet, wheels)
    if robot.contacts and not replaced:
        contacts, spheres = [], list(robot.contacts)
    else:
        spheres = [sphere for contact in contacts for sphere in contact.spheres()]
        warnings += [f"contact {c.name!r}: {c.basis}; check its place" for c in contacts if not c.reliable]
    soles_found = [c for c in spheres if c.group == "foot"]
    warnings += _warnings_on_heights(robot, spheres, standing)
    ankles = [leg.foot.body for foot in feet if (leg := leg_of(robot, foot, trunk, drawn, False)) and leg.ankle]
    warnings += _warnings_on_soles(spheres, standing, [body for body in ankles if body not in wheels])
    lowest = min((c.lowest_point(standing.p[c.body], standing.R[c.body]) for c in spheres), default=-robot.pose.height)
    height = round(-lowest, 6) + 0.0 if robot.floating else robot.pose.height
    pose = Pose(height, tuple(angles.items()), robot.pose.balls)
    posed = replace(robot, pose=replace(pose, height=0.0), contacts=())
    mechanism = Model(posed).mechanism
    load = load_of(mechanism, standing_pose(mechanism), soles_found)
    unknown = placeholders(robot, load)
    leg_joints = [body for foot in feet for body in limb_of(robot, foot.body, trunk) if body not in wheels]
    return Guesses(
        tuple(contacts),
        replaced,
        pose,
        touching_height(replace(posed, contacts=tuple(spheres))) is not None,
        pose_basis,
        dict.fromkeys(unknown, likely_torque(load)),
        {name: robot.body(name).joint.torque for name in unknown},
        {} if robot.gains.kp else likely_gains(robot, load, leg_joints, len(feet) or 1),
        velocity_settings(robot, load, leg_joints, len(feet) == 2 and not wheels) if feet else {},
        tuple(wheels),
        (*warnings, *(note for note in robot.notes if "inclination of the base" in note)),
    )


def _soles(
    robot: Robot, feet: Sequence[Foot], solids: Solids, drawn: Standing, standing: Standing, wheels: Sequence[str]
) -> dict[str, tuple[Floats, float]]:
    """Return middle and radius of the contacts of each foot in a standing pose, placed as the file draws it."""
    soles = {}
    for foot in feet:
        contacts = foot_contacts(robot, foot, solids, standing, foot.body in wheels)
        spheres = [sphere for contact in contacts for sphere in contact.spheres()]
        p, R = drawn.p[foot.body], drawn.R[foot.body]
        middle = np.mean([p + R @ np.array(sphere.position) for sphere in spheres], axis=0)
        soles[foot.body] = middle, float(np.mean([sphere.radius + sphere.rim for sphere in spheres]))
    return soles


def _reason_to_replace(robot: Robot, feet: Sequence[Foot], wheels: Sequence[str]) -> str:
    """Return why the contacts of an MJCF file are not used; "" if they are."""
    if not (robot.contacts and robot.floating):
        return ""
    feet_found = {contact.body for contact in robot.contacts if contact.group == "foot"}
    lacking = [foot.body for foot in feet if foot.body not in feet_found]
    if lacking:
        return f"the MJCF file has no low contact on {', '.join(lacking)}"
    if not any(contact.group == "torso" for contact in robot.contacts):
        return "the MJCF file has no contact on the trunk"
    if wheels:
        return f"{', '.join(wheels)} roll"
    if len(robot.contacts) > MOST_CONTACTS:
        return f"the MJCF file has {len(robot.contacts)} contacts, which take minutes to compile"
    return ""


def _warnings_on_soles(spheres: Sequence[ContactSphere], standing: Standing, ankles: Sequence[str]) -> list[str]:
    """Return lines on feet with ankles that touch in one point, and on feet that point backwards.

    Args:
        spheres: The contacts.
        standing: The standing pose.
        ankles: Bodies of the feet that an ankle moves.
    """
    soles = {body: [c for c in spheres if c.body == body and c.group == "foot"] for body in ankles}
    lines = [
        f"foot {body!r} has an ankle and touches the ground in one point: turn the ankle until its sole is flat"
        for body, contacts in soles.items()
        if len(contacts) == 1
    ]
    ahead = [
        float(np.mean([(standing.R[body] @ np.array(c.position))[0] for c in contacts]))
        for body, contacts in soles.items()
        if len(contacts) > 1
    ]
    if ahead and max(ahead) < -BACKWARDS:
        lines.append("the feet point backwards: x of the base must point forward for the commands of tasks")
    return lines


def _warnings_on_heights(robot: Robot, spheres: Sequence[ContactSphere], standing: Standing) -> list[str]:
    """Return lines on feet that do not touch together, and on trunk contacts below the feet."""
    heights: dict[str, float] = {}
    for c in spheres:
        if c.group == "foot":
            heights[c.body] = min(heights.get(c.body, np.inf), c.lowest_point(standing.p[c.body], standing.R[c.body]))
    if not robot.floating or not heights:
        return ["no feet: no link is named like one or hangs low"] if robot.floating else []
    lines, ground = [], min(heights.values())
    raised = {name: z - ground for name, z in heights.items() if z > ground + UNEVEN}
    if raised:
        above = ", ".join(f"{name} by {1000 * z:.0f} mm" for name, z in raised.items())
        lines.append(f"these feet are above the ground in the standing pose: {above}; check `pose`")
    torso = [c.lowest_point(standing.p[c.body], standing.R[c.body]) for c in spheres if c.group == "torso"]
    if torso and min(torso) < ground + CLEAR:
        lines.append(f"a torso contact is {min(torso) - ground:.3f} m above the ground, which would end every episode")
    if len(heights) % 2:
        lines.append(f"an odd number of feet: {', '.join(heights)}")
    return lines
