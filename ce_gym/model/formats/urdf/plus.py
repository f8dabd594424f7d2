"""URDF and URDF+ -> `Robot`.

URDF+ is the format of the paper's authors for robots with loops and transmissions: a URDF with additions.

- `independent="true|false"` on a joint; true is the default. The independent joints are the coordinates.
- `<coupling name>` with `<predecessor link>`, `<successor link>` and `<ratio value>`: the sum of the joint coordinates
  from the nearest common ancestor of both links down to the successor is `ratio` times that down to the predecessor.
- `<loop name type>` with `<predecessor link>` and `<successor link>`, each with an `<origin>`, and an `<axis>`: a
  revolute or ball joint that closes a loop between the two links.

The base is as in a plain URDF: a joint of type "floating" makes it free, a root link without mass is the world, and
the caller can decide. URDF+ does not say which links are rotors: `rotor_rule.py` does.

Source: github.com/ROAM-Lab-ND/generalized_rbda, `robot-models/`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal
from xml.etree.ElementTree import Element

from ce_gym.model.checks.robot import check_robot
from ce_gym.model.constraints import LinearConstraint, LoopConstraint
from ce_gym.model.description import Body, Pose, Robot
from ce_gym.model.errors import invalid_value, unknown_name
from ce_gym.model.formats.placement import compose, named_frames
from ce_gym.model.formats.pose import complete_pose
from ce_gym.model.formats.rotor_rule import with_rotors
from ce_gym.model.formats.urdf import elements as read
from ce_gym.model.formats.urdf.drives import add_rotors
from ce_gym.model.formats.urdf.graph import UrdfGraph
from ce_gym.model.formats.urdf.tree import Attachment, Base, UrdfTree, read_tree, warn_of_held_joints

_LOOP_TYPES: dict[str, Literal["revolute", "ball"]] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "ball": "ball",
    "spherical": "ball",
}
_TRUTH = {"true": True, "1": True, "false": False, "0": False}


def robot_from_graph(graph: UrdfGraph, base: Base | None = None) -> Robot:
    """Read a URDF or URDF+ file that has been parsed. Its <mimic> joints are constraints.

    Args:
        graph: The parsed file.
        base: "floating" or "fixed"; by default as the file implies.

    Raises:
        RobotError: The file is malformed or describes an impossible robot.

    Warns:
        LossyImportWarning: Joints are fixed because they move no mass.
    """
    tree = read_tree(graph, base)
    warn_of_held_joints(graph.file, tree)
    constraints = (*tree.constraints, *_couplings(graph, tree), *_loops(graph, tree))
    independent = tuple(_independent(graph, tree))
    dependent = [body.name for body in tree.bodies if body.name not in independent]
    bodies = with_rotors(tree.bodies, constraints, dependent) if graph.is_plus else tree.bodies
    notes = list(tree.notes)
    bodies, gears = add_rotors(bodies, tree.drives, (), notes)
    constraints = (*constraints, *gears)
    pose = Pose(joints=complete_pose((), bodies, independent))
    robot = Robot(
        name=tree.name,
        bodies=bodies,
        constraints=constraints,
        independent=independent,
        pose=pose,
        frames=named_frames(tree.frames, bodies),
        source=graph.file,
        notes=tuple(notes),
    )
    check_robot(robot)
    return robot


def _independent(graph: UrdfGraph, tree: UrdfTree) -> Iterator[str]:
    """Iterate over the bodies whose joints are independent: marked so, or unmarked and no <mimic>."""
    mimics = {constraint.bodies[0] for constraint in tree.constraints}
    for body in tree.bodies:
        if body.joint.type == "free":
            continue
        joint = graph.joints[body.name]
        text = joint.element.get("independent", "false" if body.name in mimics else "true")
        if text.lower() not in _TRUTH:
            raise invalid_value(graph.file, f"{joint.where} independent", text, "true or false")
        if _TRUTH[text.lower()]:
            yield body.name


def _couplings(graph: UrdfGraph, tree: UrdfTree) -> Iterator[LinearConstraint]:
    for i, element in enumerate(graph.robot.findall("coupling")):
        name = element.get("name") or f"coupling {i + 1}"
        where = f"coupling {name!r}"
        ends = [_end(graph.file, where, element, tag, tree.frames)[0] for tag in ("predecessor", "successor")]
        ratio = read.numbers(graph.file, where, read.required(graph.file, where, element, "ratio"), "value", 1)[0]
        if ratio == 0.0:
            raise invalid_value(graph.file, f"{where} <ratio value>", ratio, "a ratio other than 0")
        predecessors, successors = _branches(ends[0], ends[1], tree.bodies)
        if not predecessors or not successors:
            expected = "two links that move, neither of which carries the other"
            raise invalid_value(graph.file, where, tuple(ends), expected)
        pairs = [*((body, 1.0) for body in successors), *((body, -ratio) for body in predecessors)]
        yield LinearConstraint(name, tuple(pairs))


def _branches(first: str | None, second: str | None, bodies: tuple[Body, ...]) -> tuple[list[str], list[str]]:
    """Return the bodies from the nearest common ancestor, exclusive, down to `first` and to `second`."""
    parents = {body.name: body.parent for body in bodies}
    chains: list[list[str]] = []
    for end in (first, second):
        chain: list[str] = []
        while end is not None:
            chain.insert(0, end)
            end = parents[end]
        chains.append(chain)
    while chains[0] and chains[1] and chains[0][0] == chains[1][0]:
        chains = [chain[1:] for chain in chains]
    return chains[0], chains[1]


def _loops(graph: UrdfGraph, tree: UrdfTree) -> Iterator[LoopConstraint]:
    for i, element in enumerate((*graph.robot.findall("loop"), *graph.robot.findall("loop_joint"))):
        name = element.get("name") or f"loop {i + 1}"
        where = f"{element.tag} {name!r}"
        kind = element.get("type", "")
        if kind not in _LOOP_TYPES:
            expected = "a joint that closes a loop"
            raise unknown_name(graph.file, f"{where} type", element.get("type"), _LOOP_TYPES, expected)
        predecessor, successor = _ends(graph, where, element, tree.frames)
        if predecessor[0] == successor[0]:
            expected = "two links that can move against each other"
            raise invalid_value(graph.file, where, predecessor[0] or "the world", expected)
        yield LoopConstraint(
            name=name,
            joint=_LOOP_TYPES[kind],
            first=predecessor[0],
            second=successor[0],
            first_placement=predecessor[1],
            second_placement=successor[1],
            axis=read.axis(graph.file, where, element),
        )


def _ends(
    graph: UrdfGraph, where: str, element: Element, frames: dict[str, Attachment]
) -> tuple[Attachment, Attachment]:
    """Return the bodies at both ends of a loop with the poses of the loop's joint in them.

    A <loop_joint> (RigidBodyDynamics.jl, Isaac Sim) has <link1> and <link2>, which carry `xyz` and `rpy` themselves.
    """
    file = graph.file
    if element.tag == "loop":
        first, second = (_end(file, where, element, tag, frames) for tag in ("predecessor", "successor"))
        return first, second
    if all(joint.element.get("independent") is None for joint in graph.joints.values()):
        expected = 'independent="false" on each joint that the loops determine, or the loop as <connect> in MJCF'
        raise invalid_value(file, f"<{element.tag}> {where.split(' ', 1)[1]}", "without independent joints", expected)
    ends = [end for end in element if end.tag in ("link1", "link2")]
    if len(ends) != 2:
        raise invalid_value(file, f"{where} ends", len(ends), "a <link1> and a <link2>")
    first, second = (_frame(file, where, end, end, frames) for end in ends)
    return first, second


def _end(file: str, where: str, element: Element, tag: str, frames: dict[str, Attachment]) -> Attachment:
    """Return the body at one end of a loop or coupling, and the pose of the end's <origin> in it."""
    end = read.required(file, where, element, tag)
    return _frame(file, where, end, end.find("origin"), frames)


def _frame(file: str, where: str, end: Element, origin: Element | None, frames: dict[str, Attachment]) -> Attachment:
    """Return the body that a link belongs to, and a pose given in the link's frame in the body's."""
    link = read.name_of(file, end, "link", where)
    if link not in frames:
        raise unknown_name(file, f"{where} <{end.tag} link>", link, frames, "the name of a link")
    body, pose = frames[link]
    return body, compose(pose, read.pose_of(file, where, origin))
