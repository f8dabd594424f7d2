"""A program that cannot be compiled is refused with one line that says why."""

import casadi as ca
import pytest

from ce_gym.compile import Buffer, Call, Program, load_kernel

X = ca.SX.sym("x", 3)
DOUBLE = ca.Function("double", [X], [2 * X])
A, B = Buffer("a", 3, "tiles"), Buffer("b", 3, "scratch")
M = ca.MX.sym("m", 3)

WRONG = {
    "buffer names must differ": Program("p", (A, A), ()),
    "buffer 'a': kind 'rows', expected one of tiles, rows_in": Program("p", (Buffer("a", 3, "rows"),), ()),  # type: ignore[arg-type]
    "buffer 'a': size 0, expected at least 1": Program("p", (Buffer("a", 0, "tiles"),), ()),
    "buffer 'a': dtype 'float32', expected": Program("p", (Buffer("a", 3, "tiles", "float32"),), ()),
    "buffer 'r': dtype 'int8', expected": Program("p", (Buffer("r", 3, "rows_in", "int8"),), ()),
    r"call 0 \(double\): input buffer 'c' is not among": Program("p", (A,), (Call(DOUBLE, ("c",), ("a",)),)),
    r"call 0 \(double\): 2 input buffers, expected 1": Program("p", (A,), (Call(DOUBLE, ("a", "a"), ("a",)),)),
    r"buffer 'd' has size 4, expected 3 as output 0": Program(
        "p", (A, Buffer("d", 4, "tiles")), (Call(DOUBLE, ("a",), ("d",)),)
    ),
    "reads 'b', expected an earlier call to write it first": Program("p", (A, B), (Call(DOUBLE, ("b",), ("a",)),)),
    "MXFunction, expected an SX function": Program(
        "p", (A,), (Call(ca.Function("m", [M], [ca.sin(M)]), ("a",), ("a",)),)
    ),
    "expected different buffers": Program("p", (A,), (Call(ca.Function("t", [X], [X, X]), ("a",), ("a", "a")),)),
    "no call writes the rows_out buffer 'r'": Program("p", (Buffer("r", 3, "rows_out"),), ()),
    "buffer 'b': kind 'tiles', expected 'scratch' for a part of 'a'": Program(
        "p", (A, Buffer("b", 3, "tiles", "", "a")), ()
    ),
    "buffer 'b': part of 'a' from 0, expected to lie within": Program("p", (A, Buffer("b", 3, "scratch", "", "a")), ()),
    "buffer 'c': part of 'b' from 2, expected to lie": Program("p", (B, Buffer("c", 2, "scratch", "", "b", 2)), ()),
    "skip_unless must name a tiles buffer of size 1": Program("p", (A,), (), skip_unless="a"),
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_program(message):
    with pytest.raises(ValueError, match=f"^program 'p': .*{message}") as error:
        load_kernel(message, lambda: WRONG[message])
    assert "\n" not in str(error.value)


def test_a_refused_program_leaves_nothing_behind():
    for _ in range(2):
        with pytest.raises(ValueError, match="size 0"):
            load_kernel("refused", lambda: Program("p", (Buffer("a", 0, "tiles"),), ()))
    good = Program("p", (A,), (Call(DOUBLE, ("a",), ("a",)),))
    assert load_kernel("refused", lambda: good).name == "p"
