"""Calls of a kernel from numba's `@njit` code, by a symbol with the digest of the kernel.

numba may cache the callers on disk. Cached code is refused, and compiled again, in a process that has not loaded the
very kernel: numba takes an `OSError` while it reads a cached function for a missing file.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.core.funcdesc import ExternalFunctionDescriptor
from numba.extending import intrinsic

from ce_gym.compile import Kernel, export_symbol
from ce_gym.compile.arrays import ALIGNMENT

_exported: set[str] = set()
"""Symbols of the kernels that this process has loaded for numba."""


class _Dependency:
    """Lies beside machine code that calls a kernel, in the cache of numba."""

    def __init__(self, symbol: str) -> None:
        self.symbol = symbol

    def __reduce__(self) -> tuple[Any, ...]:
        return _loaded_dependency, (self.symbol,)


def _loaded_dependency(symbol: str) -> _Dependency:
    if symbol not in _exported:
        raise FileNotFoundError(f"{symbol} is not the kernel of a robot of this process")
    return _Dependency(symbol)


def kernel_call(kernel: Kernel) -> Any:
    """Return an intrinsic `(arrays, scratch, repeats, first_tile, end_tile, num_envs)` that runs a kernel.

    `arrays` is a tuple in the order of `kernel.arguments`; `scratch` is an array of `scratch_size(kernel)` words.
    """
    symbol = export_symbol(kernel)
    _exported.add(symbol)
    is_table = [buffer.kind == "table" for buffer in kernel.arguments]
    word = types.int64
    external = ExternalFunctionDescriptor(symbol, types.void, (word,) * 6)

    @intrinsic
    def call(typing_context, arrays, scratch, repeats, first_tile, end_tile, num_envs):
        def generate(context, builder, signature, values):
            constant, integer = (lambda n: context.get_constant(word, n)), context.get_value_type(word)
            packed, memory, count, *tiles = values
            addresses, shapes = [], []
            for i, kind in enumerate(signature.args[0]):
                array = context.make_array(kind)(context, builder, builder.extract_value(packed, i))
                addresses.append(builder.ptrtoint(array.data, integer))
                if is_table[i]:
                    shapes += cgutils.unpack_tuple(builder, array.shape, 2)
            words = [*addresses, *shapes, count]
            table = cgutils.alloca_once(builder, integer, size=len(words))
            for i, value in enumerate(words):
                builder.store(value, builder.gep(table, [constant(i)]))
            first = builder.ptrtoint(table, integer)
            counts = builder.add(first, constant(8 * (len(words) - 1)))
            data = context.make_array(signature.args[1])(context, builder, memory).data
            end_of_padding = builder.add(builder.ptrtoint(data, integer), constant(ALIGNMENT - 1))
            aligned = builder.and_(end_of_padding, constant(-ALIGNMENT))
            function = context.declare_external_function(builder.module, external)
            builder.call(function, [first, counts, aligned, *tiles])
            context.environment.consts.append(_Dependency(symbol))
            return context.get_dummy_value()

        return types.void(arrays, scratch, word, word, word, word), generate

    return call


def scratch_size(kernel: Kernel) -> int:
    """Return the number of 64-bit words that `kernel_call` needs for each thread."""
    return kernel.scratch_words + ALIGNMENT // 8
