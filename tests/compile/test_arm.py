"""Kernels for 64-bit Arm, looked at: LLVM makes vector instructions of all arithmetic, and calls no library.

It compiles for Arm on any processor. That the numbers are the same is seen by running them there: `make arm`.
"""

import re
from collections import Counter

import casadi as ca
import pytest
from llvmlite import binding, ir

from ce_gym.compile import Buffer, Call, Program
from ce_gym.compile.layout import layout_of
from ce_gym.compile.lowering.tile import emit_tile

X, Y = ca.SX.sym("x"), ca.SX.sym("y")
EVERYTHING = [
    *(X + Y, X - Y, X * Y, X / Y, -X, 1 / X, X * Y + X, X * Y - X, X - X * Y, X**5, ca.fabs(X) ** Y),
    *(f(X) for f in (ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.exp, ca.log, ca.tanh)),
    *(f(X) for f in (ca.sqrt, ca.fabs, ca.floor, ca.ceil, ca.sign)),
    *(f(X, Y) for f in (ca.atan2, ca.hypot, ca.fmin, ca.fmax, ca.copysign, ca.fmod, ca.remainder)),
    *(ca.if_else(X < Y, X, Y), ca.if_else(ca.logic_and(X <= Y, ca.ne(X, 0)), X, 0), ca.logic_not(X)),
]
REGISTERS = {"v": "NEON", "z": "SVE", "d": "scalar", "s": "scalar", "h": "scalar"}


@pytest.fixture(scope="module", autouse=True)
def all_targets():
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()


def module_text(dtype, triple):
    """LLVM code of a kernel with every operation."""
    function = ca.Function("everything", [X, Y], [ca.vertcat(*EVERYTHING)])
    sizes = {"x": 1, "y": 1, "result": len(EVERYTHING)}
    buffers = tuple(Buffer(name, size, "tiles") for name, size in sizes.items())
    program = Program("everything", buffers, (Call(function, ("x", "y"), ("result",)),))
    module = ir.Module("arm")
    module.triple = triple
    run = ir.Function(module, ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 5), "run")
    builder = ir.IRBuilder(run.append_basic_block("entry"))
    emit_tile(builder, program, layout_of(program, dtype), tuple(run.args))
    builder.ret_void()
    return str(module)


def assembly(dtype, cpu="generic", attribute=""):
    """The kernel for Linux on 64-bit Arm, optimised as numba does; an attribute is given to all functions."""
    triple = "aarch64-unknown-linux-gnu"
    text = re.sub(r"^(define .*)$", rf"\1 {attribute}", module_text(dtype, triple), flags=re.MULTILINE)
    module = binding.parse_assembly(text)
    machine = binding.Target.from_triple(triple).create_target_machine(cpu=cpu, opt=3, reloc="pic")
    passes = binding.create_pass_builder(machine, binding.create_pipeline_tuning_options(speed_level=3))
    passes.getModulePassManager().run(module, passes)
    return machine.emit_assembly(module)


def arithmetic(text):
    """How many floating-point instructions there are on each kind of registers, moves not included."""
    found = re.findall(r"^\t(f\w+)\t([a-z])\d", text, re.MULTILINE)
    return Counter(REGISTERS[register] for name, register in found if name != "fmov" and register in REGISTERS)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_all_arithmetic_is_on_neon_vectors(dtype):
    text = assembly(dtype)
    counts = arithmetic(text)
    assert set(counts) == {"NEON"}
    assert counts["NEON"] > 500
    assert {"float64": "v0.2d", "float32": "v0.4s"}[dtype] in text
    called = re.findall(r"^\tbl?\t([a-z_]\S*)", text, re.MULTILINE)
    assert called == ["call_0"]


@pytest.mark.parametrize(("bits", "cpu"), [(256, "neoverse-v1"), (512, "a64fx")])
def test_sve_registers_of_a_known_width_are_filled(bits, cpu):
    """LLVM keeps to NEON unless it is told the width; told, it needs fewer instructions by as much."""
    n, usual = bits // 128, arithmetic(assembly("float64", cpu))
    wide = arithmetic(assembly("float64", cpu, f"vscale_range({n},{n})"))
    assert usual["NEON"] > 500
    assert set(wide) == {"SVE"}
    assert wide["SVE"] * n <= usual.total()
