"""Convex shapes whose corners are contacts: contacts between the corners, for uneven ground.

A convex shape touches a plane with corners only, so flat ground needs no other contacts. On a height field the
ground between corners can be higher than the plane through them: a ridge under a sole, the edge of a stair. A `Hull`
has points on the edges and faces of such a shape, in regions around up to eight of its corners. Each region has one
further contact. With the depths `d_i` of the region's points in the ground, the contact acts at their weighted mean

    p = sum(w_i p_i) / sum(w_i),    w_i = (d_i / D)^3 / sqrt(n),    D = (sum(d_i^4) / sqrt(n))^(1/4),

with the depth `D |sum(w_i n_i)|`. The force `k D sum(w_i n_i)` has the potential `k D^2 / 2` of all points. It
therefore does not jump when another point becomes the deepest, and repeated touching gains no energy, except where the
ground's slope changes under a point. A region with one point in the ground is `n^(-1/4)` times as stiff as a corner; a
region with all its n points in the ground is `n^(1/4)` times as stiff.

A point counts only if the ground under the point is more than `RISE` above the ground interpolated between the corners.
A shape that stands flat thus rests on its corners, with their stiffness.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.recursion.kinematics import constant
from ce_gym.model.frames import Vec3

Array = NDArray[np.float64]

MOST_POINTS = 256
"""Most points on one hull."""
MOST_CORNERS = 32
"""Most corners of one hull; of more corners, the ones furthest apart are chosen."""
RISE = 1e-3
"""Rise between corners up to which the ground counts as a plane [m]."""
LATTICE = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 sequence (Roberts 2018): powers of the inverse of the plastic number."""
LEAST_DEPTH = 2e-4
"""Depth above which the shares of a region's points in its force depend on their depths only [m]."""
STEEPNESS = 25.0
"""Largest depth of a point over the ground's rise above `RISE` [-]."""


@dataclass(frozen=True)
class Hull:
    """A convex shape on one body.

    Attributes:
        body: Name of the body.
        radius: Radius of the spheres at the corners [m].
        points: Points between the corners, in the body frame [m].
        weights: For each point, pairs (contact, weight) of the corners around it; contacts by index in the scene.
        regions: For each region, the corner to which its force is added, and its points.
        spacing: Largest distance of points along edges [m].
    """

    body: str
    radius: float
    points: tuple[Vec3, ...]
    weights: tuple[tuple[tuple[int, float], ...], ...]
    regions: tuple[tuple[int, tuple[int, ...]], ...]
    spacing: float


def poles_of(hulls: Sequence[Hull]) -> tuple[int, ...]:
    """Return the corner to which the force of each region of hulls is added, by index in the scene."""
    return tuple(corner for hull in hulls for corner, _ in hull.regions)


def with_hulls(of_contacts: SX, hulls: Sequence[Hull]) -> SX:
    """Add the last rows or columns, of regions of hulls, to the rows or columns of their corners."""
    poles = poles_of(hulls)
    if not poles:
        return of_contacts
    rows = of_contacts.T if of_contacts.shape[1] == 1 else of_contacts
    n = rows.shape[1] - len(poles)
    total = SX(rows[:, :n])
    for i, corner in enumerate(poles):
        total[:, corner] += rows[:, n + i]
    return total.T if of_contacts.shape[1] == 1 else total


def hull_of(body: str, radius: float, corners: dict[int, Vec3], spacing: float) -> Hull:
    """Return the convex hull of contacts.

    Args:
        body: Name of the body with the contacts.
        radius: Radius of the contacts [m].
        corners: Centres of the contacts in the body frame [m], by index in the scene.
        spacing: Largest distance of points [m]; increased until the hull has at most `MOST_POINTS` points.
    """
    names, at = list(corners), np.array(list(corners.values()))
    scale = float(np.ptp(at, axis=0).max())
    chosen = _spread(at, MOST_CORNERS)
    rank = int((np.linalg.svd(at - at.mean(0), compute_uv=False) > 1e-6 * scale).sum())
    faces = [[chosen[i] for i in face] for face in _faces(at[chosen], rank, scale)]
    while len(all_weights := _between(at, faces, spacing, 1e-6 * scale)) > MOST_POINTS:
        spacing *= 1.1
    outer = sorted({i for face in faces for i in face})
    poles = [outer[i] for i in _spread(at[outer], 2**rank)]
    points = np.array([weights @ at for weights in all_weights]).reshape(-1, 3)
    far = np.linalg.norm(points[:, None] - at[poles], axis=2)
    near = far <= far.min(axis=1, keepdims=True) + 1e-6 * scale
    regions = [(names[pole], tuple(np.flatnonzero(near[:, k]).tolist())) for k, pole in enumerate(poles)]
    return Hull(
        body,
        radius,
        tuple((float(x), float(y), float(z)) for x, y, z in points),
        tuple(tuple((names[i], float(weights[i])) for i in np.flatnonzero(weights)) for weights in all_weights),
        tuple(region for region in regions if region[1]),
        spacing,
    )


def _spread(points: Array, count: int) -> list[int]:
    """Return up to so many points that lie far apart, each the furthest from those before, in their order."""
    far = np.linalg.norm(points - points.mean(0), axis=1)
    chosen: list[int] = []
    while len(chosen) < min(count, len(points)) and far.max() > 0:
        chosen.append(int((far > far.max() * (1 - 1e-9)).argmax()))
        apart = np.linalg.norm(points - points[chosen[-1]], axis=1)
        far = np.minimum(far, apart) if len(chosen) > 1 else apart
    return sorted(chosen)


def _faces(points: Array, rank: int, scale: float) -> list[list[int]]:
    """Return the corners of each face, in order around it: one face if all lie in a plane, two corners on a line."""
    tolerance = 1e-6 * scale
    if rank == 1:
        along = (points - points[0]) @ np.linalg.svd(points - points.mean(0))[2][0]
        return [[int(along.argmin()), int(along.argmax())]]
    if rank == 2:
        return [_around(points, list(range(len(points))), np.linalg.svd(points - points.mean(0))[2][2], tolerance)]
    faces: dict[frozenset[int], Array] = {}
    for a, b, c in itertools.combinations(range(len(points)), 3):
        normal = np.cross(points[b] - points[a], points[c] - points[a])
        if (length := np.linalg.norm(normal)) <= tolerance * scale:
            continue
        height = (points - points[a]) @ normal / length
        if height.max() <= tolerance or height.min() >= -tolerance:
            faces[frozenset(np.flatnonzero(np.abs(height) <= tolerance).tolist())] = normal / length
    return [_around(points, sorted(face), normal, tolerance) for face, normal in faces.items()]


def _around(points: Array, members: list[int], normal: Array, tolerance: float) -> list[int]:
    """Return the corners of the hull of points in a plane, in order around the hull."""
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    axes = np.stack([u / np.linalg.norm(u), np.cross(normal, u) / np.linalg.norm(u)])
    flat = {i: axes @ points[i] for i in members}
    middle = np.mean([flat[i] for i in members], axis=0)
    order = sorted(members, key=lambda i: float(np.arctan2(*(flat[i] - middle)[::-1])))
    kept = True
    while kept:
        kept = False
        for k, i in enumerate(order):
            (ax, ay), (bx, by) = flat[i] - flat[order[k - 1]], flat[order[(k + 1) % len(order)]] - flat[i]
            if len(order) > 3 and ax * by - ay * bx <= tolerance * tolerance:
                order.pop(k)
                kept = True
                break
    return order


def _between(points: Array, faces: list[list[int]], spacing: float, tolerance: float) -> list[Array]:
    """Return the weights of the corners in points all over the faces, without the corners themselves."""
    weights_at: dict[tuple[int, ...], Array] = {}
    for face in faces:
        for k in range(1, max(len(face) - 1, 2), 2):  # a fan of quadrangles, the last perhaps a triangle
            a, b, c, d = face[0], face[k], face[min(k + 1, len(face) - 1)], face[min(k + 2, len(face) - 1)]
            if len(face) == 2:
                c, d = b, a
            n, m = (
                int(max(1, np.ceil(max(np.linalg.norm(points[i] - points[j]) for i, j in sides) / spacing - 1e-9)))
                for sides in (((a, b), (d, c)), ((a, d), (b, c)))
            )
            for u, v in _grid(n, m):
                weights = np.zeros(len(points))
                for i, weight in ((a, (1 - u) * (1 - v)), (b, u * (1 - v)), (c, u * v), (d, (1 - u) * v)):
                    weights[i] += weight
                if weights.max() < 1 - 1e-9:
                    weights_at.setdefault(tuple(np.rint(weights @ points / tolerance).astype(int).tolist()), weights)
    return list(weights_at.values())


def _grid(n: int, m: int) -> Array:
    """Return places (u, v) on a square: evenly on its sides, and inside as many as the inner corners of n by m cells.

    The places inside are a lattice in one quarter, mirrored to the others. No two have the same `u` or the same `v`,
    which locates the edge of a ridge or a stair more exactly than the spacing of the points.
    """
    along, across = np.arange(n + 1) / n, np.arange(m + 1) / m
    sides = [(u, v) for u in along for v in (0.0, 1.0)] + [(u, v) for u in (0.0, 1.0) for v in across]
    k = np.arange(-(-(n - 1) * (m - 1) // 4))[:, None]
    quarter = ((0.5 + (k + 1) * LATTICE) % 1.0) / 2
    inside = [np.abs(mirror - quarter) for mirror in itertools.product((0.0, 1.0), repeat=2)]
    return np.concatenate([sides, *inside])


def hull_contacts(hull: Hull, up: SX, z: SX, under: SX, corners: SX) -> list[tuple[SX, SX, SX]]:
    """Return where each region of a hull touches the ground: point (3,) in the body frame [m], depth [m], normal (3,).

    A rounded hull touches straight below its points. On ground inclined by an angle `b` against the line between the
    points, the depth is `radius (1 / cos b - 1)` less than the depth of a sphere.

    Args:
        hull: The hull.
        up: The world's upward direction in the body frame, shape (3,).
        z: Heights of the points [m], shape (n,).
        under: Height [m] and slopes of the ground under each point, shape (3, n).
        corners: Height of the ground under the contacts of the scene [m], shape (n_contacts,).
    """
    depths, normals = [], []
    for i, weights in enumerate(hull.weights):
        cosine = 1 / ca.sqrt(1 + ca.sumsqr(under[1:, i]))
        rise = under[0, i] - sum((weight * corners[corner] for corner, weight in weights), SX(0))
        depths.append(ca.fmin(cosine * (hull.radius - z[i] + under[0, i]), STEEPNESS * (rise - RISE)))
        normals.append(cosine * ca.vertcat(-under[1:, i], 1))
    contacts = []
    for _, members in hull.regions:
        deepest = depths[members[0]]
        for i in members[1:]:
            deepest = ca.fmax(deepest, depths[i])
        unit = ca.fmax(deepest, LEAST_DEPTH)
        share = [ca.fmax(1 + (depths[i] - deepest) / unit, 0) for i in members]
        cubes = [x * x * x for x in share]
        root = len(members) ** 0.5
        fourth = sum((x * cube for x, cube in zip(share, cubes, strict=True)), SX(0)) / root
        scale = ca.sqrt(ca.sqrt(fourth))
        point = weighted([constant(np.array(hull.points[i])) for i in members], cubes) / sum(cubes, SX(0))
        push = weighted([normals[i] for i in members], cubes)
        length = ca.norm_2(push)
        depth = unit * length / (scale * scale * root)
        contacts.append((point - hull.radius * up, depth + ca.fmin(deepest - LEAST_DEPTH, 0), push / length))
    return contacts


def weighted(values: Sequence[SX], weights: Sequence[SX]) -> SX:
    """Return a weighted sum."""
    return sum((weight * value for value, weight in zip(values, weights, strict=True)), SX(*values[0].shape))
