"""A plain URDF file -> bodies in a tree.

Links joined by fixed joints become one body with the name of the link nearest to the root; the other links stay
frames with names. A body has the name of its link, and its joint has the name of its body.

Vendors write rotors as links on fixed joints. Such links stay separate if the caller names them in `apart`.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from ce_gym.model.checks.body import check_body
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Body, Inertial, Joint, Shape
from ce_gym.model.errors import LossyImportWarning, invalid_value, unknown_name
from ce_gym.model.formats.placement import compose, mat3, merge_inertials, transform_inertial
from ce_gym.model.formats.rotor_links import FixedLink
from ce_gym.model.formats.urdf import elements as read
from ce_gym.model.formats.urdf.drives import Drive, drives_of
from ce_gym.model.formats.urdf.graph import MIMIC_DEFAULTS, UrdfGraph, UrdfJoint
from ce_gym.model.formats.urdf.vocabulary import SPRINGS, unread_words
from ce_gym.model.frames import ZERO, Placement, added

Base = Literal["floating", "fixed"]
Attachment = tuple[str | None, Placement]  # the body (None: the world) that carries a frame, its pose in it

WORLD = "world"
ROUNDING = 1e-12
"""Relative size, to the largest moment of inertia in a file, of rounding errors."""


@dataclass(frozen=True)
class UrdfTree:
    """The content of a URDF file.

    Attributes:
        name: Name of the robot.
        bodies: Parents before children, otherwise in the order of the links in the file.
        frames: Body and pose of every link of the file, merged links included.
        constraints: The file's <mimic> joints.
        notes: Ignored parts of the file.
        fixed: Links of `apart` on fixed joints, by name.
        collisions: The <collision> elements of every link with some, in the link's frame; None for a mesh.
        drives: Motors in the file.
        held: A line for each joint that is fixed because it moves no mass.
    """

    name: str
    bodies: tuple[Body, ...]
    frames: dict[str, Attachment]
    constraints: tuple[LinearConstraint, ...]
    notes: tuple[str, ...]
    fixed: Mapping[str, FixedLink]
    collisions: Mapping[str, tuple[Shape | None, ...]]
    drives: tuple[Drive, ...]
    held: tuple[str, ...]


def read_urdf(
    path: Path, base: Base | None = None, apart: Collection[str] = (), tied: Collection[str] = ()
) -> UrdfTree:
    """Read a URDF file.

    Args:
        path: The file.
        base: Whether the root link moves freely or is fixed to the world. By default the root is fixed if it is called
            "world" or has no mass.
        apart: Names of links on fixed joints to keep separate; other names have no effect.
        tied: Names of links or joints that may move without mass because constraints elsewhere name them.

    Raises:
        RobotError: The file is missing, malformed, or not a tree of rigid bodies; or it is URDF+, whose loops and
            couplings must not be lost.

    Warns:
        LossyImportWarning: Joints are fixed because they move no mass.
    """
    graph = UrdfGraph(path)
    if graph.is_plus:
        expected = "a plain URDF; load the URDF+ file itself"
        raise invalid_value(graph.file, "<loop>, <coupling> or independent", "URDF+", expected)
    tree = read_tree(graph, base, apart, tied)
    warn_of_held_joints(graph.file, tree)
    for body in tree.bodies:
        check_body(body, graph.file)
    return tree


def warn_of_held_joints(file: str, tree: UrdfTree) -> None:
    """Warn in one line of joints that are fixed because they move no mass."""
    if tree.held:
        first, *others = tree.held
        rest = f" (and {len(others)} more, see Robot.notes)" if others else ""
        warnings.warn(f"{file}: {first}{rest}", LossyImportWarning, stacklevel=5)


def read_tree(
    graph: UrdfGraph, base: Base | None = None, apart: Collection[str] = (), tied: Collection[str] = ()
) -> UrdfTree:
    """Read the tree of a parsed file; like `read_urdf`, but without checks of bodies."""
    return _Reader(graph, base, apart, tied).tree()


def _without_rounding(inertials: dict[str, Inertial | None]) -> dict[str, Inertial | None]:
    """Return mass properties with zero in place of principal moments that rounding made negative.

    CAD programs write -5e-20 for the inertia of a small part.
    """
    known = {name: part for name, part in inertials.items() if part is not None}
    largest = max((np.abs(part.inertia).max() for part in known.values()), default=0.0)
    for name, part in known.items():
        moments, axes = np.linalg.eigh(np.array(part.inertia))
        if -ROUNDING * largest <= moments[0] < 0.0:
            inertials[name] = replace(part, inertia=mat3(axes * np.fmax(moments, 0.0) @ axes.T))
    return inertials


class _Reader:
    """One pass over one file, with its look-up tables."""

    def __init__(self, graph: UrdfGraph, base: Base | None, apart: Collection[str], tied: Collection[str]):
        self.graph, self.file = graph, graph.file
        self.colors = read.colors_of(self.file, graph.robot)
        self.springs = self._gazebo_springs()
        self.inertials = _without_rounding(
            {name: read.inertial(self.file, f"link {name!r}", link) for name, link in graph.links.items()}
        )
        unread = list(unread_words(graph.robot))
        self.drives = drives_of(graph, unread)
        self.held: tuple[str, ...] = () if graph.is_plus else self._hold_idle_joints(tied)
        self.joints = graph.joints
        self.root_is_world = self._root_is_world(base)
        self.apart = [link for link in graph.order if link in apart and self._is_fixed(link)]
        self.frames = self._frames()
        self.notes = [*graph.notes, *self.held, *unread]

    def tree(self) -> UrdfTree:
        bodies = tuple(self._body(link) for link in self.graph.order if self._moves(link))
        mimics = tuple(self._mimics())
        name = self.graph.robot.get("name") or Path(self.file).stem
        fixed = {link: self._fixed(link) for link in self.apart}
        collisions = {link: tuple(self._shapes_of(link, "collision")) for link in self.graph.order}
        collisions = {link: shapes for link, shapes in collisions.items() if shapes}
        return UrdfTree(name, bodies, self.frames, mimics, tuple(self.notes), fixed, collisions, self.drives, self.held)

    def _hold_idle_joints(self, tied: Collection[str]) -> tuple[str, ...]:
        """Fix the joints of frames, or of links without <inertial>, that move no mass; return a line for each.

        Left alone: joints that motors, other files or links with mass depend on.
        """
        joints = self.graph.joints
        heavy = {*tied, *(joint.child for joint in joints.values() if joint.name in tied)}
        heavy |= {drive.link for drive in self.drives}
        for link in reversed(self.graph.order):  # children first
            inertial = self.inertials[link]
            if link in heavy or (inertial is not None and (inertial.mass or np.any(inertial.inertia))):
                heavy |= {link, joints[link].parent} if link in joints else {link}
        mimics = {joint: joint.element.find("mimic") for joint in joints.values()}
        needed = {mimic.get("joint") for joint, mimic in mimics.items() if mimic is not None and joint.child in heavy}
        idle = [
            joint
            for joint, mimic in mimics.items()
            if joint.child not in heavy and joint.name not in needed and mimic is None and joint.type != "fixed"
        ]
        idle = [joint for joint in idle if joint.type == "floating" or self.inertials[joint.child] is None]
        for joint in idle:
            self.graph.hold(joint.child)
        expected = "give its link an <inertial> to let it move"
        return tuple(f"{joint.where} moves no mass: it is fixed at 0; {expected}" for joint in idle)

    def _gazebo_springs(self) -> dict[str, dict[str, float]]:
        """Return the spring parameters in <gazebo> elements, by the name of the joint."""
        springs: dict[str, dict[str, float]] = {}
        for element in self.graph.robot.findall("gazebo"):
            for part in (part for part in element if part.tag in SPRINGS):
                joint, text = element.get("reference", ""), part.get("value", part.text or "")
                where = f"gazebo {joint!r}"
                value = read.numbers(self.file, where, Element(part.tag, value=text), "value", 1)[0]
                springs.setdefault(joint, {})[SPRINGS[part.tag]] = value
        return springs

    def _root_is_world(self, base: Base | None) -> bool:
        floating = [joint for joint in self.joints.values() if joint.type == "floating"]
        for joint in floating:
            if joint.parent != self.graph.root or base == "fixed":
                expected = "a joint with one degree of freedom; fixed for a frame, floating only on a root without mass"
                raise invalid_value(self.file, f"{joint.where} type", "floating", expected)
        mass = added(part.mass for link in self.graph.welded_to(self.graph.root) if (part := self.inertials[link]))
        if floating and mass:
            expected = "0, because the root of a floating joint is the world"
            raise invalid_value(self.file, f"link {self.graph.root!r} mass", mass, expected)
        if base is not None:
            return bool(floating) or base == "fixed"
        return self.graph.root == WORLD or mass == 0.0

    def _moves(self, link: str) -> bool:
        return not self.root_is_world if link == self.graph.root else self.joints[link].type != "fixed"

    def _frames(self) -> dict[str, Attachment]:
        frames: dict[str, Attachment] = {}
        for link in self.graph.order:
            if self._moves(link):
                frames[link] = (link, Placement())
            elif link == self.graph.root:
                frames[link] = (None, Placement())
            else:
                frames[link] = self._attachment(self.joints[link], frames)
        return frames

    def _attachment(self, joint: UrdfJoint, frames: dict[str, Attachment]) -> Attachment:
        carrier, pose = frames[joint.parent]
        pose = compose(pose, read.placement(self.file, joint.where, joint.element))
        return carrier, compose(pose, read.moved(self.file, joint.where, joint.element, joint.offset))

    def _is_fixed(self, link: str) -> bool:
        return link in self.joints and self.joints[link].type == "fixed"

    def _fixed(self, link: str) -> FixedLink:
        """Return a separate link, which must carry no other link."""
        carried = next((joint.child for joint in self.joints.values() if joint.parent == link), None)
        inertial = self.inertials[link]
        if carried is not None or inertial is None:
            key, expected = ("child", "no child link") if carried else ("<inertial>", "mass and inertia")
            raise invalid_value(self.file, f"{key} of rotor {link!r}", carried, expected)
        return FixedLink(*self.frames[link], inertial, tuple(self._shapes(link, Placement())))

    def _body(self, link: str) -> Body:
        parts = [part for part in self.graph.welded_to(link) if part not in self.apart]
        inertials = [
            transform_inertial(self.frames[part][1], inertial) for part in parts if (inertial := self.inertials[part])
        ]
        joint = self.joints.get(link)
        if not inertials and (joint is None or joint.type == "floating"):
            expected = "mass and inertia, because the link moves"
            raise invalid_value(self.file, f"link {link!r} <inertial>", None, expected)
        if not inertials:
            self.notes.append(f"link {link!r} moves and has no <inertial>: its mass is 0")
            inertials = [Inertial(0.0, ZERO, mat3(np.zeros((3, 3))))]
        parent, pose, motion = None, Placement(), Joint("free")
        if joint is not None and joint.type != "floating":
            parent, pose = self._attachment(joint, self.frames)
            motion = read.joint(self.file, joint.where, joint.element, joint.type)
            motion = replace(motion, name=joint.name, **self.springs.get(joint.name, {}))
        shapes = tuple(shape for part in parts for shape in self._shapes(part, self.frames[part][1]))
        return Body(link, "link", parent, pose, motion, merge_inertials(inertials), shapes)

    def _shapes(self, link: str, frame: Placement) -> Iterator[Shape]:
        """Iterate over primitives to draw: of <visual> elements, or of <collision> if all visuals are meshes."""
        shapes = {tag: self._shapes_of(link, tag) for tag in ("visual", "collision")}
        drawn = [shape for shape in shapes["visual"] if shape] or [shape for shape in shapes["collision"] if shape]
        return (replace(shape, placement=compose(frame, shape.placement)) for shape in drawn)

    def _shapes_of(self, link: str, tag: str) -> list[Shape | None]:
        elements = self.graph.links[link].findall(tag)
        return [read.shape(self.file, f"link {link!r}", element, self.colors) for element in elements]

    def _mimics(self) -> Iterator[LinearConstraint]:
        """Iterate over `child = multiplier * other + offset`, the URDF way to write a gear."""
        by_name = {joint.name: joint for joint in self.joints.values()}
        for joint in self.joints.values():
            mimic = joint.element.find("mimic")
            if mimic is None or joint.type == "fixed":
                continue
            other = by_name.get(mimic.get("joint", ""))
            if other is None:
                raise unknown_name(
                    self.file, f"{joint.where} <mimic joint>", mimic.get("joint"), by_name, "the name of a joint"
                )
            ratio, offset = (read.number(self.file, joint.where, mimic, key, value) for key, value in MIMIC_DEFAULTS)
            yield LinearConstraint(f"{joint.name} mimic", ((joint.child, 1.0), (other.child, -ratio)), offset)
