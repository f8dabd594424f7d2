"""Tables of a robot's joints, contacts and masses, and findings about its file: the first part of `inspect ROBOT`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ce_gym.dynamics.model import Model
from ce_gym.dynamics.standing import Standing, contact_heights, standing_pose
from ce_gym.dynamics.standing_load import PLACEHOLDER, Load, load_of, placeholders
from ce_gym.envs.runtime.symmetry import MAX_DISTANCE, REFLECTION
from ce_gym.model.description import Body, Robot
from ce_gym.model.table import Cell, table_text

JOINT_COLUMNS = ("joint", "axis", "range", "torque", "load", "speed", "kp", "kd", "angle", "mass [kg]")
CONTACT_COLUMNS = ("contact", "group", "link", "height [mm]", "radius [mm]")
MOST_CONTACTS = 50
"""More contacts take long to compile."""
TOUCHING = 0.002
"""A foot touches the ground up to this height [m]."""
CLEAR = 0.01
"""A torso contact below this height ends episodes at once [m]."""
UNLIKE = 0.02
"""Masses of a joint's partner on the other side that differ by more than this share are reported."""
MOST_NAMES = 4


def robot_report(model: Model) -> str:
    """Return tables of joints, contacts and masses of a robot, and findings, as plain text."""
    robot, standing = model.robot, standing_pose(model.mechanism)
    load = load_of(model.mechanism, standing, [c for c in robot.contacts if c.group == "foot"])
    links = [body for body in robot.bodies if body.kind == "link"]
    lines = [
        "Joints: axis in the standing pose; range and angle [rad, m], torque and load [N m, N], speed [rad/s, m/s].",
        "`load` holds the standing robot, whose feet share the weight. `mass` is the mass of the link that moves.",
        table_text(JOINT_COLUMNS, [_joint_row(robot, body, standing, load) for body in links if body.joint.nv == 1]),
    ]
    if robot.contacts:
        heights = contact_heights(robot, standing)
        rows = [(c.name, c.group, c.body, 1000 * heights[c.name], 1000 * (c.radius + c.rim)) for c in robot.contacts]
        heading = "Contacts, and the height of their lowest point above the ground in the standing pose"
        lines += ["", heading, table_text(CONTACT_COLUMNS, [_tidy(row) for row in rows])]
    base = f", {robot.bodies[0].inertial.mass:.3f} kg of them the base" if robot.floating else ""
    height = f"; centre of mass {load.height:.3f} m above the feet" if robot.floating and robot.contacts else ""
    lines += ["", f"Mass {robot.total_mass:.3f} kg{base}{height}."]
    found = list(findings(model, standing, load))
    lines += ["", "Findings", *(f"  - {line}" for line in found)] if found else ["", "Findings: none"]
    return "\n".join(lines)


def _joint_row(robot: Robot, body: Body, standing: Standing, load: Load) -> tuple[Cell, ...]:
    joint, kp, kd = body.joint, dict(robot.gains.kp), dict(robot.gains.kd)
    return (
        robot.joint_name(body.name),
        axis_text(standing.R[body.name] @ np.array(joint.axis)),
        "any" if np.isinf(joint.position).all() else f"{joint.position[0]:.3g} to {joint.position[1]:.3g}",
        "none given" if joint.torque == np.inf else f"{joint.torque:.4g}",
        f"{abs(load.torques[body.name]):.3g}" if body.name in load.torques else "",
        "none given" if joint.velocity == np.inf else f"{joint.velocity:.4g}",
        f"{kp[body.name]:.4g}" if body.name in kp else "",
        f"{kd[body.name]:.4g}" if body.name in kd else "",
        f"{standing.q.get(body.name, 0.0):.3f}",
        f"{body.inertial.mass:.3f}",
    )


def axis_text(axis: np.ndarray) -> str:
    """Return a unit vector as the name of a coordinate axis such as "-y" if it is one, else as three numbers."""
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > 1 - 1e-6:
        return f"{'-' if axis[largest] < 0 else ''}{'xyz'[largest]}"
    return " ".join(f"{x + 0.0:.2f}" for x in axis.round(2))


def _tidy(row: tuple[Cell, ...]) -> tuple[Cell, ...]:
    return tuple(f"{round(cell, 1) + 0.0:.1f}" if isinstance(cell, float) else cell for cell in row)


def findings(model: Model, standing: Standing, load: Load) -> Iterator[str]:
    """Iterate over lines about a robot's file that its author should check."""
    robot = model.robot
    limits = {name: robot.body(name).joint.torque for name in robot.driven}
    if robot.floating and (unknown := placeholders(robot, load)):
        given = ", ".join(sorted({"no limit" if limits[name] == np.inf else f"{limits[name]:g}" for name in unknown}))
        yield (
            f"torque limits like placeholders ({given}), above {PLACEHOLDER:g} times weight times height, "
            f"{PLACEHOLDER * load.toppling:.3g} N m: {_names(robot, unknown)}; `limits: torque` gives others"
        )
    weak = [name for name, limit in limits.items() if 0.0 < limit < abs(load.torques.get(name, 0.0))]
    if robot.floating and weak:
        yield f"torque limits below the load of the standing pose: {_names(robot, weak)}"
    kd = dict(robot.gains.kd)
    undamped = [name for name in robot.driven if kd.get(name) == 0.0 and robot.body(name).joint.damping == 0.0]
    if undamped:
        yield f"no velocity gain and no damping: {_names(robot, undamped)}"
    if robot.unknown_ratios:
        yield f"gear ratios unknown: {_listed(list(robot.unknown_ratios))}; `gears` or `rotors` give them"
    if robot.floating:
        yield from _contact_findings(robot, contact_heights(robot, standing))
        yield from _asymmetries(robot, standing)


def _contact_findings(robot: Robot, heights: dict[str, float]) -> Iterator[str]:
    groups = {group: [c for c in robot.contacts if c.group == group] for group in ("foot", "torso")}
    if not groups["torso"]:
        yield "no contact of group torso, so an episode does not end when the trunk falls on the ground"
    lowest: dict[str, float] = {}
    for c in groups["foot"]:
        lowest[c.body] = min(lowest.get(c.body, np.inf), heights[c.name])
    raised = [f"{body} by {1000 * z:.0f} mm" for body, z in lowest.items() if abs(z) > TOUCHING]
    if raised:
        yield f"feet off the ground in the standing pose: {', '.join(raised[:MOST_NAMES])}; check height and angles"
    low = [c.name for c in groups["torso"] if heights[c.name] < CLEAR]
    if low:
        yield f"contacts of group torso on the ground in the standing pose: {', '.join(low[:MOST_NAMES])}"
    if len(robot.contacts) > MOST_CONTACTS:
        yield f"{len(robot.contacts)} contacts: the time to compile grows with the square of their number"


def _asymmetries(robot: Robot, standing: Standing) -> Iterator[str]:
    """Iterate over differences of left and right: joints without a partner, and masses of partners."""
    origins = {name: standing.p[name] for name in robot.commanded}
    alone, unlike = [], []
    for name, origin in origins.items():
        distance = {other: float(np.linalg.norm(origin * REFLECTION - at)) for other, at in origins.items()}
        partners = [
            other for other, d in distance.items() if d < MAX_DISTANCE and _mirrored(robot, standing, name, other)
        ]
        if not partners:
            alone.append(name)
            continue
        partner = min(partners, key=distance.__getitem__)
        masses = robot.body(name).inertial.mass, robot.body(partner).inertial.mass
        if name < partner and abs(masses[0] - masses[1]) > UNLIKE * max(masses):
            unlike.append(f"{name} {masses[0]:.3g} kg and {partner} {masses[1]:.3g} kg")
    if alone:
        yield f"left and right differ: in the standing pose no joint mirrors {_names(robot, alone)}"
    if unlike:
        yield f"left and right differ in mass: {', '.join(unlike[:MOST_NAMES])}"


def _mirrored(robot: Robot, standing: Standing, name: str, other: str) -> bool:
    """Whether the axis of a joint is the mirror image of the axis of another, up to its sign."""
    axes = [standing.R[body] @ np.array(robot.body(body).joint.axis) for body in (name, other)]
    sign = -1.0 if robot.body(name).joint.type == "revolute" else 1.0
    return abs(float((sign * axes[0] * REFLECTION) @ axes[1])) > 0.999


def _names(robot: Robot, bodies: list[str]) -> str:
    return _listed([robot.joint_name(body) for body in bodies])


def _listed(names: list[str]) -> str:
    return ", ".join(names[:MOST_NAMES]) + (f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else "")
