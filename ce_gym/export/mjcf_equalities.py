"""The constraints of a robot as MJCF: equalities, the tendons they need, and the armature that stands for rotors.

| constraint              | in MJCF                                                                                 |
|-------------------------|-----------------------------------------------------------------------------------------|
| linear, two joints      | joint equality                                                                          |
| linear, more joints     | fixed tendon with a tendon equality                                                     |
| loop with a ball joint  | one connect between two sites                                                           |
| loop with a hinge       | two connects, at points along its axis                                                  |
| rod                     | spatial tendon between two sites with a tendon equality: MuJoCo has no other distance   |
| function                | nothing: an error                                                                       |

Where rotors are left out and `coupled` keeps what they reflect, that is

| rotor driven by              | in MJCF                                                                            |
|------------------------------|------------------------------------------------------------------------------------|
| one joint                    | joint armature; the joint may be a dependent one of a loop, which then reflects it |
| several joints of one chain  | a fixed tendon with armature                                                       |
| joints of several chains     | a massless body whose joint has the armature, tied by a tendon equality: of tendon |
|                              | armature MuJoCo keeps only what its sparse mass matrix has room for (tested, 4.0)  |
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
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError
from ce_gym.model.frames import Placement
from ce_gym.model.mechanism import EliminatedRotor, Mechanism, MovingBody

Array = NDArray[np.float64]

MJCF_JOINTS = {"revolute": "hinge", "prismatic": "slide", "ball": "ball"}
"""Types of joints in MJCF."""
HINGE_SPAN = 0.1
"""Distance between the two points at which a hinge that closes a loop is held [m]: about the width of a bearing."""


def check_expressible(mechanism: Mechanism, ties: Mapping[str, Tie]) -> None:
    """Check that MJCF can say what is left of a robot at a transmission level.

    Raises:
        RobotError: A constraint is a function; what a left-out rotor moves cannot move without it; its joint has dry
            friction; or its reflected inertia varies with the pose and only its diagonal is wanted.
    """
    robot, level = mechanism.robot, mechanism.level
    for body in robot.bodies:
        if body.joint.type not in MJCF_JOINTS and body.joint.type != "free":
            raise _error(
                robot, f"joint {body.name!r} is {body.joint.type}", f"one of {', '.join(MJCF_JOINTS)} for MJCF"
            )
    for constraint in robot.constraints:
        if type(constraint) not in EXPORTS and not constraint.linear:
            what = f"constraint {constraint.name!r} is of a kind that MJCF cannot say"
            raise _error(robot, what, "type linear, loop or rod")
        for body in constraint.bodies if not constraint.linear else ():
            if body not in mechanism.bodies:
                what = f"constraint {constraint.name!r} ends on rotor {body!r}, which {level!r} leaves out"
                raise _error(robot, what, "transmission 'exact' for MJCF")
    for name in ties:
        if name not in mechanism.bodies and robot.body(name).joint.friction:
            what = f"the joint of rotor {name!r}, which {level!r} leaves out, has dry friction"
            raise _error(robot, what, "transmission 'exact', or friction of links' joints, for MJCF")
        if name not in mechanism.bodies and name in ties[name].ratios:
            what = f"rotor {name!r}, which {level!r} leaves out, is an independent joint"
            raise _error(robot, what, "transmission 'exact', or independent links, for MJCF")
    for rotor in _eliminated_rotors(mechanism):
        by_loops = [name for name in ties[rotor.name].ratios if name not in robot.independent]
        if level == "armature" and by_loops:
            what = f"the inertia that {level!r} reflects from rotor {rotor.name!r} through {by_loops[0]!r} varies"
            raise _error(robot, what, "transmission 'exact', 'coupled' or 'none' for MJCF")


def joint_armature(mechanism: Mechanism, ties: Mapping[str, Tie]) -> dict[str, float]:
    """Return the armature of joints [kg m^2], by name, as the table at the top of this file says; tendons come later.

    At "armature" that is the diagonal of the reflected inertia.
    """
    armature = {name: rotor.inertia for name, (_, rotor) in held_rotors(mechanism, ties).items()}
    for rotor in _eliminated_rotors(mechanism):
        ratios = ties[rotor.name].ratios
        if mechanism.level == "armature" or (_reflects_all(mechanism) and len(ratios) == 1):
            for joint, ratio in ratios.items():
                armature[joint] = armature.get(joint, 0.0) + rotor.inertia * ratio**2
    return armature


def held_rotors(mechanism: Mechanism, ties: Mapping[str, Tie]) -> dict[str, tuple[MovingBody, EliminatedRotor]]:
    """Return the left-out rotors that need a body, without mass, to carry their reflected inertia; by name.

    The coordinate of that body is the rotor's angle over its largest ratio, since MuJoCo's smallest inertia times the
    square of a ratio is no longer small.
    """
    held: dict[str, tuple[MovingBody, EliminatedRotor]] = {}
    for rotor in _eliminated_rotors(mechanism) if _reflects_all(mechanism) else ():
        if len(ties[rotor.name].ratios) > 1 and not _one_chain(mechanism, ties[rotor.name].ratios):
            body = mechanism.robot.body(rotor.name)
            rotation, position = np.array(body.placement.rotation), np.array(body.placement.position)
            axis, nothing = np.array(body.joint.axis), np.zeros((6, 6))
            moving = MovingBody(body.name, body.parent, rotation, position, body.joint, axis, nothing)
            inertia = rotor.inertia * largest_ratio(ties[rotor.name]) ** 2
            held[body.name] = moving, replace(rotor, inertia=inertia)
    return held


def _one_chain(mechanism: Mechanism, joints: Mapping[str, float]) -> bool:
    """Whether each of some joints carries the next, or the other way round."""
    chains = []
    for joint in joints:
        body, chain = mechanism.bodies[joint], {joint}
        while body.parent is not None:
            body = mechanism.bodies[body.parent]
            chain.add(body.name)
        chains.append(chain)
    return any(set(joints) <= chain for chain in chains)


def _reflects_all(mechanism: Mechanism) -> bool:
    """Whether rotors that are left out keep all of their reflected inertia, off-diagonal terms included."""
    return mechanism.level in ("exact", "coupled")


def _eliminated_rotors(mechanism: Mechanism) -> Iterator[EliminatedRotor]:
    return (rotor for cluster in mechanism.eliminated_rotors for rotor in cluster)


def add_ties(
    root: ET.Element,
    elements: Mapping[str | None, ET.Element],
    mechanism: Mechanism,
    ties: Mapping[str, Tie],
    reference: Mapping[str, float],
    solver: Mapping[str, str],
) -> None:
    """Tie dependent joints to independent ones, close loops, add the armature of rotors that several joints drive.

    Args:
        root: The <mujoco> element.
        elements: The element of each body; None is the world.
        mechanism: The robot at a transmission level.
        ties: From `joint_ties`.
        reference: Joint coordinates in the initial configuration, `ref` [rad or m], where they are not zero: MuJoCo's
            polynomials and tendon lengths are counted from there.
        solver: Attributes `solref` and `solimp` of equalities.
    """
    tendons, equalities = ET.Element("tendon"), ET.Element("equality")
    held = held_rotors(mechanism, ties)
    for name in (*mechanism.bodies, *held):
        if name in ties and name not in ties[name].ratios:
            tie = ties[name].scaled(1.0 / largest_ratio(ties[name])) if name in held else ties[name]
            _add_linear(tendons, equalities, name, tie, reference, solver)
    for constraint in mechanism.robot.constraints:
        if not constraint.linear:
            EXPORTS[type(constraint)](elements, tendons, equalities, constraint, solver)
    if _reflects_all(mechanism):
        for rotor in _eliminated_rotors(mechanism):
            if len(ties[rotor.name].ratios) > 1 and rotor.name not in held:
                tendon = _fixed_tendon(tendons, rotor.name, ties[rotor.name].ratios)
                tendon.set("armature", text(rotor.inertia))
    root.extend(element for element in (tendons, equalities) if len(element))


def _add_linear(
    tendons: ET.Element,
    equalities: ET.Element,
    name: str,
    tie: Tie,
    reference: Mapping[str, float],
    solver: Mapping[str, str],
) -> None:
    at_reference = {joint: reference.get(joint, 0.0) for joint in tie.ratios}
    constant = tie.at(at_reference) - reference.get(name, 0.0)
    if len(tie.ratios) == 1:
        ((other, ratio),) = tie.ratios.items()
        pair = {"joint1": name, "joint2": other, "polycoef": text((constant, ratio, 0, 0, 0))}
        ET.SubElement(equalities, "joint", {**pair, **solver})
        return
    _fixed_tendon(tendons, name, {name: 1.0, **{joint: -ratio for joint, ratio in tie.ratios.items()}})
    ET.SubElement(equalities, "tendon", {"tendon1": name, "polycoef": text((constant, 0, 0, 0, 0)), **solver})


def _fixed_tendon(tendons: ET.Element, name: str, ratios: Mapping[str, float]) -> ET.Element:
    tendon = ET.SubElement(tendons, "fixed", name=name)
    for joint, ratio in ratios.items():
        ET.SubElement(tendon, "joint", joint=joint, coef=text(ratio))
    return tendon


def _add_loop(
    elements: Mapping[str | None, ET.Element],
    tendons: ET.Element,
    equalities: ET.Element,
    loop: LoopConstraint,
    solver: Mapping[str, str],
) -> None:
    """Hold two bodies together at a point, or at two points along the axis of a hinge."""
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
    elements: Mapping[str | None, ET.Element],
    tendons: ET.Element,
    equalities: ET.Element,
    rod: RodConstraint,
    solver: Mapping[str, str],
) -> None:
    """Keep two points at the distance they have in the initial configuration, which is the rod's length."""
    tendon = ET.SubElement(tendons, "spatial", name=rod.name)
    for end, body, point in (("first", rod.first, rod.first_point), ("second", rod.second, rod.second_point)):
        _add_site(elements[body], f"{rod.name}_{end}", Placement(point))
        ET.SubElement(tendon, "site", site=f"{rod.name}_{end}")
    ET.SubElement(equalities, "tendon", {"name": rod.name, "tendon1": rod.name, **solver})


def _add_site(
    element: ET.Element, name: str, place: Placement, axis: Sequence[float] = (0.0, 0.0, 1.0), shift: float = 0.0
) -> None:
    """Add a site at a point on an axis of a frame of a body, its z along that axis.

    MJCF's connect has no axis, but a reader of the file finds it there: equations written along and across it are
    shorter.
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


def _error(robot: Robot, problem: str, expected: str) -> RobotError:
    return RobotError(f"{robot.source or robot.name}: {problem}: expected {expected}")


EXPORTS: dict[type[Constraint], Callable[..., None]] = {LoopConstraint: _add_loop, RodConstraint: _add_rod}
"""Functions (elements, tendons, equalities, constraint, solver) that add a kind of constraint that is not linear."""
