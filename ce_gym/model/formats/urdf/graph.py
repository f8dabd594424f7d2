"""A URDF file -> its links and joints, known to form one tree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element

from ce_gym.model.errors import invalid_value, unknown_name
from ce_gym.model.formats.urdf import elements as read
from ce_gym.model.formats.urdf.document import parse_urdf

MOST_LINKS = 1000
"""Most links of a file, links on fixed joints included."""
MIMIC_DEFAULTS = (("multiplier", 1.0), ("offset", 0.0))
MOVING = ("revolute", "continuous", "prismatic", "floating")


@dataclass(frozen=True)
class UrdfJoint:
    """A <joint>.

    Attributes:
        name: Its name.
        type: "revolute", "continuous", "prismatic", "floating" or "fixed".
        parent, child: The two links.
        element: The element.
        offset: Coordinate of a fixed joint [rad or m], other than 0 if the joint mimics a joint that does not move.
    """

    name: str
    type: str
    parent: str
    child: str
    element: Element
    offset: float = 0.0

    @property
    def where(self) -> str:
        """The joint's name, for messages."""
        return f"joint {self.name!r}"


class UrdfGraph:
    """The links and joints of a file.

    Attributes:
        file: Name of the file, for messages.
        robot: The root element.
        links: Link elements by name, in the order of the file.
        joints: The joint that moves a link, by the name of that link.
        order: Names of the links, parents before children, otherwise in the order of the file.
        root: The only link that is no joint's child.
        notes: Joints that became fixed.
    """

    def __init__(self, path: Path):
        self.file = str(path)
        self.robot = parse_urdf(path)
        self.links = self._links()
        self.notes: list[str] = []
        self.joints = {joint.child: joint for joint in self._without_idle_mimics(self._joints())}
        self.order = self._parents_first()
        self.root = self.order[0]

    @property
    def is_plus(self) -> bool:
        """Whether the file has <loop>, <coupling> or `independent` of URDF+, or a <loop_joint>."""
        added = [self.robot.find(tag) for tag in ("loop", "coupling", "loop_joint")]
        return any(element is not None for element in added) or any(
            joint.element.get("independent") is not None for joint in self.joints.values()
        )

    def welded_to(self, link: str) -> Iterator[str]:
        """Iterate over `link` and the links rigidly joined to it by fixed joints beyond it, parents before children."""
        welded = {link}
        for other in self.order:
            joint = self.joints.get(other)
            if joint is not None and joint.type == "fixed" and joint.parent in welded:
                welded.add(other)
        return (other for other in self.order if other in welded)

    def hold(self, link: str) -> None:
        """Fix the joint of a link at 0, and joints that mimic it at their offsets."""
        self.joints[link] = replace(self.joints[link], type="fixed")
        self.joints = {joint.child: joint for joint in self._without_idle_mimics(list(self.joints.values()))}

    def _links(self) -> dict[str, Element]:
        links: dict[str, Element] = {}
        for element in self.robot.findall("link"):
            name = read.name_of(self.file, element)
            if name in links:
                raise invalid_value(self.file, "link name", name, "a name that no other link has")
            links[name] = element
        if len(links) > MOST_LINKS:
            raise invalid_value(self.file, "number of links", len(links), f"at most {MOST_LINKS}")
        if not links:
            raise invalid_value(self.file, "<robot>", None, "at least one <link>")
        return links

    def _joints(self) -> list[UrdfJoint]:
        joints: dict[str, UrdfJoint] = {}
        moved_by: dict[str, str] = {}
        for element in self.robot.findall("joint"):
            joint = self._joint(element)
            if joint.name in joints:
                raise invalid_value(self.file, "joint name", joint.name, "a name that no other joint has")
            if joint.child in moved_by:
                names = f"{moved_by[joint.child]!r} and {joint.name!r}"
                expected = "one joint; close a loop by a constraint instead"
                raise invalid_value(self.file, f"link {joint.child!r} parents", names, expected)
            joints[joint.name] = joint
            moved_by[joint.child] = joint.name
        return list(joints.values())

    def _without_idle_mimics(self, joints: list[UrdfJoint]) -> list[UrdfJoint]:
        """Return the joints; a joint that mimics a fixed joint, or 0 times a moving joint, becomes fixed.

        A <mimic> on a fixed joint has no effect.
        """
        by_name = {joint.name: joint for joint in joints}
        changed = True
        while changed:  # a chain of mimics ends in a fixed joint
            changed = False
            for name, joint in by_name.items():
                mimic = joint.element.find("mimic")
                other = None if mimic is None else by_name.get(mimic.get("joint", ""))
                if joint.type in ("fixed", "floating") or mimic is None or other is None:
                    continue
                ratio, offset = (read.number(self.file, joint.where, mimic, k, d) for k, d in MIMIC_DEFAULTS)
                if other.type != "fixed" and ratio != 0.0:
                    continue
                at = ratio * other.offset + offset
                by_name[name] = replace(joint, type="fixed", offset=at)
                why = "which is fixed" if other.type == "fixed" else "0 times"
                self.notes.append(f"{joint.where} mimics {other.name!r}, {why}: it is fixed at {at:g}")
                changed = True
        return list(by_name.values())

    def _joint(self, element: Element) -> UrdfJoint:
        name = read.name_of(self.file, element)
        where = f"joint {name!r}"
        kind = element.get("type")
        if kind not in (*MOVING, "fixed"):
            raise invalid_value(self.file, f"{where} type", kind, f"one of {', '.join((*MOVING, 'fixed'))}")
        ends = {}
        for end in ("parent", "child"):
            link = read.name_of(self.file, read.required(self.file, where, element, end), "link", where)
            if link not in self.links:
                raise unknown_name(self.file, f"{where} <{end} link>", link, self.links, "the name of a link")
            ends[end] = link
        return UrdfJoint(name, kind, ends["parent"], ends["child"], element)

    def _parents_first(self) -> list[str]:
        """Order the links so that parents come before children; the first is the only root."""
        roots = [link for link in self.links if link not in self.joints]
        if len(roots) > 1:
            raise invalid_value(self.file, "root links", roots, "one link that is no joint's child")
        order: dict[str, None] = {}
        for link in self.links:
            chain = [link]
            while (joint := self.joints.get(chain[-1])) is not None and chain[-1] not in order:
                if joint.parent in chain:
                    cycle = " -> ".join([*reversed(chain[chain.index(joint.parent) :]), joint.parent])
                    expected = "a tree; a cycle needs a constraint in place of one joint"
                    raise invalid_value(self.file, "joints", cycle, expected)
                chain.append(joint.parent)
            order.update(dict.fromkeys(reversed(chain)))
        return list(order)
