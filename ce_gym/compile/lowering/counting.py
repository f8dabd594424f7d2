"""Floating-point operations of a function, as they are emitted."""

from __future__ import annotations

from collections import Counter

import casadi
from llvmlite import ir

from ce_gym.compile.lowering.function import lower_function
from ce_gym.compile.lowering.vector import Value, VectorBuilder

OPERATIONS = {"fadd": 1, "fsub": 1, "fmul": 1, "fdiv": 1, "llvm.fma": 2, "llvm.sqrt": 1}
"""What counts, and how often; comparisons, minima and sign changes do not."""


def floating_point_operations(function: casadi.Function, dtype: str = "float64") -> int:
    """Return how many operations one lane takes: sums, products, quotients and roots, polynomials of sines included.

    They are counted as emitted, multiply-adds twice, before the optimiser shares what is equal.

    Args:
        function: An SX function.
        dtype: "float64" or "float32", whose polynomials differ.
    """
    pointer = VectorBuilder(None, dtype).float_type.as_pointer()
    signature = ir.FunctionType(ir.VoidType(), [pointer] * (function.n_in() + function.n_out()))
    body = ir.Function(ir.Module(), signature, "counted")
    block = body.append_basic_block("entry")
    lower_function(
        VectorBuilder(ir.IRBuilder(block), dtype), function, body.args[: function.n_in()], body.args[function.n_in() :]
    )
    counts = Counter(_name(instruction) for instruction in block.instructions)
    return sum(times * counts[name] for name, times in OPERATIONS.items())


def _name(instruction: Value) -> str:
    """An operation's name; an intrinsic's without its types."""
    if isinstance(instruction, ir.CallInstr):
        return ".".join(instruction.callee.name.split(".")[:2])
    return instruction.opname
