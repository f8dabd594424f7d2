"""The keys `contacts`, `capsules` and `self_collisions` of YAML robot files.

A contact with the ground is a sphere, a primitive, or the <collision> elements of a link in the URDF file. Primitives
become spheres.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ce_gym.model.description import Capsule, ContactSphere, Shape
from ce_gym.model.errors import invalid_value
from ce_gym.model.formats.contact_shapes import FACES, on_face, rims_of, spheres_of
from ce_gym.model.formats.placement import compose, rotation_from_rpy, transform_point, vec3
from ce_gym.model.formats.reading import Section
from ce_gym.model.formats.yaml.constraints import frame_named
from ce_gym.model.formats.yaml.links import Links
from ce_gym.model.frames import ZERO, Placement

SIZES = {"box": 3, "cylinder": 2, "capsule": 2}
"""Number of lengths of a primitive: edges, or radius and length along z [m]."""
MOST_ON_RIM = 64
"""Most spheres on one rim of a cylinder."""


def read_contacts(file: Section, links: Links) -> Iterator[ContactSphere]:
    """Iterate over the contact spheres; the spheres of a primitive are numbered."""
    if "contacts" not in file:
        yield from links.robot.contacts
    for name, entry in file.section("contacts").sections():
        body, frame = frame_named(entry, "body", links.frames)
        if body is None:
            raise entry.invalid("body", entry.text("body"), "a body that moves")
        group, kind = entry.text("group", "foot"), entry.text("shape", "sphere", ("sphere", *SIZES, "collision"))
        if kind == "sphere":
            entry.allow("body", "shape", "position", "radius", "group", "rolls")
            _rolls(entry, kind)
            centre = transform_point(frame, vec3(entry.vector("position", 3)))
            yield ContactSphere(name, body, centre, entry.number("radius"), group)
            continue
        shapes = list(_collisions(entry, links)) if kind == "collision" else [_primitive(entry, kind)]
        for i, shape in enumerate(shapes):
            stem = f"{name}_{i + 1}" if len(shapes) > 1 else name
            pose = compose(frame, shape.placement)
            axis = vec3([row[2] for row in pose.rotation])
            for suffix, centre, radius in _spheres(entry, shape):
                at = transform_point(pose, vec3(centre))
                contact = ContactSphere(f"{stem}{suffix}", body, at, radius, group, shape=stem)
                rim = shape.size[0] - radius if _rolls(entry, kind) else 0.0
                yield replace(contact, rim=rim, axis=axis) if rim else contact


def read_capsules(section: Section, links: Links) -> Iterator[Capsule]:
    """Iterate over the capsules under the name of each link."""
    for link in section:
        if links.frames.get(link, (None, None))[0] is None:
            raise section.unknown("", link, links.frames, "the name of a body that moves")
        body, frame = links.frames[link]
        entries = section.list(link) if isinstance(section.get(link), list) else [section.get(link)]
        for i, data in enumerate(entries):
            entry = Section(section.file, f"{section.key(link)}[{i}]", data).allow("from", "to", "radius")
            start = entry.vector("from", 3)
            ends = [transform_point(frame, vec3(end)) for end in (start, entry.vector("to", 3, start))]
            yield Capsule(str(body), ends[0], ends[1], entry.number("radius"))


def read_pairs(file: Section, links: Links) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links that may collide, by the names of their bodies."""
    pairs: list[tuple[str, str]] = []
    for i, pair in enumerate(file.list("self_collisions")):
        key = f"{file.key('self_collisions')}[{i}]"
        if not (isinstance(pair, list) and len(pair) == 2 and all(isinstance(name, str) for name in pair)):
            raise file.invalid(key, pair, "a list of two links")
        for name in pair:
            if links.frames.get(name, (None, None))[0] is None:
                raise file.unknown(key, name, links.frames, "the name of a body that moves")
        pairs.append((str(links.frames[pair[0]][0]), str(links.frames[pair[1]][0])))
    return tuple(pairs)


def _primitive(entry: Section, kind: str) -> Shape:
    entry.allow("body", "shape", "size", "position", "rpy", "radius", "face", "rim", "rolls", "group")
    size = entry.vector("size", SIZES[kind])
    if min(size) < 0.0 or (kind != "capsule" and min(size) == 0.0):
        raise entry.invalid("size", list(size), "lengths above 0 [m]")
    rotation = rotation_from_rpy(*entry.vector("rpy", 3, ZERO))
    placement = Placement(vec3(entry.vector("position", 3, ZERO)), rotation)
    return Shape(kind, size, placement)  # type: ignore[arg-type]


def _rolls(entry: Section, kind: str) -> bool:
    """Return whether contacts move around the rims of a cylinder."""
    rolls = entry.get("rolls", False)
    if not isinstance(rolls, bool):
        raise entry.invalid("rolls", rolls, "true or false")
    if rolls and kind != "cylinder":
        raise entry.invalid("rolls", rolls, f"`shape: cylinder` and not {kind}")
    if rolls and "rim" in entry:
        raise entry.invalid("rim", entry.get("rim"), "none: with `rolls`, each rim is one contact")
    return rolls


def _collisions(entry: Section, links: Links) -> Iterator[Shape]:
    """Iterate over the <collision> elements of a link."""
    entry.allow("body", "shape", "radius", "face", "rim", "rolls", "group")
    link = entry.text("body")
    shapes = links.collisions.get(link, ())
    if not shapes or None in shapes:
        value, expected = ("a mesh", "primitives") if shapes else (None, "some in its URDF file")
        expected = f"{expected}: box, cylinder or sphere"
        raise invalid_value(entry.file, f"{entry.path} <collision> of {link!r}", value, expected)
    return (shape for shape in shapes if shape)


def _spheres(entry: Section, shape: Shape) -> list[tuple[str, np.ndarray, float]]:
    """Return suffixes, centres in the frame of a shape and radii of the spheres that stand for it."""
    radius, rim = entry.number("radius", 0.0), entry.number("rim", 8.0)
    most = {"box": min(shape.size) / 2, "cylinder": min(shape.size[0], shape.size[-1] / 2)}.get(shape.type, 0.0)
    if not 0.0 <= radius <= most and "radius" in entry:
        expected = f"from 0 to {most:g} [m], by which edges are rounded" if most else "no radius beside `size`"
        raise entry.invalid("radius", radius, expected)
    if rim not in range(3, MOST_ON_RIM + 1):
        raise entry.invalid("rim", rim, f"a whole number from 3 to {MOST_ON_RIM}, of spheres on a rim")
    face = entry.text("face", "", FACES)
    if _rolls(entry, shape.type):
        if face not in ("", "+z", "-z"):
            raise entry.invalid("face", face, "+z or -z, one of the two rims")
        return on_face(rims_of(shape.size, radius), face)
    return on_face(list(spheres_of(shape.type, shape.size, radius, int(rim))), face)
