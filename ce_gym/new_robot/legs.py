"""Legs and feet of a robot, and a standing pose with bent knees, from its tree of links."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ce_gym.dynamics.standing import Standing
from ce_gym.model.clusters import cluster_tree
from ce_gym.model.description import Body, Robot
from ce_gym.new_robot.solids import Floats, Solids, extremes

FOOT_WORDS = (r"sole", r"foot|feet", r"toe", r"wheel|tire|tyre", r"ankle")
"""Words in the names of feet, the most exact first."""
HAND_WORDS = r"hand|grip|finger|thumb|wrist|arm|palm|claw|head|neck|gaze|eye|camera"
"""Words in the names of leaves that are no feet."""
TRUNK_SHARE = 0.02
"""A body with two or more limbs of at least this share of the robot's mass belongs to the trunk."""
FOOT_BAND = 0.15
"""A foot is at most this share of the robot's height above the lowest one."""
LEG_REACH = 0.6
"""Without names, a limb is a leg if it reaches down at least this share of the lowest limb's reach."""
SIDEWAYS = 0.9
"""A joint bends a leg if the y component of its axis exceeds this."""
STRETCH = {True: 0.95, False: 0.87}
"""Distance of hip and ankle over the length of thigh and shank in the standing pose, of bipeds and of others."""
BENT = 0.1
"""A knee that is bent by more than this in the file keeps its side [rad]."""
STRETCHED = 0.97
"""A leg is bent in the file if the distance of hip and ankle is at most this share of thigh and shank."""
UNDER_HIP = 0.25
"""A foot is below its hip if its horizontal distance is at most this share of the leg's length."""


@dataclass(frozen=True)
class Foot:
    """The last link of a leg.

    Attributes:
        body: Name of the body.
        links: Links of the body with the name of a foot; empty without such names.
        frame: The name by which the foot was found; "" if it is the lowest link of its limb.
        limb: First body of the leg, which the trunk carries.
    """

    body: str
    links: tuple[str, ...]
    frame: str
    limb: str


@dataclass(frozen=True)
class Leg:
    """The joints that bend a leg in its plane.

    Attributes:
        thigh, knee: Bodies that the joints move.
        ankle: Body that the third joint moves; None without such a joint.
        foot: The foot.
    """

    thigh: str
    knee: str
    ankle: str | None
    foot: Foot


def trunk_of(robot: Robot) -> list[str]:
    """Return the base, and the bodies on which several limbs hang."""
    mass = {body.name: body.inertial.mass for body in robot.bodies}
    limbs: dict[str, int] = {}
    for body in reversed(robot.bodies):
        if body.parent is not None:
            mass[body.parent] = mass[body.parent] + mass[body.name]
            limbs[body.parent] = limbs.get(body.parent, 0) + (mass[body.name] >= TRUNK_SHARE * robot.total_mass)
    trunk = [robot.bodies[0].name]
    for body in robot.bodies[1:]:
        inner = body.name in limbs and limbs[body.name] > 1
        if body.kind == "link" and inner and _carries_all(robot, body.name, limbs):
            trunk.append(body.name)
    return trunk


def _carries_all(robot: Robot, name: str, limbs: Mapping[str, int]) -> bool:
    """Whether some heavy limb of a body has at least three joints in a row: a trunk has limbs, a hand has fingers."""
    return any(len(chain(robot, leaf.name, name)) >= 3 for leaf in leaves(robot) if name in ancestors(robot, leaf.name))


def leaves(robot: Robot) -> list[Body]:
    """Return the links that carry no other link."""
    carriers = {body.parent for body in robot.bodies if body.kind == "link"}
    return [body for body in robot.bodies if body.kind == "link" and body.name not in carriers]


def ancestors(robot: Robot, name: str) -> list[str]:
    """Return a body and the bodies that carry it, outwards from the base."""
    names: list[str] = []
    body: str | None = name
    while body is not None:
        names.insert(0, body)
        body = robot.body(body).parent
    return names


def chain(robot: Robot, name: str, carrier: str) -> list[str]:
    """Return the bodies beyond a carrier down to a body."""
    names = ancestors(robot, name)
    return names[names.index(carrier) + 1 :] if carrier in names else names


def limb_of(robot: Robot, name: str, trunk: Sequence[str]) -> list[str]:
    """Return the bodies beyond the trunk down to a body."""
    return [body for body in ancestors(robot, name) if body not in trunk]


def find_feet(robot: Robot, solids: Solids, trunk: Sequence[str], drawn: Standing) -> tuple[list[Foot], list[str]]:
    """Return the feet, and a line for each leg without a foot.

    Args:
        robot: The robot.
        solids: Its shapes.
        trunk: Names of the bodies of the trunk.
        drawn: The robot as its file draws it.
    """
    if not robot.floating:
        return [], []
    limbs = {leaf.name: limb for leaf in leaves(robot) if (limb := limb_of(robot, leaf.name, trunk))}
    lowest = {name: _lowest(solids, name, drawn) for name in limbs}
    top = max((float(drawn.p[limb[0]][2]) for limb in limbs.values()), default=0.0)
    named = {name: names for name in limbs if (names := _foot_names(robot, name))}
    feet: list[Foot] = []
    if named:
        ground = min(lowest[name] for name in named)
        low = [name for name in named if lowest[name] <= ground + FOOT_BAND * (top - ground)]
        for name in low:
            beside = min(lowest[other] for other in low if limbs[other][0] == limbs[name][0])
            if lowest[name] <= beside + 0.3 * FOOT_BAND * (top - ground):
                feet.append(Foot(name, named[name][1], named[name][0], limbs[name][0]))
    else:
        reach = {name: top - z for name, z in lowest.items() if not re.search(HAND_WORDS, name, re.IGNORECASE)}
        reach = reach or dict.fromkeys(lowest, 0.0)
        low = [name for name, r in reach.items() if r >= LEG_REACH * max(reach.values()) and r > 0.0]
        for limb in dict.fromkeys(limbs[name][0] for name in low):
            tip = min((name for name in low if limbs[name][0] == limb), key=lowest.__getitem__)
            feet.append(Foot(tip, (), "", limb))
    return feet, _legs_without_feet(robot, feet, limbs, drawn)


def _lowest(solids: Solids, name: str, standing: Standing) -> float:
    """Return the height of the lowest point of a body against the base [m]."""
    shapes, _ = solids.of_body(name)
    if not shapes:
        return float(standing.p[name][2])
    return float(standing.p[name][2] + extremes(shapes, standing.R[name])[0][2])


def _foot_names(robot: Robot, body: str) -> tuple[str, tuple[str, ...]] | None:
    """Return the most exact name of a foot on a body, and all links with such names."""
    frames = [frame.name for frame in robot.frames if frame.body == body]
    names = [body, *frames, robot.joint_name(body)]
    for word in FOOT_WORDS:
        matches = [name for name in names if re.search(word, name, re.IGNORECASE)]
        if matches:
            links = [name for name in (*frames, body) if re.search("|".join(FOOT_WORDS), name, re.IGNORECASE)]
            return min(matches, key=len), tuple(links)
    return None


def _legs_without_feet(
    robot: Robot, feet: Sequence[Foot], limbs: Mapping[str, Sequence[str]], drawn: Standing
) -> list[str]:
    """Return a line for each limb that is as long as a leg, with as many joints, and has no foot."""
    signatures = [(len(limbs[foot.body]), _length(limbs[foot.body], drawn)) for foot in feet]
    lines = []
    for name, limb in limbs.items():
        if any(foot.limb == limb[0] for foot in feet):
            continue
        alike = any(len(limb) == count and abs(_length(limb, drawn) / length - 1) < 0.1 for count, length in signatures)
        if alike and not re.search(HAND_WORDS, " ".join(limb), re.IGNORECASE):
            lines.append(f"limb {limb[0]!r} is like a leg and has no foot: check whether {name!r} is one")
    return lines


def _length(limb: Sequence[str], standing: Standing) -> float:
    steps = [standing.p[b] - standing.p[a] for a, b in pairwise(limb)]
    return max(float(sum(np.linalg.norm(step) for step in steps)), 1e-6)


def leg_of(robot: Robot, foot: Foot, trunk: Sequence[str], drawn: Standing, is_wheel: bool) -> Leg | None:
    """Return the joints that bend a leg; None if there are fewer than two that turn freely about the lateral axis."""
    links = {body.name for body in robot.bodies if body.kind == "link"}
    clusters = [links.intersection(cluster.bodies) for cluster in cluster_tree(robot).clusters]
    tied = {name for cluster in clusters for name in cluster if len(cluster) > 1}  # a rotor leaves its joint free
    names = limb_of(robot, foot.body, trunk)[: -1 if is_wheel else None]
    bending = [name for name in names if robot.body(name).joint.type == "revolute" and _lateral(robot, name, drawn)]
    if len(bending) < 2 or any(name not in robot.independent or name in tied for name in bending):
        return None
    ankle = bending[-1] if len(bending) > 2 else None
    return Leg(bending[0], bending[1], ankle, foot)


def _lateral(robot: Robot, name: str, standing: Standing) -> float:
    """Return the sign of a joint's axis along y; 0 if the axis is not lateral."""
    y = float((standing.R[name] @ np.array(robot.body(name).joint.axis))[1])
    return float(np.sign(y)) if abs(y) > SIDEWAYS else 0.0


def bend_legs(
    robot: Robot, legs: Sequence[Leg], drawn: Standing, soles: Mapping[str, tuple[Floats, float]]
) -> tuple[dict[str, float], str]:
    """Return joint angles [rad] that place every foot below its hip, all at the same height, and their basis in words.

    Thigh and shank are two bars in the plane of x and z. An ankle keeps the foot as the file draws it.

    Args:
        robot: The robot.
        legs: The legs to bend.
        drawn: The robot as its file draws it.
        soles: For each foot's body, the middle of its contacts against the base, as the file draws it, shape (3,), and
            their radius [m].
    """
    bars = [_bars(leg, drawn, soles[leg.foot.body]) for leg in legs]
    if not bars:
        return {}, "the joints as the file draws them"
    if all(bar.stands for bar in bars):
        return {}, "the joints as the file draws them, with bent knees"
    share = STRETCH[len(legs) == 2]
    ground = max(bar.hip[1] - share * bar.length - bar.below for bar in bars)
    angles: dict[str, float] = {}
    for leg, bar in zip(legs, bars, strict=True):
        target = np.array([0.0, ground + bar.below - bar.hip[1]])
        angles |= _bent(robot, leg, bar, target, drawn, forward=len(legs) == 2)
    return angles, f"feet below the hips, at {share:g} of the length of thigh and shank"


@dataclass(frozen=True)
class _Bars:
    """Thigh and shank in the plane of x and z, as the file draws them [m].

    Attributes:
        hip: Place of the hip.
        thigh: From the hip to the knee.
        shank: From the knee to the ankle; without an ankle, to the middle of the foot's contacts.
        below: Height of that point above the ground.
    """

    hip: Floats
    thigh: Floats
    shank: Floats
    below: float

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.thigh) + np.linalg.norm(self.shank))

    @property
    def bend(self) -> float:
        """Angle from the thigh to the shank about y [rad]."""
        return _wrapped(_angle(self.shank) - _angle(self.thigh))

    @property
    def stands(self) -> bool:
        """Whether the knee is bent and the foot is below the hip."""
        distance, offset = np.linalg.norm(self.thigh + self.shank), abs((self.thigh + self.shank)[0])
        return bool(distance <= STRETCHED * self.length and offset < UNDER_HIP * self.length)


def _bars(leg: Leg, drawn: Standing, sole: tuple[Floats, float]) -> _Bars:
    hip, knee = drawn.p[leg.thigh][[0, 2]], drawn.p[leg.knee][[0, 2]]
    middle, radius = sole
    tip = middle[[0, 2]] if leg.ankle is None else drawn.p[leg.ankle][[0, 2]]
    return _Bars(hip, knee - hip, tip - knee, float(tip[1] - middle[2]) + radius)


def _angle(v: Floats) -> float:
    """Return the angle about y of a vector (x, z) against the z axis [rad]."""
    return float(np.arctan2(v[0], v[1]))


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _bent(robot: Robot, leg: Leg, bars: _Bars, target: Floats, drawn: Standing, forward: bool) -> dict[str, float]:
    """Return the angles of a leg whose ankle is at a target (x, z) against the hip [m]."""
    names = [leg.thigh, leg.knee, *([leg.ankle] if leg.ankle else [])]
    signs = [_lateral(robot, name, drawn) for name in names]
    start = np.array([drawn.q[name] for name in names])
    a, b = np.linalg.norm(bars.thigh), np.linalg.norm(bars.shank)
    cosine = (target @ target - a * a - b * b) / (2 * a * b)
    best: tuple[float, Floats] | None = None
    for side in (1.0, -1.0):
        bend = side * float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        knee = _wrapped(bend - bars.bend)
        c, s = np.cos(knee), np.sin(knee)
        shank = np.array([c * bars.shank[0] + s * bars.shank[1], c * bars.shank[1] - s * bars.shank[0]])
        thigh = _wrapped(_angle(target) - _angle(bars.thigh + shank))
        turns = np.array([thigh, knee, -thigh - knee])[: len(names)]
        angles = start + np.array(signs) * turns
        limits = np.array([robot.body(name).joint.position for name in names])
        beyond = float(np.abs(np.clip(angles, limits[:, 0], limits[:, 1]) - angles).sum())
        preferred = np.sign(bars.bend) == side if abs(bars.bend) > BENT else (side > 0) == forward
        cost = beyond + (0.0 if preferred else 0.05)
        if best is None or cost < best[0]:
            best = cost, np.clip(angles, limits[:, 0], limits[:, 1])
    assert best is not None
    return dict(zip(names, best[1].tolist(), strict=True))
