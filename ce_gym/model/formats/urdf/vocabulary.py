"""Elements and attributes of a URDF file that are not read; each becomes a note.

Source: wiki.ros.org/urdf/XML. <visual> and <material> are for display only and are not checked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from xml.etree.ElementTree import Element

CHILDREN = {
    "robot": {"link", "joint", "material", "transmission", "gazebo", "mujoco", "loop", "coupling", "loop_joint"},
    "link": {"inertial", "visual", "collision"},
    "inertial": {"origin", "mass", "inertia"},
    "collision": {"origin", "geometry", "material"},
    "geometry": {"box", "sphere", "cylinder", "capsule", "mesh"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic"},
}
"""Elements that are read, by their parent element."""
ATTRIBUTES = {
    "robot": {"name", "version"},
    "link": {"name"},
    "joint": {"name", "type", "independent"},
    "collision": {"name"},
    "origin": {"xyz", "rpy"},
    "mass": {"value"},
    "inertia": {"ixx", "ixy", "ixz", "iyy", "iyz", "izz"},
    "box": {"size"},
    "sphere": {"radius"},
    "cylinder": {"radius", "length"},
    "capsule": {"radius", "length"},
    "mesh": {"filename", "scale"},
    "parent": {"link"},
    "child": {"link"},
    "axis": {"xyz"},
    "limit": {"lower", "upper", "effort", "velocity"},
    "dynamics": {"damping", "friction", "stiffness", "rotor_inertia"},
    "mimic": {"joint", "multiplier", "offset"},
}
"""Attributes that are read."""
EXTENSIONS = {
    "gazebo": {"material", "sensor", "visual"},
    "mujoco": {"meshdir", "assetdir", "strippath", "discardvisual"},
}
"""Elements for other programs, and words in them for display, sensors or files."""
SPRINGS = {"springStiffness": "stiffness", "springReference": "springref"}
"""Words of <gazebo reference="JOINT"> that are read, and the field of `Joint` for each."""
READ_ELSEWHERE = ("visual", "material", "transmission", "loop", "coupling", "loop_joint")
"""Elements whose content is checked elsewhere or not at all."""


def unread_words(robot: Element) -> tuple[str, ...]:
    """Return a note for each kind of element or attribute that is not read, with its number of occurrences."""
    counts = Counter(_unread("", robot))
    words = [f"<{tag}>: {', '.join(_counted(of))}" for tag in EXTENSIONS if (of := Counter(_extended(robot, tag)))]
    return tuple(f"left out: {word}" for word in (*_counted(counts), *words))


def _counted(words: Counter[str]) -> list[str]:
    return [f"{word}{f' ({count} times)' if count > 1 else ''}" for word, count in words.items()]


def _extended(robot: Element, tag: str) -> Iterator[str]:
    """Iterate over the words for another program that are not read, each with its attributes if it has some."""
    joints = {joint.get("name") for joint in robot.findall("joint") if joint.get("type") != "fixed"}
    for element in robot.findall(tag):
        springs = SPRINGS if element.get("reference") in joints else ()
        for child in element:
            names = [name for name in child.attrib if name not in ("name", "value", "type", "filename")]
            words = [f"{child.tag} {name}" for name in names if name not in EXTENSIONS[tag]]
            if child.tag not in EXTENSIONS[tag] and child.tag not in springs and (words or not names):
                yield from words or [child.tag]


def _unread(parent: str, element: Element) -> Iterator[str]:
    """Iterate over the words under an element that are not read, as `<joint><calibration>` or `<limit jerk>`."""
    tag = element.tag
    if tag in EXTENSIONS and parent == "robot":
        return
    if parent and tag not in CHILDREN.get(parent, ()):
        yield f"<{parent}><{tag}>"
        return
    if tag in READ_ELSEWHERE:
        return
    known = ATTRIBUTES.get(tag, set())
    yield from (f"<{tag} {name}>" for name in element.attrib if name not in known and not name.startswith("xmlns"))
    for child in element:
        yield from _unread(tag, child)
