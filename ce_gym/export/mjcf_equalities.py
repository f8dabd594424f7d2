"""The constraints of a robot as MJCF: equalities, tendons, and the armature that replaces rotors.

| constraint              | in MJCF                                                                                 |
|-------------------------|-----------------------------------------------------------------------------------------|
| linear, two joints      | joint equality                                                                          |
| linear, more joints     | fixed tendon with a tendon equality                                                     |
| loop with a ball joint  | one connect between two sites                                                           |
| loop with a hinge       | two connects, at points along its axis                                                  |
| rod                     | spatial tendon between two sites with a tendon equality: MuJoCo has no other distance   |
| function                | an error                                                                                |

Level `coupled` replaces rotors by their reflected inertia:

| rotor driven by              | in MJCF                                                                            |
|------------------------------|------------------------------------------------------------------------------------|
| one joint                    | joint armature, also of a dependent joint of a loop                                |
| several joints of one chain  | a fixed tendon with armature                                                       |
| joints of several chains     | a massless body whose joint has the armature, tied by a tendon equality: MuJoCo    |
|                              | drops tendon armature between chains                                               |
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ce_gym.export.joint_ties import Tie
from ce_gym.export.mjcf_mechanism import largest_ratio
from ce_gym.export.mjcf_text import quaternion, text
from ce_gym.model.constraints import Constraint, LoopConstraint, RodConstraint
from ce_gym.model.errors import file_error
from ce_gym.model.frames import Placement
from ce_gym.model.mechanism import EliminatedRotor, Mechanism, MovingBody

Array = NDArray[np.float64]
Elements = Mapping[str | None, ET.Element]
Attributes = Mapping[str, str]

MJCF_JOINTS = {"revolute": "hinge", "prismatic": "slide", "ball": "ball"}
"""Types of joints in MJCF."""
HINGE_SPAN = 0.1
"""Distance between the two connects of a hinge that closes a loop [m]: about the width of a bearing."""


def check_expressible(mechanism: Mechanism, ties: Mapping[str, Tie]) -> None:
    """Check that MJCF can express a robot at a transmission level.

    Raises:
        RobotError: A constraint is a function; an omitted rotor is an independent joint, an end of a loop or has dry
            friction; or `armature` needs a reflected inertia that varies with the pose.
    """
    robot, level = mechanism.robot, mechanism.level
    file = robot.source or robot.name
    for body in robot.bodies:
        if body.joint.type not in MJCF_JOINTS and body.joint.type != "free":
            raise file_error(
                file, f"joint {body.name!r} is {body.joint.type}", f"one of {', '.join(MJCF_JOINTS)} for MJCF"
            )
    for constraint in robot.constraints:
        if type(constraint) not in EXPORTS and not constraint.linear:
            what = f"constraint {constraint.name!r} is of a kind that MJCF does not have"
            raise file_error(file, what, "type linear, loop or rod")
        for body in constraint.bodies if not constraint.linear else ():
            if body not in mechanism.bodies:
                what = f"constraint {constraint.name!r} ends on rotor {body!r}, which {level!r} omits"
                raise file_error(file, what, "transmission 'exact' for MJCF")
    for name in ties:
        if name not in mechanism.bodies and robot.body(name).joint.friction:
            what = f"the joint of rotor {name!r}, which {level!r} omits, has dry friction"
            raise file_error(file, what, "transmission 'exact', or friction of links' joints, for MJCF")
        if name not in mechanism.bodies and name in ties[name].ratios:
            what = f"rotor {name!r}, which {level!r} omits, is an independent joint"
            raise file_error(file, what, "transmission 'exact', or independent links, for MJCF")
    for rotor in _eliminated_rotors(mechanism):
        dependent = [name for name in ties[rotor.name].ratios if name not in robot.independent]
        if level == "armature" and dependent:
            what = f"the inertia that {level!r} reflects from rotor {rotor.name!r} through {dependent[0]!r} varies"
            raise file_error(file, what, "transmission 'exact', 'coupled' or 'none' for MJCF")


def joint_armature(mechanism: Mechanism, ties: Mapping[str, Tie]) -> dict[str, float]:
    """Return the armature of joints [kg m^2], by name, see the table at the top of this file.

    At level `armature`, the diagonal of the reflected inertia.
    """
    armature = {name: rotor.inertia for name, (_, rotor) in massless_rotors(mechanism, ties).items()}
    for rotor in _eliminated_rotors(mechanism):
        ratios = ties[rotor.name].ratios
        if mechanism.level == "armature" or (_reflects_all(mechanism) and len(ratios) == 1):
            for joint, ratio in ratios.items():
                armature[joint] = armature.get(joint, 0.0) + rotor.inertia * ratio**2
    return armature


def massless_rotors(mechanism: Mechanism, ties: Mapping[str, Tie]) -> dict[str, tuple[MovingBody, EliminatedRotor]]:
    """Return the omitted rotors that need a massless body for their reflected inertia, by name.

    The coordinate of the body is the rotor's angle over its largest ratio: MuJoCo's smallest inertia times a squared
    ratio is not negligible.
    """
    massless: dict[str, tuple[MovingBody, EliminatedRotor]] = {}
    for rotor in _eliminated_rotors(mechanism) if _reflects_all(mechanism) else ():
        if len(ties[rotor.name].ratios) > 1 and not _one_chain(mechanism, ties[rotor.name].ratios):
            body = mechanism.robot.body(rotor.name)
            rotation, position = np.array(body.placement.rotation), np.array(body.placement.position)
            axis, no_inertia = np.array(body.joint.axis), np.zeros((6, 6))
            moving = MovingBody(body.name, body.parent, rotation, position, body.joint, axis, no_inertia)
            inertia = rotor.inertia * largest_ratio(ties[rotor.name]) ** 2
            massless[body.name] = moving, replace(rotor, inertia=inertia)
    return massless


def _one_chain(mechanism: Mechanism, joints: Mapping[str, float]) -> bool:
    """Whether all joints lie on one path from the base to a leaf."""
    chains = []
    for joint in joints:
        body, chain = mechanism.bodies[joint], {joint}
        while body.parent is not None:
            body = mechanism.bodies[body.parent]
            chain.add(body.name)
        chains.append(chain)
    return any(set(joints) <= chain for chain in chains)


def _reflects_all(mechanism: Mechanism) -> bool:
    """Whether omitted rotors keep all of their reflected inertia, including off-diagonal terms."""
    return mechanism.level in ("exact", "coupled")


def _eliminated_rotors(mechanism: Mechanism) -> Iterator[EliminatedRotor]:
    return (rotor for cluster in mechanism.eliminated_rotors for rotor in cluster)


def add_ties(
    root: ET.Element,
    elements: Elements,
    mechanism: Mechanism,
    ties: Mapping[str, Tie],
    reference: Mapping[str, float],
    solver: Attributes,
) -> None:
    """Add equalities of dependent joints, loops and rods, and tendons for the armature of rotors with several joints.

    Args:
        root: The <mujoco> element.
        elements: The element of each body; the world has the key None.
        mechanism: The robot at a transmission level.
        ties: From `joint_ties`.
        reference: Non-zero joint coordinates in the initial configuration, `ref` [rad or m]. MuJoCo's polynomials and
            tendon lengths are relative to them.
        solver: Attributes `solref` and `solimp` of equalities.
    """
    tendons, equalities = ET.Element("tendon"), ET.Element("equality")
    massless, joint_name = massless_rotors(mechanism, ties), mechanism.robot.joint_name
    for name in (*mechanism.bodies, *massless):
        if name in ties and name not in ties[name].ratios:
            tie = ties[name].scaled(1.0 / largest_ratio(ties[name])) if name in massless else ties[name]
            constant = tie.at({joint: reference.get(joint, 0.0) for joint in tie.ratios}) - reference.get(name, 0.0)
            ratios = {joint_name(joint): ratio for joint, ratio in tie.ratios.items()}
            _add_linear(tendons, equalities, name, joint_name(name), ratios, constant, solver)
    for constraint in mechanism.robot.constraints:
        if not constraint.linear:
            EXPORTS[type(constraint)](elements, tendons, equalities, constraint, solver)
    if _reflects_all(mechanism):
        for rotor in _eliminated_rotors(mechanism):
            if len(ties[rotor.name].ratios) > 1 and rotor.name not in massless:
                ratios = {joint_name(joint): ratio for joint, ratio in ties[rotor.name].ratios.items()}
                tendon = _fixed_tendon(tendons, rotor.name, ratios)
                tendon.set("armature", text(rotor.inertia))
    root.extend(element for element in (tendons, equalities) if len(element))


def _add_linear(
    tendons: ET.Element,
    equalities: ET.Element,
    name: str,
    joint: str,
    ratios: Mapping[str, float],
    constant: float,
    solver: Attributes,
) -> None:
    """Tie a joint to others, whose ratios are given by name; a tendon gets the name of the moved body."""
    if len(ratios) == 1:
        ((other, ratio),) = ratios.items()
        pair = {"joint1": joint, "joint2": other, "polycoef": text((constant, ratio, 0, 0, 0))}
        ET.SubElement(equalities, "joint", {**pair, **solver})
        return
    _fixed_tendon(tendons, name, {joint: 1.0, **{other: -ratio for other, ratio in ratios.items()}})
    ET.SubElement(equalities, "tendon", {"tendon1": name, "polycoef": text((constant, 0, 0, 0, 0)), **solver})


def _fixed_tendon(tendons: ET.Element, name: str, ratios: Mapping[str, float]) -> ET.Element:
    tendon = ET.SubElement(tendons, "fixed", name=name)
    for joint, ratio in ratios.items():
        ET.SubElement(tendon, "joint", joint=joint, coef=text(ratio))
    return tendon


def _add_loop(
    elements: Elements, tendons: ET.Element, equalities: ET.Element, loop: LoopConstraint, solver: Attributes
) -> None:
    """Connect two bodies at a point, or at two points along the axis of a hinge."""
    ends = ((loop.first, loop.first_placement), (loop.second, loop.second_placement))
    shifts = {loop.name: 0.0}
    if loop.joint == "revolute":
        shifts = {f"{loop.name}_1": -HINGE_SPAN / 2, f"{loop.name}_2": HINGE_SPAN / 2}
    for name, shift in shifts.items():
        sites = {"site1": f"{name}_first", "site2": f"{name}_second"}
        for site, (body, place) in zip(sites.values(), ends, strict=True):
            _add_site(elements[body], site, place, loop.axis, shift)
        ET.SubElement(equalities, "connect", {"name": name, **sites, **solver})


def _add_rod(
    elements: Elements, tendons: ET.Element, equalities: ET.Element, rod: RodConstraint, solver: Attributes
) -> None:
    """Keep the distance of two points in the initial configuration, which is the rod's length."""
    tendon = ET.SubElement(tendons, "spatial", name=rod.name)
    for end, body, point in (("first", rod.first, rod.first_point), ("second", rod.second, rod.second_point)):
        _add_site(elements[body], f"{rod.name}_{end}", Placement(point))
        ET.SubElement(tendon, "site", site=f"{rod.name}_{end}")
    ET.SubElement(equalities, "tendon", {"name": rod.name, "tendon1": rod.name, **solver})


def _add_site(
    element: ET.Element, name: str, place: Placement, axis: Sequence[float] = (0.0, 0.0, 1.0), shift: float = 0.0
) -> None:
    """Add a site at a point on an axis of a body's frame, with z along the axis.

    MJCF's connect has no axis. A reader of the file takes the axis from the site.
    """
    rotation, along = np.array(place.rotation), np.array(axis)
    position = np.array(place.position) + rotation @ along * shift
    pose = {"pos": text(position), "quat": text(quaternion(rotation @ _from_z(along)))}
    ET.SubElement(element, "site", {"name": name, **pose, "size": "0.005", "group": "3"})


def _from_z(axis: Array) -> Array:
    """Return a rotation, shape (3, 3), that takes z to a unit axis."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    across = np.cross(helper, axis) / np.linalg.norm(np.cross(helper, axis))
    return np.column_stack([across, np.cross(axis, across), axis])


EXPORTS: dict[type[Constraint], Callable[..., None]] = {LoopConstraint: _add_loop, RodConstraint: _add_rod}
"""Function (elements, tendons, equalities, constraint, solver) that adds each non-linear kind of constraint."""
