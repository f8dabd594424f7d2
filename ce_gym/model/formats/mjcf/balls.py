"""Ball joints of a compiled MJCF file inside closed loops, which become three hinges each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.formats.mjcf.source import MjcfSource
from ce_gym.model.formats.placement import vec3
from ce_gym.model.frames import Vec3

Point = tuple[int, NDArray[np.float64]]
"""One of MuJoCo's bodies and a point in its frame [m]."""


def balls_in_loops(source: MjcfSource) -> dict[int, Vec3]:
    """Return the axis of spin of each ball joint inside a loop, in the frame of its body, by joint index.

    The axis leads to the point at which the equality holds the body; it is z if the equality holds a body further out.
    """
    model, axes = source.model, dict[int, Vec3]()
    for i in range(model.neq):
        if not model.eq_active0[i]:
            continue
        ends = _ends(source, i)
        chains = [_to_world(source, body) for body, _ in ends]
        shared = set(chains[0]).intersection(*chains[1:]) if len(ends) > 1 else {0}
        for body in {b for chain in chains for b in chain} - shared:
            first = model.body_jntadr[body]
            for j in range(first, first + model.body_jntnum[body]):
                if model.jnt_type[j] == source.mujoco.mjtJoint.mjJNT_BALL:
                    axes.setdefault(j, (0.0, 0.0, 1.0))
        for body, point in ends:
            j = model.body_jntadr[body] + model.body_jntnum[body] - 1
            reach = point - model.jnt_pos[j] if j in axes and model.body_jntnum[body] else np.zeros(3)
            if np.linalg.norm(reach) > 0.0:
                axes[j] = vec3(reach)
    return axes


def _to_world(source: MjcfSource, body: int) -> list[int]:
    """Return a body and its ancestors, the world, 0, last."""
    chain = [body]
    while chain[-1]:
        chain.append(int(source.model.body_parentid[chain[-1]]))
    return chain


def _ends(source: MjcfSource, i: int) -> list[Point]:
    """Return the bodies of equality `i`, with the points at which it holds them."""
    model, kinds, objects = source.model, source.mujoco.mjtEq, source.mujoco.mjtObj
    kind, ids = model.eq_type[i], [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
    if kind == kinds.mjEQ_CONNECT or kind == kinds.mjEQ_WELD:
        if model.eq_objtype[i] == objects.mjOBJ_SITE:
            return [(int(model.site_bodyid[site]), model.site_pos[site]) for site in ids]
        points = [model.eq_data[i][0:3], model.eq_data[i][3:6]]
        return list(zip(ids, points if kind == kinds.mjEQ_CONNECT else [np.zeros(3)] * 2, strict=True))
    joints, points = [], []
    if kind == kinds.mjEQ_JOINT:
        joints = [j for j in ids if j >= 0]
    elif kind == kinds.mjEQ_TENDON:
        for tendon in (t for t in ids if t >= 0):
            for w in range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon]):
                if model.wrap_type[w] == source.mujoco.mjtWrap.mjWRAP_JOINT:
                    joints.append(int(model.wrap_objid[w]))
                elif model.wrap_type[w] == source.mujoco.mjtWrap.mjWRAP_SITE:
                    site = int(model.wrap_objid[w])
                    points.append((int(model.site_bodyid[site]), model.site_pos[site]))
    parents = [(int(model.body_parentid[model.jnt_bodyid[j]]), np.zeros(3)) for j in joints]
    return parents + points
