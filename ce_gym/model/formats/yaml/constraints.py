"""The key `constraints` of YAML robot files: gears, differentials, closed loops, rods and users' functions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from ce_gym.model.constraints import Constraint, FunctionConstraint, LinearConstraint, LoopConstraint, RodConstraint
from ce_gym.model.description import Body
from ce_gym.model.formats.placement import compose, rotation_from_rpy, transform_point, vec3
from ce_gym.model.formats.reading import Section
from ce_gym.model.formats.urdf.elements import unit_axis
from ce_gym.model.formats.urdf.tree import WORLD, Attachment
from ce_gym.model.frames import ZERO, Placement


def read_constraints(file: Section, bodies: Iterable[Body], frames: dict[str, Attachment]) -> Iterator[Constraint]:
    """Iterate over the entries of the list `constraints`.

    Args:
        file: The whole file.
        bodies: All bodies.
        frames: Body and pose of every frame with a name, merged links included.
    """
    names = [body.name for body in bodies]
    for i, data in enumerate(file.list("constraints")):
        entry = Section(file.file, f"constraints[{i}]", data, file.aliases)
        yield READERS[entry.text("type", choices=tuple(READERS))](entry, names, frames)


def frame_named(section: Section, key: str, frames: dict[str, Attachment]) -> Attachment:
    """Return the body that carries the frame named under `key`, and the frame's pose in that body."""
    name = section.text(key)
    if name not in frames and name != WORLD:
        raise section.unknown(key, name, frames, "the name of a body")
    return frames.get(name, (None, Placement()))


def coefficients(section: Section, names: list[str]) -> tuple[tuple[str, float], ...]:
    """Return pairs of a body and a number other than 0."""
    for body in section:
        if section.named(body) not in names:
            raise section.unknown("", body, names, "the name of a body")
        if section.number(body) == 0.0:
            raise section.invalid(body, 0.0, "a number other than 0")
    return section.numbers()


def _linear(entry: Section, names: list[str], frames: dict[str, Attachment]) -> LinearConstraint:
    entry.allow("name", "type", "coefficients", "offset")
    pairs = coefficients(entry.section("coefficients"), names)
    return LinearConstraint(entry.text("name"), pairs, entry.number("offset", 0.0))


def _loop(entry: Section, names: list[str], frames: dict[str, Attachment]) -> LoopConstraint:
    entry.allow("name", "type", "joint", "axis", "first", "second")
    joint = entry.text("joint", choices=("revolute", "ball"))
    if joint == "ball" and "axis" in entry:
        raise entry.invalid("axis", entry.get("axis"), "no axis, because a ball joint has none")
    axis = unit_axis(entry.file, entry.key("axis"), entry.vector("axis", 3, (0.0, 0.0, 1.0)))
    (first, frame_1), (second, frame_2) = (_loop_end(entry, end, frames) for end in ("first", "second"))
    name = entry.text("name")
    return LoopConstraint(name, joint, first, second, frame_1, frame_2, axis)  # type: ignore[arg-type]


def _loop_end(entry: Section, end: str, frames: dict[str, Attachment]) -> Attachment:
    section = entry.section(end).allow("body", "xyz", "rpy")
    body, pose = frame_named(section, "body", frames)
    rotation = rotation_from_rpy(*section.vector("rpy", 3, ZERO))
    return body, compose(pose, Placement(vec3(section.vector("xyz", 3, ZERO)), rotation))


def _rod(entry: Section, names: list[str], frames: dict[str, Attachment]) -> RodConstraint:
    entry.allow("name", "type", "length", "first", "second")
    ends = []
    for end in ("first", "second"):
        section = entry.section(end).allow("body", "point")
        body, pose = frame_named(section, "body", frames)
        ends.append((body, transform_point(pose, vec3(section.vector("point", 3)))))
    (first, first_point), (second, second_point) = ends
    return RodConstraint(entry.text("name"), first, second, first_point, second_point, entry.number("length"))


def _function(entry: Section, names: list[str], frames: dict[str, Attachment]) -> FunctionConstraint:
    entry.allow("name", "type", "function", "arguments", "dependent")
    return FunctionConstraint(
        entry.text("name"), entry.text("function"), entry.texts("arguments"), entry.texts("dependent")
    )


READERS: dict[str, Callable[[Section, list[str], dict[str, Attachment]], Constraint]] = {
    "linear": _linear,
    "loop": _loop,
    "rod": _rod,
    "function": _function,
}
"""Functions (entry, names of bodies, frames) that read a kind of constraint, by its `type`."""
