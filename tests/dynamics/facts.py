"""Robots made from the published figures in tests/data/facts, without files of ours in between."""

from __future__ import annotations

from math import cos, radians, sin
from pathlib import Path

import numpy as np
import yaml

from ce_gym.model import (
    Body,
    Constraint,
    Inertial,
    Joint,
    LinearConstraint,
    LoopConstraint,
    Placement,
    Pose,
    Robot,
    RodConstraint,
)
from ce_gym.model.formats.placement import rotation_from_rpy

FACTS = Path(__file__).parents[1] / "data" / "facts"


def load_facts(name: str) -> dict:
    return yaml.load((FACTS / f"{name}.yaml").read_text(), yaml.CSafeLoader)


def robot_from_facts(name: str, independent: list[str] | None = None, at: dict[str, float] | None = None) -> Robot:
    """Make a robot; `at` is the configuration that decides how loops are assembled."""
    facts = load_facts(name)
    bodies = [_body(entry) for entry in facts["bodies"]]
    constraints, chosen = [], []
    for cluster in facts["clusters"]:
        cranks, ties = _constraints(cluster)
        bodies += cranks
        constraints += ties
        chosen += cluster["constraint"].get("independent", [])
    independent = chosen if independent is None else independent
    at = at or {}
    return Robot(
        name=name,
        bodies=tuple(bodies),
        constraints=tuple(constraints),
        independent=tuple(independent),
        pose=Pose(joints=tuple((k, v) for k, v in at.items() if k in independent)),
        assembly=tuple((k, v) for k, v in at.items() if k not in independent),
        gravity=tuple(facts["gravity"]),
    )


def _body(entry: dict) -> Body:
    placement, inertial = entry["placement"], entry["inertial"]
    xx, xy, xz, yy, yz, zz = inertial["inertia"]
    rotation = rotation_from_rpy(*placement["rpy"])
    if "R" in placement:
        rotation = tuple(map(tuple, np.array(placement["R"], dtype=float).reshape(3, 3)))
    joint = Joint(entry["joint"]["type"], tuple(map(float, entry["joint"].get("axis", (0, 0, 1)))))
    return Body(
        name=entry["name"],
        kind="rotor" if entry["kind"] == "rotor" else "link",
        parent=None if entry["parent"] == "ground" else entry["parent"],
        placement=Placement(tuple(placement["xyz"]), rotation),
        joint=joint,
        inertial=Inertial(inertial["mass"], tuple(inertial["com"]), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))),
    )


def _constraints(cluster: dict) -> tuple[list[Body], list[Constraint]]:
    """Return massless cranks, which the published models leave out, and constraints."""
    tie, name = cluster["constraint"], cluster["name"]
    if tie["type"] == "linear":
        rows = [{b: float(k) for b, k in zip(cluster["bodies"], row, strict=True) if k} for row in tie["K"]]
        return [], [LinearConstraint(f"{name}_{i}", tuple(row.items())) for i, row in enumerate(rows)]
    if tie["type"] == "planar_point_loop":
        return [], [_pin(name, loop["predecessor"], loop["successor"]) for loop in tie["loops"]]
    if tie["type"] == "planar_four_bar":
        ends = [{"body": p["joints"][-1], "point": [p["lengths"][-1], 0, 0]} for p in (tie["path1"], tie["path2"])]
        return [], [_pin(name, *ends)]
    if tie["type"] == "tello_hip_differential":
        return _hip(tie, name)
    if tie["type"] == "tello_knee_ankle_differential":
        return _knee_ankle(tie, name)
    return [], []


def _pin(name: str, first: dict, second: dict) -> LoopConstraint:
    placements = [Placement(tuple(map(float, end["point"]))) for end in (first, second)]
    return LoopConstraint(name, "revolute", first["body"], second["body"], *placements)


def _crank(name: str, parent: str, position: tuple[float, float, float]) -> Body:
    massless = Inertial(0.0, (0.0, 0.0, 0.0), ((0.0,) * 3,) * 3)
    return Body(name, "link", parent, Placement(position), Joint("revolute", (0.0, 1.0, 0.0)), massless)


def _hip(tie: dict, name: str) -> tuple[list[Body], list[Constraint]]:
    """Two cranks of 80 mm on the clamp, 155 mm rods to the thigh, as in the published `phi`, in millimetres."""
    clamp = name.replace("differential", "clamp")
    cranks, ties = [], []
    for i, side in ((1, 1.0), (2, -1.0)):
        crank = f"{name}-crank-{i}"
        cranks.append(_crank(crank, clamp, (0.0, 0.07 * side, 0.0)))
        ties.append(LinearConstraint(f"{crank}-gear", ((tie[f"rotor_{i}"], 1.0), (crank, -tie["gear_ratio"]))))
        points = (-0.08, 0.0, 0.0), (-0.08, 0.07 * side, 0.0)
        ties.append(RodConstraint(f"{crank}-rod", crank, tie["link_2"], *points, 0.155))
    return cranks, ties


def _knee_ankle(tie: dict, name: str) -> tuple[list[Body], list[Constraint]]:
    """A crank of 40 mm on the shin, which the rotors turn against each other, and a rod of 214.6 mm to the foot."""
    tilt, at_crank, at_foot = radians(20.0), radians(90.0 - 59.16), radians(90.0 - 66.0)
    crank = _crank(f"{name}-crank", tie["link_1"], (-0.042 * sin(tilt), 0.0, -0.042 * cos(tilt)))
    ratio = tie["gear_ratio"]
    gears = [
        LinearConstraint(f"{name}-{i}", ((tie[f"rotor_{i}"], 1.0), (tie["link_1"], -ratio), (crank.name, side * ratio)))
        for i, side in ((1, 1.0), (2, -1.0))
    ]
    points = [(r * cos(a), 0.0, -r * sin(a)) for r, a in ((0.04, at_crank), (0.035, at_foot))]
    return [crank], [*gears, RodConstraint(f"{name}-rod", crank.name, tie["link_2"], points[0], points[1], 0.2146)]
