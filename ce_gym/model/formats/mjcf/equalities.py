"""The equalities of a compiled MJCF file -> constraints, and the choice of independent joints.

| equality                        | becomes                                                                |
|---------------------------------|------------------------------------------------------------------------|
| joint, and joint to a constant  | a linear constraint; a weld                                            |
| fixed tendons                   | a linear constraint                                                    |
| spatial tendon of two sites     | a rod                                                                  |
| connect                         | a ball joint                                                           |
| weld                            | two revolute joints with crossed axes: together they leave no freedom  |

MuJoCo holds them softly; here they are exact.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.constraints import Constraint, LinearConstraint, LoopConstraint, RodConstraint
from ce_gym.model.formats.mjcf.bodies import MjcfTree
from ce_gym.model.formats.mjcf.source import MjcfSource, placement
from ce_gym.model.formats.placement import compose, transform_point, vec3
from ce_gym.model.frames import Placement, Vec3, added

RANK_TOLERANCE = 1e-8
"""Relative size of a row or column of a constraint Jacobian that counts as zero."""

CLOSING_STEPS, LARGEST_STEP = 8, 0.1
"""How often a reference pose is moved to close its loops, and how far joints may be from there [rad or m]."""

WELD_AXES: tuple[Vec3, Vec3] = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))

Form = tuple[dict[int, float], float]  # coefficients of joint coordinates by joint index, and a constant [rad or m]


def locked_joints(source: MjcfSource) -> dict[int, float]:
    """Return the coordinates [rad or m] of joints that an equality holds at a constant, by joint index."""
    model = source.model
    return {
        int(model.eq_obj1id[i]): float(model.eq_data[i][0] + model.qpos0[model.jnt_qposadr[model.eq_obj1id[i]]])
        for i in _active(source)
        if model.eq_type[i] == source.mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[i] < 0
    }


def read_constraints(source: MjcfSource, tree: MjcfTree, locked: dict[int, float]) -> tuple[Constraint, ...]:
    """Return the constraints; what cannot be one is left out.

    An equality that has been left out is switched off in `source.data`, so that its Jacobian is that of the rest.
    """
    found: list[Constraint] = []
    for i in range(source.model.neq):
        name = source.name("equality", i)
        if not source.model.eq_active0[i]:
            source.leave_out("equality {}, which is not active", name)
            continue
        if source.model.eq_type[i] == source.mujoco.mjtEq.mjEQ_JOINT and source.model.eq_obj2id[i] < 0:
            continue  # a weld in the tree
        constraints = list(_constraint(source, tree, i, locked))
        if not constraints:
            source.leave_out("equality {}", name)
            source.data.eq_active[i] = 0
        found += constraints
    return tuple(found)


def choose_independent(source: MjcfSource, tree: MjcfTree, rotors: Collection[str]) -> tuple[str, ...]:
    """Return the bodies whose joints are independent, in MuJoCo's order.

    The dependent joints are found by elimination in the Jacobian of all equalities at the reference pose, as many as it
    has rank: those of `rotors` before others, then what a joint equality names first (MuJoCo's own dependent joint),
    then hinges that were a ball joint, then joints without a spring, and of either those without an actuator first.

    Args:
        source: The compiled file.
        tree: Its bodies.
        rotors: Bodies that would best be dependent.
    """
    model, kinds = source.model, source.mujoco.mjtEq
    driven = {int(model.actuator_trnid[a][0]) for a in range(model.nu) if drives_joint(source, a)}
    named = {int(model.eq_obj1id[i]) for i in _active(source) if model.eq_type[i] == kinds.mjEQ_JOINT}
    jacobian, joints = _equality_jacobian(source), _scalar_joints(source, tree)
    order = [
        (body not in rotors, j not in named, j not in tree.hinged, model.jnt_stiffness[j] > 0.0, j in driven)
        for j, body, _ in joints
    ]
    moved = [jacobian[:, dofs] @ axis for _, _, (dofs, axis) in joints]
    columns = np.array(moved).reshape(len(joints), len(jacobian)).T
    dependent: set[int] = set()
    for group in sorted(set(order)):
        while (pivot := _largest(columns, [i for i, key in enumerate(order) if key == group])) is not None:
            dependent.add(pivot)
            unit = columns[:, pivot] / np.linalg.norm(columns[:, pivot])
            columns = columns - np.outer(unit, unit @ columns)
            columns[:, pivot] = 0.0
    return tuple(body for i, (_, body, _) in enumerate(joints) if i not in dependent)


def _scalar_joints(source: MjcfSource, tree: MjcfTree) -> list[tuple[int, str, tuple[slice, NDArray[np.float64]]]]:
    """Return joint index and body of each joint with one coordinate, and how MuJoCo's velocities follow from its own.

    The last is the rows of its joint and the entries there, at the reference pose.
    """
    model, kinds, found = source.model, source.mujoco.mjtJoint, []
    for j in sorted({*tree.moved_by, *tree.hinged}):
        first = int(model.jnt_dofadr[j])
        if j in tree.hinged:
            found += [(j, b.name, (slice(first, first + 3), np.array(b.joint.axis))) for b in tree.hinged[j]]
        elif model.jnt_type[j] != kinds.mjJNT_FREE and model.jnt_type[j] != kinds.mjJNT_BALL:
            found.append((j, tree.moved_by[j], (slice(first, first + 1), np.ones(1))))
    return found


def _largest(columns: NDArray[np.float64], among: list[int]) -> int | None:
    """Return the index of the longest of some columns; None if all of them are zero."""
    lengths = np.linalg.norm(columns[:, among], axis=0)
    return among[int(np.argmax(lengths))] if lengths.size and lengths.max() > RANK_TOLERANCE else None


def _equality_jacobian(source: MjcfSource) -> NDArray[np.float64]:
    """Return the Jacobian of the active equalities at the reference pose, rows of length 1, shape (n, nv).

    A pose that was rounded is closed first: a gap makes joints that equalities do not move look as if they did.
    """
    start = source.data.qpos.copy()
    rows, gap = _equality_rows(source)
    for _ in range(CLOSING_STEPS):
        step = -np.linalg.lstsq(rows, gap, rcond=1e-6)[0] if len(rows) else np.zeros(0)
        if not 0.0 < np.abs(step).max(initial=0.0) < LARGEST_STEP:
            break
        source.mujoco.mj_integratePos(source.model, source.data.qpos, step, 1.0)
        rows, gap = _equality_rows(source)
    source.data.qpos[:] = start
    source.forward()
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.divide(rows, lengths, out=np.zeros_like(rows), where=lengths > RANK_TOLERANCE)


def _equality_rows(source: MjcfSource) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Jacobian (n, nv) and the residuals (n,) of the active equalities at `source.data.qpos`."""
    mujoco, model, data = source.mujoco, source.model, source.data
    sparse = model.opt.jacobian
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    source.forward()
    model.opt.jacobian = sparse
    chosen = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    return data.efc_J.reshape(-1, model.nv)[: data.nefc][chosen], data.efc_pos[chosen].copy()


def drives_joint(source: MjcfSource, actuator: int) -> bool:
    """Whether an actuator acts on a joint."""
    kinds = source.mujoco.mjtTrn
    return int(source.model.actuator_trntype[actuator]) in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))


def _active(source: MjcfSource) -> list[int]:
    return [i for i in range(source.model.neq) if source.model.eq_active0[i]]


def _constraint(source: MjcfSource, tree: MjcfTree, i: int, locked: dict[int, float]) -> Iterator[Constraint]:
    """Iterate over the constraints that equality `i` becomes: none if it cannot be represented."""
    model, kinds = source.model, source.mujoco.mjtEq
    kind, name = model.eq_type[i], source.name("equality", i)
    if kind == kinds.mjEQ_JOINT:
        first, second = (_joint_form(source, int(j)) for j in (model.eq_obj1id[i], model.eq_obj2id[i]))
        yield from _linear(source, tree, i, first, second, locked)
    elif kind == kinds.mjEQ_TENDON:
        yield from _tendon(source, tree, i, locked)
    elif kind == kinds.mjEQ_CONNECT:
        (first, at_first), (second, at_second) = _ends(source, tree, i)
        if first != second:
            yield LoopConstraint(name, "ball", first, second, at_first, at_second)
    elif kind == kinds.mjEQ_WELD:
        (first, at_first), (second, at_second) = _ends(source, tree, i)
        if first != second and model.eq_data[i][10] > 0.0:  # its scale of torques; 0 leaves rotation free
            for axis in WELD_AXES:
                label = f"{name} about {'xyz'[axis.index(1.0)]}"
                yield LoopConstraint(label, "revolute", first, second, at_first, at_second, axis)


def _joint_form(source: MjcfSource, joint: int) -> Form:
    """A joint's coordinate less its `ref`, which is what MuJoCo's polynomial is about."""
    return {joint: 1.0}, -float(source.model.qpos0[source.model.jnt_qposadr[joint]])


def tendon_coefficients(source: MjcfSource, tendon: int) -> dict[int, float] | None:
    """Return the coefficients of a fixed tendon by joint index; None if the tendon is spatial."""
    model, kinds = source.model, source.mujoco.mjtWrap
    wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if any(model.wrap_type[w] != kinds.mjWRAP_JOINT for w in wraps):
        return None
    coefficients: dict[int, float] = {}
    for w in wraps:
        joint = int(model.wrap_objid[w])
        coefficients[joint] = coefficients.get(joint, 0.0) + float(model.wrap_prm[w])
    return coefficients


def _tendon_form(source: MjcfSource, tendon: int) -> Form | None:
    """A fixed tendon's length less its length at `ref`; None if the tendon is spatial."""
    if tendon < 0:
        return {}, 0.0
    coefficients = tendon_coefficients(source, tendon)
    return None if coefficients is None else (coefficients, -float(source.model.tendon_length0[tendon]))


def _tendon(source: MjcfSource, tree: MjcfTree, i: int, locked: dict[int, float]) -> Iterator[Constraint]:
    model, kinds = source.model, source.mujoco.mjtWrap
    tendon, other = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
    first, second = _tendon_form(source, tendon), _tendon_form(source, other)
    if first is not None and second is not None:
        yield from _linear(source, tree, i, first, second, locked)
        return
    wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if other >= 0 or [int(model.wrap_type[w]) for w in wraps] != [int(kinds.mjWRAP_SITE)] * 2:
        return
    ends = [_site(source, tree, int(model.wrap_objid[w])) for w in wraps]
    (a, at_a), (b, at_b) = ((body, frame.position) for body, frame in ends)
    if a != b:
        length = float(model.tendon_length0[tendon] + model.eq_data[i][0])
        yield RodConstraint(source.name("equality", i), a, b, at_a, at_b, length)


def _linear(
    source: MjcfSource, tree: MjcfTree, i: int, first: Form, second: Form, locked: dict[int, float]
) -> Iterator[LinearConstraint]:
    """Iterate over `first = constant + ratio * second`, the linear part of MuJoCo's polynomial."""
    constant, ratio, *higher = (float(x) for x in source.model.eq_data[i][:5])
    name = source.name("equality", i)
    if second[0] and any(higher):
        source.leave_out("the polynomial of equality {} beyond its linear part", name)
    coefficients = dict(first[0])
    for joint, value in second[0].items():
        coefficients[joint] = coefficients.get(joint, 0.0) - ratio * value
    offset = constant + ratio * second[1] - first[1]
    offset -= added(value * locked[joint] for joint, value in coefficients.items() if joint in locked)
    pairs = tuple((tree.moved_by[j], x) for j, x in coefficients.items() if j not in locked and x != 0.0)
    if len(pairs) > 1:
        yield LinearConstraint(name, pairs, offset)


def _ends(source: MjcfSource, tree: MjcfTree, i: int) -> list[tuple[str | None, Placement]]:
    """Return the bodies that a connect or weld holds together, and the frame in each that it makes coincide."""
    model = source.model
    ids = (int(model.eq_obj1id[i]), int(model.eq_obj2id[i]))
    if model.eq_objtype[i] == source.mujoco.mjtObj.mjOBJ_SITE:
        return [_site(source, tree, site) for site in ids]
    data = np.array(model.eq_data[i])
    (first, frame_1), (second, frame_2) = (tree.frames[body] for body in ids)
    if model.eq_type[i] == source.mujoco.mjtEq.mjEQ_CONNECT:
        points = [transform_point(frame, vec3(x)) for frame, x in ((frame_1, data[0:3]), (frame_2, data[3:6]))]
        return [(first, Placement(points[0])), (second, Placement(points[1]))]
    return [(first, compose(frame_1, placement(data[3:6], data[6:10]))), (second, frame_2)]


def _site(source: MjcfSource, tree: MjcfTree, site: int) -> tuple[str | None, Placement]:
    model = source.model
    body, frame = tree.frames[model.site_bodyid[site]]
    return body, compose(frame, placement(model.site_pos[site], model.site_quat[site]))
