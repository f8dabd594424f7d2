"""The keys `urdf` and `mjcf` of YAML robot files: the file with the links."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Body, Robot, Shape
from ce_gym.model.errors import invalid_value
from ce_gym.model.formats.mjcf.robot import read_robot
from ce_gym.model.formats.placement import named_frames
from ce_gym.model.formats.reading import Section
from ce_gym.model.formats.rotor_links import FixedLink
from ce_gym.model.formats.urdf.drives import Drive
from ce_gym.model.formats.urdf.tree import Attachment, Base, read_urdf

_TIES = ("rotors", "constraints", "independent")
"""Keys that name links which move although they have no mass in the URDF file."""


@dataclass(frozen=True)
class Links:
    """The robot of the URDF or MJCF file, and the frames in it that the YAML file can name.

    Attributes:
        robot: The robot, not checked yet.
        frames: Body and pose of every frame with a name, merged links included.
        fixed: Links on fixed joints that the YAML file calls rotors, by name; no body includes their mass.
        collisions: The <collision> elements of each link of a URDF, in the link's frame; None for a mesh.
        drives: Motors in a URDF file.
        driven: Joints with rotors in the YAML file.
        joints: The link that each joint moves, by the name of the joint, where that differs from the link's.
    """

    robot: Robot
    frames: dict[str, Attachment]
    fixed: Mapping[str, FixedLink]
    collisions: Mapping[str, tuple[Shape | None, ...]]
    drives: tuple[Drive, ...] = ()
    driven: Collection[str] = ()
    joints: Mapping[str, str] = field(default_factory=dict)


def read_links(path: Path, file: Section) -> Links:
    """Read the URDF or MJCF that a YAML file names.

    Args:
        path: The YAML file.
        file: Its content.

    Raises:
        RobotError: The YAML file names neither or both, or the named file is wrong.
    """
    if ("urdf" in file) == ("mjcf" in file):
        value = None if "urdf" not in file else "both"
        raise invalid_value(file.file, "urdf or mjcf", value, "exactly one of them, the file with the links")
    rotors = file.section("rotors")
    driven = {joint for _, rotor in rotors.sections() for joint in names_in(rotor, "ratios")}
    if "urdf" in file:
        if "gears" in file:
            raise file.invalid("gears", "given", "none: a URDF has no armature; give `rotors`")
        base: Base | None = file.text("base", None, choices=("floating", "fixed"))  # type: ignore[assignment]
        tied = {word for key in _TIES for word in _words(file.data.get(key))}
        tree = read_urdf(path.parent / file.text("urdf"), base, rotors.data, tied)
        independent = _not_tied(tree.bodies, tree.constraints)
        frames = named_frames(tree.frames, tree.bodies)
        robot = Robot(tree.name, tree.bodies, tree.constraints, independent, frames=frames, notes=tree.notes)
        joints = joint_aliases(robot)
        driven = {joints.get(name, name) for name in driven}
        return Links(robot, dict(tree.frames), tree.fixed, tree.collisions, tree.drives, driven, joints)
    if "base" in file:
        raise file.invalid("base", file.get("base"), "no `base` beside `mjcf`: the MJCF file describes the base")
    robot, frames, fixed = read_robot(path.parent / file.text("mjcf"), file.section("gears"), driven, rotors.data)
    return Links(robot, frames, fixed, {}, joints=joint_aliases(robot))


def joint_aliases(robot: Robot) -> dict[str, str]:
    """Return the link that each joint moves, by the name of the joint, where that differs from the link's."""
    return {joint: link for joint, link in robot.links_by_joint.items() if joint != link}


def _words(value: object) -> Iterator[str]:
    """Iterate over the texts in a part of a file."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list | tuple):
        for item in value.items() if isinstance(value, dict) else value:
            yield from _words(item)


def names_in(section: Section, key: str) -> tuple[str, ...]:
    """Return the names under a key, which are a list or the keys of a mapping."""
    if isinstance(section.get(key, {}), list):
        return section.texts(key)
    return tuple(map(section.named, section.section(key)))


def _not_tied(bodies: tuple[Body, ...], constraints: tuple[LinearConstraint, ...]) -> tuple[str, ...]:
    """Return the joints without <mimic>."""
    solved = {constraint.bodies[0] for constraint in constraints}
    return tuple(body.name for body in bodies if body.joint.nv == 1 and body.name not in solved)
