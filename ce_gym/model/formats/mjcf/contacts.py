"""The geoms of a compiled MJCF file that can touch the ground -> contact spheres.

| geom      | spheres                                                                                  |
|-----------|------------------------------------------------------------------------------------------|
| sphere    | itself                                                                                   |
| capsule   | the two at its ends                                                                      |
| box       | points at its eight corners                                                              |
| cylinder  | points on both rims, four each: up to 0.3 radii short of the rim between them            |
| ellipsoid | points at the ends of its axes                                                           |
| mesh      | its vertices that reach furthest along the eight diagonals of its axes                   |

None of them sticks out of its geom. A geom can touch the ground if MuJoCo would let it touch one of the geoms that do
not move, or, in a file without any, anything at all. The ground is the plane z = 0.

Groups follow from the reference pose: "foot" is what is lowest, the base apart; "torso" is on the base and on bodies
beyond it that several limbs hang on; "limb" is the rest, which no task simulates unless it is told to.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ce_gym.model.description import ContactMaterial, ContactSphere
from ce_gym.model.formats.contact_shapes import DIAGONALS, Sphere, points, spheres_of
from ce_gym.model.formats.mjcf.bodies import MjcfTree
from ce_gym.model.formats.mjcf.source import MjcfSource, rotation
from ce_gym.model.formats.placement import transform_point, vec3

FOOT_BAND = 0.02
"""Spheres whose undersides are this close [m] to the lowest one are feet."""

RIM = 4
"""Points on each rim of a cylinder."""

_DEFAULT_SOLVER = ((0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0))  # MuJoCo's solref and solimp


def read_contacts(source: MjcfSource, tree: MjcfTree) -> tuple[tuple[ContactSphere, ...], ContactMaterial, float]:
    """Return the contact spheres, their material, and how high their lowest underside is [m] (0 without any)."""
    geoms = [g for g in range(source.model.ngeom) if _carrier(source, tree, g) is not None]
    ground = [g for g in range(source.model.ngeom) if _carrier(source, tree, g) is None]
    touching = [g for g in geoms if _touches(source, g, ground)]
    _report_ground(source, ground)
    _report_between(source, tree, geoms)
    spheres, heights, ball = [], [], source.mujoco.mjtGeom.mjGEOM_SPHERE
    for geom in touching:
        for name, centre, radius in _spheres(source, geom):
            body, frame = tree.frames[source.model.geom_bodyid[geom]]
            point = np.array(source.model.geom_pos[geom]) + rotation(source.model.geom_quat[geom]) @ centre
            at = transform_point(frame, vec3(point))
            shape = "" if source.model.geom_type[geom] == ball else source.name("geom", geom)
            spheres.append(ContactSphere(name, str(body), at, radius, shape=shape))
            world = source.data.geom_xpos[geom] + source.data.geom_xmat[geom].reshape(3, 3) @ centre
            heights.append(float(world[2]) - radius)
    return _grouped(spheres, heights, tree), _material(source, touching, ground), min(heights, default=0.0)


def _carrier(source: MjcfSource, tree: MjcfTree, geom: int) -> str | None:
    return tree.frames[source.model.geom_bodyid[geom]][0]


def _match(source: MjcfSource, a: int, b: int) -> bool:
    """Whether the masks of two geoms let them touch."""
    own, other = source.model.geom_contype, source.model.geom_conaffinity
    return bool(own[a] & other[b] or own[b] & other[a])


def _touches(source: MjcfSource, geom: int, ground: list[int]) -> bool:
    model = source.model
    solid = [g for g in ground if _solid(source, g)]
    pairs = {frozenset((int(a), int(b))) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    if any(frozenset((geom, g)) in pairs for g in ground):
        return True
    excluded = {int(x) for x in model.exclude_signature}
    body = int(model.geom_bodyid[geom])
    free = [g for g in solid if not {(int(model.geom_bodyid[g]) << 16) + body, body << 16} & excluded]
    if solid:
        return any(_match(source, geom, g) for g in free)
    return _solid(source, geom)


def _solid(source: MjcfSource, geom: int) -> bool:
    """Whether a geom touches anything at all."""
    return bool(source.model.geom_contype[geom] or source.model.geom_conaffinity[geom])


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


def _material(source: MjcfSource, touching: list[int], ground: list[int]) -> ContactMaterial:
    """Return MuJoCo's friction, the larger of the two that touch; its compliance has no counterpart in N/m."""
    model = source.model
    under = [g for g in ground if _solid(source, g)]
    rough = max((float(model.geom_friction[g][0]) for g in under), default=0.0)
    values = sorted({max(float(model.geom_friction[g][0]), rough) for g in touching})
    if len(values) > 1:
        every = ", ".join(f"{value:g}" for value in values)
        source.leave_out("friction other than {}", f"{values[-1]:g} (the file has {every})")
    if any(model.geom_condim[g] > 3 for g in touching):
        source.leave_out("torsional and rolling friction")
    solvers = [(tuple(map(float, model.geom_solref[g])), tuple(map(float, model.geom_solimp[g]))) for g in touching]
    if any(not np.allclose(np.hstack(solver), np.hstack(_DEFAULT_SOLVER)) for solver in solvers):
        source.leave_out("the compliance of contacts (solref, solimp)")
    return ContactMaterial(friction=values[-1]) if values else ContactMaterial()


def _report_ground(source: MjcfSource, ground: list[int]) -> None:
    model, plane = source.model, source.mujoco.mjtGeom.mjGEOM_PLANE
    for g in ground:
        normal, height = source.data.geom_xmat[g].reshape(3, 3)[:, 2], source.data.geom_xpos[g][2]
        flat = model.geom_type[g] == plane and np.allclose(normal, (0, 0, 1)) and abs(height) < 1e-9
        if _solid(source, g) and not flat:
            source.leave_out("obstacle {} (the ground is the plane z = 0)", source.name("geom", g))


def _report_between(source: MjcfSource, tree: MjcfTree, geoms: list[int]) -> None:
    """Note that bodies of the robot pass through each other, if in MuJoCo they would not."""
    parents = {body.name: body.parent for body in tree.bodies}
    for i, a in enumerate(geoms):
        for b in geoms[:i]:
            first, second = str(_carrier(source, tree, a)), str(_carrier(source, tree, b))
            apart = first != second and first != parents[second] and second != parents[first]
            if apart and _match(source, a, b):
                source.leave_out("contact between bodies of the robot")
                return
