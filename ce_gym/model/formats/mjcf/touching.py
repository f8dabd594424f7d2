"""Which geoms of a compiled MJCF file MuJoCo lets touch, and the friction between them.

MuJoCo decides pair by pair: a `<pair>` of the two geoms has figures of its own; otherwise the geom of higher `priority`
decides alone, and of equal ones the larger friction and `condim` count.
Source: https://mujoco.readthedocs.io/en/stable/modeling.html#contact-parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ce_gym.model.formats.mjcf.source import MjcfSource

SMALLEST_FRICTION = 1e-5
"""MuJoCo's lower limit of the friction of a contact that is not frictionless [-]."""
DEFAULT_DIMENSION = 3
"""MuJoCo's default `condim`, assumed for the ground that a file does not have."""

_DEFAULT_SOLVER = (0.02, 1.0, 0.9, 0.95, 0.001, 0.5, 2.0)  # MuJoCo's solref and solimp


@dataclass(frozen=True)
class Touch:
    """MuJoCo's contact of two geoms.

    Attributes:
        friction: Sliding friction [-], the larger one of a `<pair>` with two; 0 if the contact is frictionless.
        other: Properties of the contact without a counterpart in `ContactMaterial`.
    """

    friction: float
    other: tuple[str, ...]


def solid(source: MjcfSource, geom: int) -> bool:
    """Whether a geom touches anything at all."""
    return bool(source.model.geom_contype[geom] or source.model.geom_conaffinity[geom])


def can_touch(source: MjcfSource, a: int, b: int) -> bool:
    """Whether MuJoCo lets two geoms of different bodies touch: by a <pair>, or by masks without an <exclude>."""
    model = source.model
    if _pair(source, a, b) is not None:
        return True
    low, high = sorted((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
    if np.any(model.exclude_signature == (low << 16) + high):
        return False
    types, affinities = model.geom_contype, model.geom_conaffinity
    return bool(types[a] & affinities[b] or types[b] & affinities[a])


def touched(source: MjcfSource, geom: int, ground: list[int]) -> list[int]:
    """Return the fixed geoms that a geom can touch; only planes z = 0 if there are any."""
    touchable = [g for g in ground if can_touch(source, geom, g)]
    return [g for g in touchable if is_ground(source, g)] or touchable


def is_ground(source: MjcfSource, geom: int) -> bool:
    """Whether a geom is the plane z = 0, seen from above."""
    normal, height = source.data.geom_xmat[geom].reshape(3, 3)[:, 2], source.data.geom_xpos[geom][2]
    flat = np.allclose(normal, (0, 0, 1)) and abs(height) < 1e-9
    return bool(source.model.geom_type[geom] == source.mujoco.mjtGeom.mjGEOM_PLANE and flat)


def touch_of(source: MjcfSource, a: int, b: int | None) -> Touch:
    """Return MuJoCo's contact of two geoms; with the geom's own parameters alone in a file without ground."""
    model, pair = source.model, None if b is None else _pair(source, a, b)
    slip_solver: tuple[float, ...] = ()
    if pair is not None:
        friction = [float(x) for x in model.pair_friction[pair]]
        dimension = int(model.pair_dim[pair])
        solver = (*model.pair_solref[pair], *model.pair_solimp[pair])
        slip_solver = tuple(model.pair_solreffriction[pair])
        margins = [float(model.pair_margin[pair]), float(model.pair_gap[pair])]
    else:
        geoms = [a] if b is None else [a, b]
        highest = max(int(model.geom_priority[g]) for g in geoms)
        deciding = [g for g in geoms if model.geom_priority[g] == highest]
        dimension = max([DEFAULT_DIMENSION] * (b is None) + [int(model.geom_condim[g]) for g in deciding])
        friction = [max(float(model.geom_friction[g][0]) for g in deciding)] * 2
        solvers = [(*model.geom_solref[g], *model.geom_solimp[g]) for g in deciding]
        solver = next((solver_pair for solver_pair in solvers if not is_default_solver(solver_pair)), _DEFAULT_SOLVER)
        margins = [float(x) for g in geoms for x in (model.geom_margin[g], model.geom_gap[g])]
    if model.opt.enableflags & int(source.mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        friction = [float(x) for x in model.opt.o_friction]
        solver, margins = (*model.opt.o_solref, *model.opt.o_solimp), [float(model.opt.o_margin)]
    other = ["torsional and rolling friction"] if dimension > 3 else []
    if not is_default_solver(solver) or any(slip_solver):
        other.append("the compliance of contacts (solref, solimp)")
    if any(margins):
        other.append("margin and gap of contacts")
    if dimension > 1 and friction[0] != friction[1]:
        other.append("the smaller one of two sliding frictions of a <pair>")
    sliding = max(SMALLEST_FRICTION, *friction[:2]) if dimension > 1 else 0.0
    return Touch(sliding, tuple(other))


def is_default_solver(solver: tuple[float, ...]) -> bool:
    """Whether solref and solimp, one after the other, are MuJoCo's default."""
    return np.allclose(solver, _DEFAULT_SOLVER)


def _pair(source: MjcfSource, a: int, b: int) -> int | None:
    """Return the number of the <pair> of two geoms, in either order; None if the file has none."""
    model = source.model
    pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
    return next((i for i, (first, second) in enumerate(pairs) if {int(first), int(second)} == {a, b}), None)
