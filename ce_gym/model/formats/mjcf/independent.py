"""Independent joints and redundant equalities of a compiled MJCF file.

Both follow from the numerical rank of the Jacobian of the equalities, at the reference pose and at nearby poses with
closed loops: a mechanism may be singular at one pose.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.constraints import Constraint
from ce_gym.model.formats.mjcf.bodies import MjcfTree
from ce_gym.model.formats.mjcf.equalities import actuated_joints, coupling_tendons, tendon_coefficients
from ce_gym.model.formats.mjcf.source import MjcfSource

Array = NDArray[np.float64]

RANK_TOLERANCE = 1e-5
"""Relative size of rows, columns and singular values of a constraint Jacobian that count as zero: files are rounded."""
VANISHING = 1e-9
"""Size of a row that counts as zero if all rows of its equality are as small."""
CLOSING_STEPS, LARGEST_STEP = 8, 0.1
"""Number of steps to close the loops of a pose, and the largest step of a joint [rad or m]."""
POSES, SPREAD = 4, 0.05
"""Number of poses around the reference pose, and their largest distance from it [rad or m]."""
OPEN = 1e-4
"""Largest residual of a closed pose [m or rad]."""


@dataclass(frozen=True)
class EqualityRows:
    """The Jacobian of the equalities at one pose.

    Attributes:
        columns: Jacobian by the scalar joints, rows of length 1 or 0, shape (n, n_joints).
        owner: Index of each row's equality, as in `read_constraints`, shape (n,).
        gap: Largest residual that remains [m or rad].
    """

    columns: Array
    owner: NDArray[np.int64]
    gap: float

    def of(self, owners: Collection[int]) -> Array:
        """Return the rows of some equalities."""
        return self.columns[np.isin(self.owner, list(owners))]


def equality_rows(source: MjcfSource, tree: MjcfTree) -> list[EqualityRows]:
    """Return the Jacobian at the reference pose, then at nearby poses whose loops close.

    Rounded poses are closed first: with a gap, equalities seem to move joints that they do not move.
    """
    model, rng = source.model, np.random.default_rng(0)
    start, fixed = source.data.qpos.copy(), model.jnt_type[model.dof_jntid] == source.mujoco.mjtJoint.mjJNT_FREE
    poses = [_closed_rows(source, tree, LARGEST_STEP)]
    for spread in rng.uniform(-SPREAD, SPREAD, (POSES if len(poses[0].owner) else 0, model.nv)):
        source.data.qpos[:] = start
        source.mujoco.mj_integratePos(model, source.data.qpos, np.where(fixed, 0.0, spread), 1.0)
        rows = _closed_rows(source, tree, LARGEST_STEP + 2 * SPREAD)
        poses += [rows] if rows.gap < OPEN else []
    source.data.qpos[:] = start
    source.forward()
    return poses


def _closed_rows(source: MjcfSource, tree: MjcfTree, largest_step: float) -> EqualityRows:
    """Close the loops from `source.data.qpos`, as long as steps are small, and return the Jacobian there."""
    rows, gap, owner = _raw_rows(source)
    for _ in range(CLOSING_STEPS):
        step = -np.linalg.lstsq(rows, gap, rcond=RANK_TOLERANCE)[0] if len(rows) else np.zeros(0)
        if not 0.0 < np.abs(step).max(initial=0.0) < largest_step:
            break
        source.mujoco.mj_integratePos(source.model, source.data.qpos, step, 1.0)
        rows, gap, owner = _raw_rows(source)
    lengths = np.linalg.norm(rows, axis=1)
    largest = np.array([lengths[owner == i].max() for i in owner])
    kept = (lengths > RANK_TOLERANCE * largest) & (largest > VANISHING)
    unit = np.divide(rows, lengths[:, None], out=np.zeros_like(rows), where=kept[:, None])
    columns = [unit[:, dofs] @ axis for _, _, (dofs, axis) in _scalar_joints(source, tree)]
    return EqualityRows(
        np.array(columns).reshape(len(columns), len(rows)).T, owner, float(np.abs(gap).max(initial=0.0))
    )


def _raw_rows(source: MjcfSource) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the Jacobian (n, nv) and the residuals (n,) of equalities and couplings, and which each row is of."""
    mujoco, model, data = source.mujoco, source.model, source.data
    sparse = model.opt.jacobian
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    source.forward()
    model.opt.jacobian = sparse
    chosen = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    rows, gaps = [data.efc_J.reshape(-1, model.nv)[: data.nefc][chosen]], [data.efc_pos[chosen]]
    owners = [np.array(data.efc_id[chosen], dtype=np.int64)]
    for tendon in coupling_tendons(source):
        coefficients = tendon_coefficients(source, tendon) or {}
        row = np.zeros(model.nv)
        row[[model.jnt_dofadr[j] for j in coefficients]] = list(coefficients.values())
        rows, owners = [*rows, row[None]], [*owners, np.array([model.neq + tendon])]
        gaps.append(data.ten_length[[tendon]] - model.tendon_range[tendon].mean())
    return np.vstack(rows), np.concatenate(gaps), np.concatenate(owners)


def _scalar_joints(source: MjcfSource, tree: MjcfTree) -> list[tuple[int, str, tuple[slice, Array]]]:
    """Return joint index, body and column of MuJoCo's velocities of each joint with one coordinate.

    The column is a slice of rows and the entries in these rows, at the reference pose.
    """
    model, kinds, joints = source.model, source.mujoco.mjtJoint, []
    for j in sorted({*tree.moved_by, *tree.hinged}):
        first = int(model.jnt_dofadr[j])
        if j in tree.hinged:
            joints += [(j, b.name, (slice(first, first + 3), np.array(b.joint.axis))) for b in tree.hinged[j]]
        elif model.jnt_type[j] != kinds.mjJNT_FREE and model.jnt_type[j] != kinds.mjJNT_BALL:
            joints.append((j, tree.moved_by[j], (slice(first, first + 1), np.ones(1))))
    return joints


def without_repeats(
    source: MjcfSource, constraints: Mapping[int, Sequence[Constraint]], poses: Sequence[EqualityRows]
) -> tuple[Constraint, ...]:
    """Return the constraints without redundant ones; linear constraints are kept first.

    Partly redundant equalities are kept, with a note: the assembly of closed loops drops redundant rows.
    """
    order = sorted(constraints, key=lambda i: not all(tie.linear for tie in constraints[i]))
    repeated: list[int] = []
    for place, i in enumerate(order):
        kept = [other for other in order[:place] if other not in repeated]
        ranks = [(_rank(p.of({i})), _rank(p.of(kept)), *_rank_and_rest(p.of({*kept, i}))) for p in poses]
        alone, new = max(rank for rank, *_ in ranks), max(total - known for _, known, total, _ in ranks)
        if new >= alone:
            continue
        names = " and ".join(body or "the world" for body in _ends(constraints[i]))
        share = "nothing" if not new else f"only {new} of {alone} constraints"
        rest = max(value for *_, value in ranks)
        source.notes.append(
            f"constraint {constraints[i][0].name!r} of {names} adds {share} to the others that tie these bodies: "
            f"it repeats them to {rest:.0e}, and the repetition is left out"
        )
        if not new:
            repeated.append(i)
    return tuple(tie for i, ties in constraints.items() if i not in repeated for tie in ties)


def _ends(ties: Sequence[Constraint]) -> tuple[str | None, ...]:
    return ties[0].ends or ties[0].bodies


def _rank(rows: Array) -> int:
    return _rank_and_rest(rows)[0]


def _rank_and_rest(rows: Array) -> tuple[int, float]:
    """Return the rank of rows, and the largest singular value that counts as zero relative to the largest."""
    values = np.linalg.svd(rows, compute_uv=False) if rows.size else np.zeros(0)
    relative = values / values.max(initial=VANISHING)
    rank = int((relative > RANK_TOLERANCE).sum())
    return rank, float(relative[rank:].max(initial=0.0))


def choose_independent(
    source: MjcfSource, tree: MjcfTree, rotors: Collection[str], poses: Sequence[EqualityRows]
) -> tuple[str, ...]:
    """Return the bodies whose joints are independent, in MuJoCo's order.

    Elimination in the Jacobian of all equalities, at the pose with the largest rank, finds the dependent joints. It
    prefers, in this order: joints without actuator, joints moved only by a tendon's actuator, other joints. Within
    each group it prefers `rotors`, then the first joint of a joint equality (MuJoCo's own dependent joint), then hinges
    that were a ball joint, then joints without a spring.

    Args:
        source: The compiled file.
        tree: The bodies of the file.
        rotors: Bodies that should be dependent if possible.
        poses: Jacobians from `equality_rows`.
    """
    model, kinds = source.model, source.mujoco.mjtEq
    moved = [actuated_joints(source, a) for a in range(model.nu)]
    driven = {j: min(1 / len(joints) for joints in moved if j in joints) for joints in moved for j in joints}
    tied = [i for i in range(model.neq) if model.eq_active0[i] and model.eq_type[i] == kinds.mjEQ_JOINT]
    named = {int(model.eq_obj1id[i]) for i in tied}
    joints = _scalar_joints(source, tree)
    order = [
        (driven.get(j, 0.0), body not in rotors, j not in named, j not in tree.hinged, model.jnt_stiffness[j] > 0.0)
        for j, body, _ in joints
    ]
    dependent = max((_dependent(rows.columns, order) for rows in poses), key=len)
    return tuple(body for i, (_, body, _) in enumerate(joints) if i not in dependent)


def _dependent(columns: Array, order: Sequence[tuple[object, ...]]) -> set[int]:
    """Return the columns that elimination chooses, in ascending order of preference keys."""
    dependent: set[int] = set()
    for group in sorted(set(order)):  # type: ignore[type-var]
        while (pivot := _largest(columns, [i for i, key in enumerate(order) if key == group])) is not None:
            dependent.add(pivot)
            unit = columns[:, pivot] / np.linalg.norm(columns[:, pivot])
            columns = columns - np.outer(unit, unit @ columns)
            columns[:, pivot] = 0.0
    return dependent


def _largest(columns: Array, among: list[int]) -> int | None:
    """Return the index of the longest column in `among`; None if all are zero."""
    lengths = np.linalg.norm(columns[:, among], axis=0)
    return among[int(np.argmax(lengths))] if lengths.size and lengths.max() > RANK_TOLERANCE else None
