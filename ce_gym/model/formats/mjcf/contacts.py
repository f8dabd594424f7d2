"""The geoms of a compiled MJCF file that can touch the ground -> contact spheres.

| geom      | spheres                                                                                  |
|-----------|------------------------------------------------------------------------------------------|
| sphere    | the sphere itself                                                                        |
| capsule   | one at each end                                                                          |
| box       | points at the eight corners                                                              |
| cylinder  | four points on each rim: up to 0.3 radii short of the rim between them                   |
| ellipsoid | points at the ends of the axes                                                           |
| mesh      | the outermost vertices along the eight diagonals of the axes                             |

Every sphere lies inside its geom. A geom can touch the ground if MuJoCo lets it touch a fixed geom, or, in a file
without fixed geoms, any geom. The ground is the plane z = 0.

Groups follow from the reference pose. "foot" is the group of the lowest spheres, not on the base. "torso" is the group
on the base and on bodies that carry several limbs. "limb" is the rest, which tasks simulate only on request.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ce_gym.model.description import ContactMaterial, ContactSphere
from ce_gym.model.formats.contact_shapes import DIAGONALS, Sphere, points, spheres_of
from ce_gym.model.formats.mjcf.bodies import MjcfTree
from ce_gym.model.formats.mjcf.source import MjcfSource, rotation
from ce_gym.model.formats.mjcf.touching import can_touch, is_ground, solid, touch_of, touched
from ce_gym.model.formats.placement import transform_point, vec3

FOOT_BAND = 0.02
"""Largest height of the underside of a foot above the lowest underside [m]."""

RIM = 4
"""Points on each rim of a cylinder."""


def read_contacts(source: MjcfSource, tree: MjcfTree) -> tuple[tuple[ContactSphere, ...], ContactMaterial, float]:
    """Return the contact spheres, their material, and the height of the lowest underside [m] (0 without spheres)."""
    geoms = [g for g in range(source.model.ngeom) if _carrier(source, tree, g) is not None]
    ground = [g for g in range(source.model.ngeom) if _carrier(source, tree, g) is None]
    _report_ground(source, ground)
    _report_between(source, tree, geoms)
    spheres, heights, frictions = [], [], list[float]()
    ball = source.mujoco.mjtGeom.mjGEOM_SPHERE
    for geom, friction in _frictions(source, geoms, ground):
        for name, centre, radius in _spheres(source, geom):
            body, frame = tree.frames[source.model.geom_bodyid[geom]]
            point = np.array(source.model.geom_pos[geom]) + rotation(source.model.geom_quat[geom]) @ centre
            at = transform_point(frame, vec3(point))
            shape = "" if source.model.geom_type[geom] == ball else source.name("geom", geom)
            spheres.append(ContactSphere(name, str(body), at, radius, shape=shape))
            world = source.data.geom_xpos[geom] + source.data.geom_xmat[geom].reshape(3, 3) @ centre
            heights.append(float(world[2]) - radius)
            frictions.append(friction)
    contacts = _grouped(spheres, heights, tree)
    return contacts, _material(source, contacts, frictions), min(heights, default=0.0)


def _frictions(source: MjcfSource, geoms: list[int], ground: list[int]) -> Iterator[tuple[int, float]]:
    """Iterate over the geoms that can touch the ground, each with its friction; note other contact properties."""
    anything, unlike = any(solid(source, g) for g in ground), dict[str, None]()
    for geom in geoms:
        under = touched(source, geom, ground)
        if not under and (anything or not solid(source, geom)):
            continue
        touches = [touch_of(source, geom, g) for g in under or [None]]
        unlike |= {what: None for touch in touches for what in touch.other}
        yield geom, max(touch.friction for touch in touches)
    for what in unlike:
        source.leave_out(what)


def _carrier(source: MjcfSource, tree: MjcfTree, geom: int) -> str | None:
    return tree.frames[source.model.geom_bodyid[geom]][0]


def _spheres(source: MjcfSource, geom: int) -> Iterator[Sphere]:
    """Iterate over name, centre [m] in the geom's frame and radius [m] of the spheres that stand for a geom."""
    name = source.name("geom", geom)
    return ((f"{name}{suffix}", centre, radius) for suffix, centre, radius in _parts(source, geom, name))


def _parts(source: MjcfSource, geom: int, name: str) -> Iterator[Sphere]:
    kinds, kind = source.mujoco.mjtGeom, source.model.geom_type[geom]
    a, b, c = (float(x) for x in source.model.geom_size[geom])
    if kind == kinds.mjGEOM_SPHERE:
        yield from spheres_of("sphere", (a,))
    elif kind == kinds.mjGEOM_CAPSULE:
        yield from spheres_of("capsule", (a, 2 * b))
    elif kind == kinds.mjGEOM_BOX:
        yield from spheres_of("box", (2 * a, 2 * b, 2 * c))
    elif kind == kinds.mjGEOM_CYLINDER:
        yield from spheres_of("cylinder", (a, 2 * b), rim=RIM)
    elif kind == kinds.mjGEOM_ELLIPSOID:
        yield from points("_end", np.vstack([np.diag((a, b, c)), -np.diag((a, b, c))]))
    elif kind == kinds.mjGEOM_MESH:
        mesh = int(source.model.geom_dataid[geom])
        first, count = int(source.model.mesh_vertadr[mesh]), int(source.model.mesh_vertnum[mesh])
        vertices = np.array(source.model.mesh_vert[first : first + count], dtype=float)
        furthest = dict.fromkeys(int(np.argmax(vertices @ diagonal)) for diagonal in DIAGONALS)
        yield from points("_vertex", vertices[list(furthest)])
    else:
        source.leave_out("contact of geom {}, which is a height field or signed distance field", name)


def _grouped(spheres: list[ContactSphere], heights: list[float], tree: MjcfTree) -> tuple[ContactSphere, ...]:
    """Name the groups from the heights [m] of the undersides at the reference pose."""
    base = next((body.name for body in tree.bodies if body.joint.type == "free"), None)
    lowest = min((h for sphere, h in zip(spheres, heights, strict=True) if sphere.body != base), default=0.0)
    trunk = _trunk(spheres, tree, base)

    def group(sphere: ContactSphere, height: float) -> str:
        if sphere.body != base and height <= lowest + FOOT_BAND:
            return "foot"
        return "torso" if sphere.body in trunk else "limb"

    return tuple(replace(sphere, group=group(sphere, height)) for sphere, height in zip(spheres, heights, strict=True))


def _trunk(spheres: list[ContactSphere], tree: MjcfTree, base: str | None) -> set[str]:
    """Return the base, if it is free, and the bodies on which several limbs with contacts hang."""
    if base is None:
        return set()
    limbs: dict[str, set[str]] = {}
    for sphere in spheres:
        body, carrier = sphere.body, tree.parent(sphere.body)
        while carrier is not None:
            limbs.setdefault(carrier, set()).add(body)
            body, carrier = carrier, tree.parent(carrier)
    return {base} | {carrier for carrier, bodies in limbs.items() if len(bodies) > 1}


def _material(source: MjcfSource, contacts: tuple[ContactSphere, ...], frictions: list[float]) -> ContactMaterial:
    """Return the most frequent friction of feet, or of all contacts if there are no feet.

    MuJoCo's compliance of contacts has no counterpart in N/m.
    """
    if not contacts:
        return ContactMaterial()
    pairs = list(zip(contacts, frictions, strict=True))
    feet = [friction for contact, friction in pairs if contact.group == "foot"] or frictions
    chosen = max(sorted(set(feet), reverse=True), key=feet.count)
    others: dict[float, list[str]] = {}
    for contact, friction in pairs:
        if friction != chosen:
            others.setdefault(friction, []).append(contact.name)
    for friction, names in sorted(others.items()):
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        source.leave_out(f"friction other than {chosen:g}: {{}}", f"{friction:g} of {names[0]}{more}")
    return ContactMaterial(friction=chosen)


def _report_ground(source: MjcfSource, ground: list[int]) -> None:
    for g in ground:
        if solid(source, g) and not is_ground(source, g):
            source.leave_out("obstacle {} (the ground is the plane z = 0)", source.name("geom", g))


def _report_between(source: MjcfSource, tree: MjcfTree, geoms: list[int]) -> None:
    """Note that bodies of the robot can pass through each other, unlike in MuJoCo."""
    parents = {body.name: body.parent for body in tree.bodies}
    for i, a in enumerate(geoms):
        for b in geoms[:i]:
            first, second = str(_carrier(source, tree, a)), str(_carrier(source, tree, b))
            jointed = source.enabled("FILTERPARENT") and (first == parents[second] or second == parents[first])
            if first != second and not jointed and can_touch(source, a, b):
                source.leave_out("contact between bodies of the robot")
                return
