"""Rewritings of a trace before compilation: each is checked by its operations and by its values."""

from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np
import pytest

from ce_gym.compile import Buffer, Call, Program, aligned_zeros, load_kernel
from ce_gym.compile.lowering import partial_evaluation
from ce_gym.compile.lowering.function import split_function, variants_of
from ce_gym.compile.lowering.graph import (
    FMA,
    FMS,
    FNMA,
    NO_OPERATION,
    REMOVED,
    SELECT,
    graph_of,
)
from ce_gym.compile.program import check_program
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.trace import iteration_function

X, Y, Z = (ca.SX.sym(name) for name in "xyz")


def rewritten(*values):
    """Return a function of x, y and z, and its operations after rewriting, sorted."""
    function = ca.Function("f", [X, Y, Z], [ca.vertcat(*values)])
    return function, sorted(op for op in graph_of(function).ops if op not in NO_OPERATION)


def check(function, evaluate, tolerance=1e-15):
    """Compare with CasADi's own evaluation."""
    rows = np.random.default_rng(0).uniform(-2, 2, (3, 17, 1))
    (value,) = evaluate(function, *rows)
    exact = [np.array(function(*row)).ravel() for row in rows.transpose(1, 0, 2)]
    np.testing.assert_allclose(value, exact, rtol=tolerance, atol=tolerance)


def test_operands_are_the_instructions_that_made_them():
    function = ca.Function("f", [X, Y], [ca.sin(X) * (Y + 2.0)])
    graph = graph_of(function)
    product = graph.ops.index(ca.OP_MUL)
    assert {graph.ops[a] for a in graph.operands[product]} == {ca.OP_SIN, ca.OP_ADD}
    assert [graph.ops[a] for a in graph.operands[graph.ops.index(ca.OP_OUTPUT)]] == [ca.OP_MUL]
    assert list(graph.constants.values()) == [2.0]


@pytest.mark.parametrize(
    ("value", "op"),
    [(X * Y + Z, FMA), (Z + X**2, FMA), (X * Y - Z, FMS), (Z - X * Y, FNMA)],
)
def test_a_product_is_rounded_with_its_sum(value, op, evaluate):
    function, ops = rewritten(value)
    assert ops == [op]
    check(function, evaluate)


def test_a_sum_takes_one_product_and_a_product_with_more_users_none(evaluate):
    function, ops = rewritten(X * Y + Y * Z)
    assert ops == sorted([ca.OP_MUL, FMA])
    check(function, evaluate)
    product = X * Y
    function, ops = rewritten(product + Z, product - Z)
    assert ops == sorted([ca.OP_MUL, ca.OP_ADD, ca.OP_SUB])
    check(function, evaluate)


def test_the_last_product_of_two_is_fused(evaluate):
    """Of x y = 1 - 2^-60, which rounds to 1, and its opposite: the sum of both, rounded first, would be 0."""
    function, _ = rewritten(X * Y + Y * Z)
    x, y = 1 + 2.0**-30, 1 - 2.0**-30
    (value,) = evaluate(function, *(np.full((1, 1), number) for number in (x, y, -x)))
    assert value[0, 0] == 2.0**-60


def test_quotients_of_one_divisor_share_its_reciprocal(evaluate):
    function, ops = rewritten(X / Y, Z / Y, 3 / Y)
    assert ops == sorted([ca.OP_INV, ca.OP_MUL, ca.OP_MUL, ca.OP_MUL])
    check(function, evaluate)
    assert rewritten(X / Y, 1 / Y)[1] == sorted([ca.OP_INV, ca.OP_MUL])
    assert rewritten(X / Y)[1] == [ca.OP_DIV]


def test_quotients_by_a_constant_are_products(evaluate):
    divisor = ca.SX(3.0)
    function, ops = rewritten(X / divisor + Y)
    assert ops == [FMA]
    check(function, evaluate)


def test_a_choice_is_one_operation(evaluate):
    function, ops = rewritten(ca.if_else(X < Y, Y, Z))
    assert ops == sorted([ca.OP_LT, SELECT])
    check(function, evaluate)
    condition = X < Y
    part = ca.if_else(condition, Y, 0)
    both, ops = rewritten(part + ca.if_else(ca.logic_not(condition), Z, 0), part)
    assert ops == sorted([ca.OP_LT, ca.OP_IF_ELSE_ZERO, SELECT])
    check(both, evaluate)


def test_a_sum_with_what_may_be_zero_is_a_choice(evaluate):
    part = ca.if_else(X < Y, X * Y, 0)
    for value, op in ((Z + part, FMA), (Z - part, FNMA)):
        function, ops = rewritten(value)
        assert ops == sorted([ca.OP_LT, SELECT, op])
        check(function, evaluate)
    function, ops = rewritten(part - Z)  # its other part would have to change sign
    assert ops == sorted([ca.OP_LT, ca.OP_IF_ELSE_ZERO, ca.OP_MUL, ca.OP_SUB])
    check(function, evaluate)


def test_products_with_what_may_be_zero_share_one_choice(evaluate):
    """CasADi moves the products, and their signs, into a choice each."""
    part = ca.if_else(X < Y, Z, 0)
    function, ops = rewritten(part * X + Y, Z - part * Y)
    assert ops == sorted([ca.OP_LT, ca.OP_IF_ELSE_ZERO, FMA, FNMA])
    check(function, evaluate)
    function, ops = rewritten(Y - part * X * Z, X - part * X * Y)
    assert ops.count(ca.OP_IF_ELSE_ZERO) == 1
    check(function, evaluate)


def test_choices_protect_from_numbers_that_are_not_finite(evaluate):
    part = ca.if_else(X > 0, Z, 0)
    function, _ = rewritten(part * (1 / X) + part * Y)
    rows = [np.array(x) for x in ([[0.0], [2.0]], [[1.0], [1.0]], [[1.0], [1.0]])]
    np.testing.assert_array_equal(evaluate(function, *rows)[0], [[0.0], [1.5]])


def test_equal_operations_are_one(evaluate):
    function, ops = rewritten(ca.sin(X * Y + Z), ca.cos(Z + Y * X))
    assert ops == sorted([FMA, ca.OP_SIN, ca.OP_COS])
    check(function, evaluate)


def test_a_step_takes_far_fewer_operations():
    function = Model("mini_cheetah").casadi_function("forward_dynamics")
    graph = graph_of(function)
    before = sum(function.instruction_id(k) not in NO_OPERATION for k in range(function.n_instructions()))
    assert sum(op not in NO_OPERATION for op in graph.ops) < 0.75 * before
    assert REMOVED in graph.ops


def choosing():
    """A function of x, y, z that reckons more where z + y > 1, from a product that is used elsewhere, too."""
    product, choice = X * Y, Z + Y > 1
    more = ca.if_else(choice, product * product + ca.sin(Y), 0)
    chosen = ca.if_else(ca.logic_and(choice, X > 0), product + more, product + X)
    return ca.Function("choosing", [X, Y, Z], [chosen, ca.logic_or(choice, X < 0), choice])


CHOICE = 2
"""Which output of that says what is chosen."""


def test_what_is_left_where_a_choice_is_zero():
    """Choices are made, dead code is removed, and operations that the full function does not fuse stay unfused."""
    says, whole, left = map(executed, variants_of(choosing(), [CHOICE]))
    assert sorted(says) == sorted([ca.OP_ADD, ca.OP_LT])
    assert ca.OP_SIN in whole
    assert sorted(whole) == sorted(operations(graph_of(choosing())))
    assert sorted(left) == sorted([ca.OP_MUL, ca.OP_ADD, ca.OP_LT, ca.OP_OR])
    alone = graph_of(ca.Function("alone", [X, Y], [X * Y + X, X < 0]))
    assert FMA in operations(alone)


def operations(graph):
    return [op for op in graph.ops if op not in NO_OPERATION]


def executed(fragment):
    return [fragment.graph.ops[k] for k in fragment.nodes]


def test_a_tile_takes_the_short_way_to_the_same_bits():
    """Robots with a zero flag have the bits of the full function, in tiles of zeros only and beside other robots."""
    function, results = choosing(), []

    def program(short):
        buffers = [Buffer(name, 1, "tiles") for name in ("x", "y", "z", *NAMES[1])]
        return Program("choosing", tuple(buffers), (Call(function, *NAMES, short_if_zero=short),))

    for short in ((), ("choice",)):
        kernel = load_kernel(f"choosing {short}", partial(program, short), "float64")
        n = 3 * kernel.lanes
        rows = np.random.default_rng(2).uniform(-1, 1, (3, n))
        rows[2, kernel.lanes :] = -1.0
        rows[2, -1] = 3.0  # the second tile chooses nothing, of the third one robot something
        arrays = {name: row.reshape(3, 1, kernel.lanes).copy() for name, row in zip("xyz", rows, strict=True)}
        arrays |= {name: np.zeros_like(arrays["x"]) for name in NAMES[1]}
        arrays = {name: aligned(value) for name, value in arrays.items()}
        kernel(arrays, n)
        results.append([arrays[name].copy() for name in NAMES[1]])
    np.testing.assert_array_equal(results[0], results[1])
    expected = np.array([[float(v) for v in function(*row)] for row in rows.T]).T
    np.testing.assert_allclose(results[1][0].ravel(), expected[0], rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(results[1][1].ravel(), expected[1])
    assert results[1][CHOICE].any(axis=(1, 2)).tolist() == [True, False, True]


NAMES = (("x", "y", "z"), ("value", "truth", "choice"))


def aligned(values):
    """A copy of an array as kernels want it."""
    result = aligned_zeros(values.shape, values.dtype)
    result[...] = values
    return result


def growing():
    """A function of x, y and an iterate z, of which a sine and a choice do not follow from z.

    It returns value, z, flag, and the choice, whose terms are needed where it is made, too.
    """
    shared, height = ca.sin(X) + X * Y, ca.exp(-Y * Y) + Y
    choice = height > 1
    chosen = ca.if_else(choice, shared * Z + height, Z)
    following = chosen + ca.if_else(choice, ca.sqrt(shared * shared + 1), X) * Z + X
    flag = ca.logic_and(following < 20, X > 0)
    return ca.Function("growing", [X, Y, Z], [following - shared, following, flag, choice])


GIVEN, LEFT = ("x", "y", "z"), ("value", "z", "flag", "choice")


def growing_program(again, short=()):
    function, first = growing(), ca.Function("first", [X], [0.5 + ca.if_else(X > 2, X, 0)])
    calls = [Call(first, ("x",), ("z",)), Call(function, GIVEN, LEFT, short_if_zero=short)]
    calls += [Call(function, GIVEN, LEFT, only_if="flag", short_if_zero=short, again=again)] * 3
    buffers = [Buffer(name, 1, "tiles") for name in ("x", "y", "value", "choice")]
    return Program("growing", (*buffers, Buffer("z", 1, "scratch"), Buffer("flag", 1, "scratch")), tuple(calls))


def crowding():
    """A function of x, y and an iterate z, two flags of which switch terms on that later terms contain.

    Each flag has an iterate that only the flag changes, and a product that both flags need.
    """
    near, far = X > 0, Y > 0
    left, right, shared = ca.sin(X) * Z, ca.sqrt(Y * Y + 1) + Z, ca.exp(-X * X)
    one = ca.if_else(near, shared + left, shared)
    both = ca.if_else(far, one + right * right, one)
    total = both + ca.if_else(near, ca.if_else(far, left * right, 0), 0) + ca.if_else(far, ca.cos(total_of(both)), 0)
    held, kept = ca.SX.sym("held"), ca.SX.sym("kept")
    next_held, next_kept = ca.if_else(near, held + total, held), ca.if_else(far, kept * 0.5 + left, kept)
    outputs = [total, 0.3 * total + Z, next_held, next_kept, total < 3, near, far]
    return ca.Function("crowding", [X, Y, Z, held, kept], outputs)


def total_of(x):
    """A number that takes several operations."""
    return x * x + 1 / (1 + x * x)


CROWD = (("x", "y", "z", "held", "kept"), ("value", "z", "held", "kept", "flag", "near", "far"))


@pytest.mark.parametrize(("dtype", "piece"), [("float64", 1000), ("float32", 1000), ("float64", 3)])
def test_each_flag_skips_its_operations_alone_to_the_same_bits(dtype, piece, monkeypatch):
    """Tiles in which no robot, some or all robots have neither flag, one or both; also in pieces of few operations."""
    results = []
    monkeypatch.setattr(partial_evaluation, "LONG", piece)
    monkeypatch.setattr(partial_evaluation, "PIECE", piece)
    for short in ((), ("near", "far"), ("far", "near")):
        function, iterates = crowding(), ("z", "held", "kept")
        calls = [Call(function, *CROWD, short_if_zero=short)]
        calls += [Call(function, *CROWD, only_if="flag", short_if_zero=short, again=iterates)] * 3
        names = (*CROWD[0], *(name for name in CROWD[1] if name not in CROWD[0]))
        program = Program("crowding", tuple(Buffer(name, 1, "tiles") for name in names), tuple(calls))
        kernel = load_kernel(f"crowding {short} {piece}", lambda program=program: program, dtype)
        n, rng = 8 * kernel.lanes, np.random.default_rng(3)
        arrays = {name: aligned(rng.uniform(0.5, 1, (8, 1, kernel.lanes)).astype(dtype)) for name in names}
        for tile in range(6):
            arrays["x"][tile] *= (-1, 1, -1, 1)[tile % 4]
            arrays["y"][tile] *= (-1, -1, 1, 1)[tile % 4]
        arrays["x"][6:, :, ::3] *= -1
        arrays["y"][6:, :, ::2] *= -1
        kernel(arrays, n)
        results.append([arrays[name].copy() for name in names])
    assert len({tuple(array.tobytes() for array in result) for result in results}) == 1
    assert np.isfinite(results[0]).all()


def test_parts_of_several_flags_are_as_many_as_flags():
    """Operations of a flag are no other flag's, and all are executed once or as recomputed constants."""
    parts = split_function(crowding(), {2, 3, 4}, [5, 6], {(2, 1), (3, 2), (4, 3)})
    of_flags = [{k for part in parts.parts if part.flag == flag for k in part.fragment.nodes} for flag in (5, 6)]
    assert not of_flags[0] & of_flags[1]
    assert all(of_flags)
    graph = parts.first[0].fragment.graph
    assert {graph.ops[k] for k in of_flags[1]} >= {ca.OP_SQRT, ca.OP_COS}
    assert ca.OP_SIN not in {graph.ops[k] for k in of_flags[1]}
    (short,) = [part for part in parts.short if part.fragment.nodes]
    assert len(short.fragment.nodes) < 8


def test_what_does_not_depend_on_an_iterate_is_in_the_prologue():
    parts = split_function(growing(), {2})
    (part,) = parts.parts
    (start,) = parts.first
    first, second = executed(start.fragment), executed(part.fragment)
    assert not part.constant
    assert {ca.OP_SIN, ca.OP_EXP, ca.OP_SQRT} <= set(first)
    assert not {ca.OP_SIN, ca.OP_EXP, ca.OP_SQRT} & set(second)
    before = set(start.fragment.nodes)
    read = {a for k in part.fragment.nodes for a in part.fragment.graph.operands[k]}
    assert set(start.fragment.keeps.values()) == read & before != set()
    needed = graph_of(growing()).ancestors([k for k, op in enumerate(part.fragment.graph.ops) if op == ca.OP_OUTPUT])
    assert before | {*part.fragment.nodes} == {k for k in needed if graph_of(growing()).ops[k] not in NO_OPERATION}


def test_what_only_a_flag_needs_is_in_a_variant():
    """The root is executed with the flag only, cheap values are recomputed there, and the sine is always needed."""
    flag = LEFT.index("choice")
    parts = split_function(growing(), {2}, [flag])
    assert {ca.OP_SIN, ca.OP_EXP, ca.OP_LT} <= set(executed(parts.first[0].fragment))
    assert ca.OP_SQRT not in executed(parts.first[0].fragment)
    constant = [part for part in parts.parts if part.constant]
    assert {ca.OP_SQRT} <= {op for part in constant if part.flag == flag for op in executed(part.fragment)}
    assert ca.OP_EXP in {op for part in constant for op in executed(part.fragment)}
    assert not any(part.constant or part.flag for part in parts.short)
    counts = [sum(len(part.fragment.nodes) for part in each) for each in (parts.short, parts.parts)]
    assert counts[0] < counts[1]
    with pytest.raises(ValueError, match="output 2 is a choice; expected one that does not follow"):
        split_function(growing(), {2}, [LEFT.index("flag")])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("short", [(), ("choice",)])
def test_a_call_again_goes_by_what_the_first_one_left_to_the_same_bits(short, dtype):
    """For loops that end at once, late or never, and for the short variant of the function."""
    results = []
    for again in ((), ("z",)):
        kernel = load_kernel(f"growing {again} {short}", partial(growing_program, again, short), dtype)
        n = 4 * kernel.lanes
        rows = np.random.default_rng(2).uniform(-1, 3, (2, n)).astype(dtype)
        rows[1, kernel.lanes : 3 * kernel.lanes] = -1.0  # the second tile and the third take the short way
        rows[0, 2 * kernel.lanes : 3 * kernel.lanes] = -1.0  # which makes one call, the fourth makes several again
        arrays = {name: row.reshape(4, 1, kernel.lanes) for name, row in zip("xy", rows, strict=True)}
        arrays |= {name: np.zeros_like(arrays["x"]) for name in ("value", "choice")}
        arrays = {name: aligned(value) for name, value in arrays.items()}
        kernel(arrays, n)
        results.append([arrays[name].copy() for name in ("value", "choice")])
    np.testing.assert_array_equal(results[0], results[1])
    assert np.isfinite(results[1]).all()
    assert results[1][1].any(axis=(1, 2)).tolist() == [True, False, False, True]


def test_a_second_iteration_of_a_step_takes_kinematics_from_the_first():
    """Repeated iterations have no sine of a joint angle, only that of the step, and 20 % fewer operations."""
    model = Model("mini_cheetah")
    options = StepOptions(contacts=tuple(c.name for c in model.robot.contacts if c.group == "foot"))
    function = iteration_function(model.mechanism, options, conserves=False)
    parts = split_function(function, {function.name_in().index("iterate")})
    second = [op for part in parts.parts if not part.constant for op in executed(part.fragment)]
    assert executed(parts.first[0].fragment).count(ca.OP_SIN) == 12
    assert second.count(ca.OP_SIN) == 1
    assert len(second) < 0.8 * len(operations(graph_of(function)))


@pytest.mark.parametrize(
    ("place", "change", "message"),
    [
        (2, {"again": ("x", "flag")}, "expected some of its inputs"),
        (1, {"again": ("z",)}, "expected it right after a call of the same function"),
        (2, {"inputs": ("y", "x", "z")}, "expected it right after a call of the same function"),
        (1, {"only_if": "x"}, "expected the first such call without only_if"),
        (2, {"again": ("x",)}, "but it changes 'z', too"),
    ],
)
def test_a_call_again_comes_after_one_of_the_same(place, change, message):
    program = growing_program(("z",))
    check_program(program)
    steps = list(program.steps)
    steps[place] = replace(steps[place], **change)
    with pytest.raises(ValueError, match=message):
        check_program(replace(program, steps=tuple(steps)))


def test_the_short_way_goes_by_an_output():
    buffers = tuple(Buffer(name, 1, "tiles") for name in ("x", "y", "z", *NAMES[1], "other"))
    program = Program("choosing", buffers, (Call(choosing(), *NAMES, short_if_zero=("other",)),))
    with pytest.raises(ValueError, match="short_if_zero 'other', expected one of its outputs"):
        check_program(program)
