"""The equalities of a compiled MJCF file -> constraints.

| in the file                                | becomes                                                                |
|--------------------------------------------|------------------------------------------------------------------------|
| joint to a constant                        | a weld in the tree                                                     |
| joint, with `polycoef` up to the first power | a linear constraint                                                  |
| joint, with higher powers                  | a polynomial constraint                                                |
| fixed tendons                              | a linear constraint                                                    |
| spatial tendon of two sites                | a rod                                                                  |
| connect                                    | a ball joint                                                           |
| weld                                       | two revolute joints with crossed axes: together they leave no freedom  |
| weld with `torquescale` 0                  | a ball joint                                                           |
| fixed tendon with a narrow `range`         | a linear constraint at the middle of the range                         |

Equalities are soft in MuJoCo and exact here. `independent.py` finds redundant equalities.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.polynomial import Polynomial

from ce_gym.model.constraints import Constraint, LinearConstraint, LoopConstraint, PolynomialConstraint, RodConstraint
from ce_gym.model.formats.mjcf.bodies import MjcfTree
from ce_gym.model.formats.mjcf.source import MjcfSource, placement
from ce_gym.model.formats.placement import compose, transform_point, vec3
from ce_gym.model.frames import Placement, Vec3, added

WELD_AXES: tuple[Vec3, Vec3] = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))

NARROW = 0.01
"""Width of the range of a tendon that couples its joints, as a share of its travel over the ranges of the joints."""
UNLIMITED_TRAVEL = 2 * np.pi
"""Assumed travel of a joint without limits [rad or m]."""

Form = tuple[dict[int, float], float]  # coefficients of joint coordinates by joint index, and a constant [rad or m]


def locked_joints(source: MjcfSource) -> dict[int, float]:
    """Return the coordinates [rad or m] of joints that equalities fix, by joint index.

    An equality of joints or fixed tendons fixes its last joint if all other joints are fixed.
    """
    locked: dict[int, float] = {}
    active = [i for i in range(source.model.neq) if source.model.eq_active0[i]]
    while True:
        lines = [line for i in active if (line := _linear(source, i, locked)) is not None and len(line[0]) == 1]
        if not lines:
            return locked
        ((joint, coefficient),) = lines[0][0].items()
        locked[joint] = lines[0][1] / coefficient


def read_constraints(source: MjcfSource, tree: MjcfTree, locked: Mapping[int, float]) -> dict[int, list[Constraint]]:
    """Return the constraints of each equality, by its index; equalities without counterpart are left out.

    Ignored equalities are switched off in `source.data`, which removes their rows from its Jacobian. Couplings by
    tendons come last, with indices from the number of equalities on.
    """
    constraints_of: dict[int, list[Constraint]] = {}
    names = [source.given_name("equality", i) for i in range(source.model.neq)]
    tree.ties.update(name for name in names if name)
    for i in range(source.model.neq):
        if not source.model.eq_active0[i]:
            source.leave_out("equality {}, which is not active", names[i] or f"number {i + 1}")
            continue
        line = _linear(source, i, locked)
        if line is not None and not line[0]:
            continue  # its joints are welds in the tree
        name = names[i] or tree.fresh_tie(_name_by_ends(source, tree, i))
        if constraints := list(_constraint(source, tree, i, name, line)):
            constraints_of[i] = constraints
        else:
            source.leave_out(_reason(source, i), name)
            source.data.eq_active[i] = 0
    for tendon in coupling_tendons(source):
        name = tree.fresh_tie(source.name("tendon", tendon))
        low, high = source.model.tendon_range[tendon]
        coefficients, offset = _unlocked(tendon_coefficients(source, tendon) or {}, (low + high) / 2, locked)
        if len(coefficients) > 1:
            pairs = tuple((tree.moved_by[j], x) for j, x in coefficients.items())
            constraints_of[source.model.neq + tendon] = [LinearConstraint(name, pairs, offset)]
            source.leave_out("the play of tendon {}", f"{name} (range {low:g} to {high:g}, held at its middle)")
    return constraints_of


def coupling_tendons(source: MjcfSource) -> list[int]:
    """Return the fixed tendons with ranges so narrow that they couple their joints."""
    model = source.model
    return [t for t in range(model.ntendon) if model.tendon_limited[t] and _is_narrow(source, t)]


def _is_narrow(source: MjcfSource, tendon: int) -> bool:
    model, coefficients = source.model, tendon_coefficients(source, tendon)
    low, high = model.tendon_range[tendon]
    if coefficients is None or sum(1 for x in coefficients.values() if x) < 2:
        return False
    travels = [np.ptp(model.jnt_range[j]) if model.jnt_limited[j] else UNLIMITED_TRAVEL for j in coefficients]
    return high - low <= NARROW * added(abs(x) * t for x, t in zip(coefficients.values(), travels, strict=True))


def actuated_joints(source: MjcfSource, actuator: int) -> dict[int, float]:
    """Return the travel of an actuator per unit of each joint, by joint index; empty for other transmissions."""
    model, kinds = source.model, source.mujoco.mjtTrn
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator][0])
    if kind in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
        return {target: 1.0}
    if kind == int(kinds.mjTRN_TENDON):
        return tendon_coefficients(source, target) or {}
    return {}


def _name_by_ends(source: MjcfSource, tree: MjcfTree, i: int) -> str:
    """Return a name for an equality without name: the names of its bodies or tendons."""
    model, kinds, objects = source.model, source.mujoco.mjtEq, source.mujoco.mjtObj
    ids, kind = (int(model.eq_obj1id[i]), int(model.eq_obj2id[i])), model.eq_type[i]
    if kind == kinds.mjEQ_JOINT:
        names = [tree.moved_by.get(j) or source.name("joint", j) for j in ids if j >= 0]
    elif kind == kinds.mjEQ_TENDON:
        names = [source.name("tendon", t) for t in ids if t >= 0]
    elif _holds_bodies(source, i):
        sites = model.eq_objtype[i] == objects.mjOBJ_SITE
        names = [source.name("body", model.site_bodyid[x] if sites else x) for x in ids]
    else:
        return source.name("equality", i)
    return "_to_".join(names)


def _holds_bodies(source: MjcfSource, i: int) -> bool:
    kinds, kind = source.mujoco.mjtEq, int(source.model.eq_type[i])
    return kind in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD))


def _reason(source: MjcfSource, i: int) -> str:
    """Return the note on an ignored equality; `{}` stands for its name."""
    if _holds_bodies(source, i):
        return "equality {} (both of its ends move together)"
    if _forms(source, i) is not None:
        return "equality {} (polycoef has powers above the first, and ties tendons or a joint that is held)"
    return "equality {}"


def _constraint(source: MjcfSource, tree: MjcfTree, i: int, name: str, line: Form | None) -> Iterator[Constraint]:
    """Iterate over the constraints of equality `i`: none if it has no counterpart.

    Args:
        source: The compiled file.
        tree: The bodies of the file.
        i: Index of the equality.
        name: Name of the equality.
        line: The equality as a linear equation of joints; None if it is not linear.
    """
    model, kinds = source.model, source.mujoco.mjtEq
    kind = model.eq_type[i]
    if line is not None:
        yield LinearConstraint(name, tuple((tree.moved_by[j], x) for j, x in line[0].items()), line[1])
    elif kind == kinds.mjEQ_JOINT:
        if {int(model.eq_obj1id[i]), int(model.eq_obj2id[i])} <= tree.moved_by.keys():
            yield _polynomial(source, tree, i, name)
    elif kind == kinds.mjEQ_TENDON:
        yield from _rod(source, tree, i, name)
    elif _holds_bodies(source, i):
        (first, at_first), (second, at_second) = _ends(source, tree, i)
        if first == second:
            return
        if kind == kinds.mjEQ_CONNECT or model.eq_data[i][10] == 0.0:  # a weld's scale of torques
            yield LoopConstraint(name, "ball", first, second, at_first, at_second)
            return
        for axis in WELD_AXES:
            label = tree.fresh_tie(f"{name} about {'xyz'[axis.index(1.0)]}")
            yield LoopConstraint(label, "revolute", first, second, at_first, at_second, axis)


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


def _forms(source: MjcfSource, i: int) -> tuple[Form, Form] | None:
    """Return the two sides of an equality of joints or fixed tendons, each less its value at `ref`; None for others.

    MuJoCo's polynomial is a function of these differences.
    """
    model, kinds = source.model, source.mujoco.mjtEq
    ids = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
    if model.eq_type[i] == kinds.mjEQ_JOINT:
        first, second = (({j: 1.0}, -float(model.qpos0[model.jnt_qposadr[j]])) if j >= 0 else ({}, 0.0) for j in ids)
        return first, second
    if model.eq_type[i] == kinds.mjEQ_TENDON:
        coefficients = [tendon_coefficients(source, t) if t >= 0 else {} for t in ids]
        if coefficients[0] is not None and coefficients[1] is not None:
            lengths = [-float(model.tendon_length0[t]) if t >= 0 else 0.0 for t in ids]
            return (coefficients[0], lengths[0]), (coefficients[1], lengths[1])
    return None


def _linear(source: MjcfSource, i: int, locked: Mapping[int, float]) -> Form | None:
    """Return the coefficients of joints that are not locked, and the right-hand side; None if it is not linear."""
    forms = _forms(source, i)
    if forms is None:
        return None
    (first, first_constant), (second, second_constant) = forms
    constant, ratio, *higher = (float(x) for x in source.model.eq_data[i][:5])
    if any(higher) and second:
        if not second.keys() <= locked.keys():
            return None
        at = added(x * locked[j] for j, x in second.items()) + second_constant
        constant, ratio, second = float(Polynomial((constant, ratio, *higher))(at)), 0.0, {}
    coefficients = dict(first)
    for joint, value in second.items():
        coefficients[joint] = coefficients.get(joint, 0.0) - ratio * value
    return _unlocked(coefficients, constant + ratio * second_constant - first_constant, locked)


def _polynomial(source: MjcfSource, tree: MjcfTree, i: int, name: str) -> PolynomialConstraint:
    """Return `first = polynomial of second`, of joints, counted from zero instead of their `ref`."""
    model = source.model
    dependent, argument = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
    start, at = (float(model.qpos0[model.jnt_qposadr[j]]) for j in (dependent, argument))
    shifted = Polynomial(model.eq_data[i][:5])(Polynomial((-at, 1.0))) + start
    return PolynomialConstraint(
        name, tree.moved_by[dependent], tree.moved_by[argument], tuple(map(float, shifted.coef))
    )


def _unlocked(coefficients: dict[int, float], offset: float, locked: Mapping[int, float]) -> Form:
    """Return a linear form without locked joints and zero coefficients, and its right-hand side."""
    offset -= added(value * locked[joint] for joint, value in coefficients.items() if joint in locked)
    return {joint: x for joint, x in coefficients.items() if joint not in locked and x != 0.0}, offset


def _rod(source: MjcfSource, tree: MjcfTree, i: int, name: str) -> Iterator[RodConstraint]:
    model, kinds = source.model, source.mujoco.mjtWrap
    tendon = int(model.eq_obj1id[i])
    wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if int(model.eq_obj2id[i]) >= 0 or [int(model.wrap_type[w]) for w in wraps] != [int(kinds.mjWRAP_SITE)] * 2:
        return
    ends = [_site(source, tree, int(model.wrap_objid[w])) for w in wraps]
    (a, at_a), (b, at_b) = ((body, frame.position) for body, frame in ends)
    if a != b:
        yield RodConstraint(name, a, b, at_a, at_b, float(model.tendon_length0[tendon] + model.eq_data[i][0]))


def _ends(source: MjcfSource, tree: MjcfTree, i: int) -> list[tuple[str | None, Placement]]:
    """Return the two bodies of a connect or weld, each with the frame that coincides with the other."""
    model = source.model
    ids = (int(model.eq_obj1id[i]), int(model.eq_obj2id[i]))
    if model.eq_objtype[i] == source.mujoco.mjtObj.mjOBJ_SITE:
        return [_site(source, tree, site) for site in ids]
    data = np.array(model.eq_data[i])
    (first, frame_1), (second, frame_2) = (tree.frames[body] for body in ids)
    if model.eq_type[i] == source.mujoco.mjtEq.mjEQ_CONNECT:
        points = [transform_point(frame, vec3(x)) for frame, x in ((frame_1, data[0:3]), (frame_2, data[3:6]))]
        return [(first, Placement(points[0])), (second, Placement(points[1]))]
    anchored = compose(frame_2, Placement(vec3(data[0:3])))
    return [(first, compose(frame_1, placement(data[3:6], data[6:10]))), (second, anchored)]


def _site(source: MjcfSource, tree: MjcfTree, site: int) -> tuple[str | None, Placement]:
    model = source.model
    body, frame = tree.frames[model.site_bodyid[site]]
    return body, compose(frame, placement(model.site_pos[site], model.site_quat[site]))
