"""The number of floating-point operations of a function."""

from __future__ import annotations

from collections import Counter

import casadi
from llvmlite import ir

from ce_gym.compile.lowering.function import Arguments, lower_function
from ce_gym.compile.lowering.vector import Value, VectorBuilder

OPERATIONS = {"fadd": 1, "fsub": 1, "fmul": 1, "fdiv": 1, "llvm.fma": 2, "llvm.sqrt": 1}
"""Operations that count, and how often each does; comparisons, minima and sign changes do not count."""


def floating_point_operations(function: casadi.Function, dtype: str = "float64") -> int:
    """Return the number of sums, products, quotients and roots for one lane, also those in polynomials of sines.

    Operations are counted as emitted, before the optimiser merges equal ones. A multiply-add counts as two.

    Args:
        function: An SX function.
        dtype: "float64" or "float32", whose polynomials differ.
    """
    pointer = VectorBuilder(None, dtype).float_type.as_pointer()
    signature = ir.FunctionType(ir.VoidType(), [pointer] * (function.n_in() + function.n_out()))
    body = ir.Function(ir.Module(), signature, "counted")
    block = body.append_basic_block("entry")
    inputs, outputs = (dict(enumerate(part)) for part in (body.args[: function.n_in()], body.args[function.n_in() :]))
    arguments = Arguments(inputs, outputs)
    lower_function(VectorBuilder(ir.IRBuilder(block), dtype), function, arguments)
    counts = Counter(_name(instruction) for instruction in block.instructions)
    return sum(times * counts[name] for name, times in OPERATIONS.items())


def _name(instruction: Value) -> str:
    """Return the name of an operation; for an intrinsic without its types."""
    if isinstance(instruction, ir.CallInstr):
        return ".".join(instruction.callee.name.split(".")[:2])
    return instruction.opname
