"""The mechanism of a robot for MJCF: rotors that are too light to be bodies of MuJoCo become armature.

MuJoCo refuses bodies below 1e-15 kg m^2, and a gear multiplies any added rotor inertia by its squared ratio. A lighter
rotor, or one with a ratio as large as the placeholder of an unknown ratio (see `model/formats/mjcf/rotors.py`), becomes
armature at `exact`, too. Armature neglects the rotor's own inertia over the ratio: an error below 1 / LARGEST_RATIO of
the reflected inertia.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ce_gym.export.joint_ties import Tie, joint_ties
from ce_gym.model.description import Body, Robot
from ce_gym.model.mechanism import Mechanism, build_mechanism, seen_from_parent

SMALLEST_INERTIA = 1e-13
"""Moment of inertia given to a body without any [kg m^2]; MuJoCo refuses moving bodies without inertia."""

LARGEST_RATIO = 1e5
"""Rotors with at least this gear ratio become armature; real gears have far smaller ratios."""


def mjcf_mechanism(robot: Robot, level: str) -> Mechanism:
    """Return the mechanism to write as MJCF; arguments and errors as in `build_mechanism`."""
    mechanism = build_mechanism(robot, level, eliminate=False)
    if level != "exact":
        return mechanism
    ties = joint_ties(mechanism)
    light = {rotor.name: rotor for rotor in robot.rotors() if _is_light(robot, rotor, ties)}
    if not light:
        return mechanism
    bodies = {name: moving for name, moving in mechanism.bodies.items() if name not in light}
    for rotor in light.values():
        if rotor.parent is not None:
            carrier = bodies[rotor.parent]
            bodies[rotor.parent] = replace(carrier, inertia=carrier.inertia + seen_from_parent(rotor))
    reflected = build_mechanism(robot, "coupled").eliminated_rotors
    rotors = tuple(tuple(rotor for rotor in cluster if rotor.name in light) for cluster in reflected)
    return replace(mechanism, bodies=bodies, eliminated_rotors=rotors)


def largest_ratio(tie: Tie) -> float:
    """Return the largest gear ratio between a rotor and a joint that drives it; 1 if none does."""
    return max((abs(ratio) for ratio in tie.ratios.values()), default=1.0)


def _is_light(robot: Robot, rotor: Body, ties: Mapping[str, Tie]) -> bool:
    """Whether a rotor becomes armature; a rotor with other functions than to spin behind a gear stays a body."""
    tie, joint, used = ties[rotor.name], rotor.joint, {body.parent for body in robot.bodies}
    used |= {contact.body for contact in robot.contacts}
    used |= {body for constraint in robot.constraints if not constraint.linear for body in constraint.bodies}
    if rotor.name in used or rotor.name in tie.ratios or joint.friction or joint.damping or joint.stiffness:
        return False
    axis = np.array(joint.axis)
    moment = float(axis @ np.array(rotor.inertial.inertia) @ axis)
    return largest_ratio(tie) >= LARGEST_RATIO or moment < SMALLEST_INERTIA
