"""A kernel as a function that XLA calls without Python, through its typed foreign function interface (FFI).

numba compiles the function, so no C++ compiler is needed. Structures of the interface are read as arrays of words;
their definitions are in `xla/ffi/api/c_api.h` in the folder `jax.ffi.include_dir()`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numba import cfunc, njit, types
from numba.extending import intrinsic
from numba.np.numpy_support import carray
from numpy.typing import NDArray

EXTENSION, API, ARGUMENTS, RESULTS = 1, 2, 9, 14
"""Positions in XLA_FFI_CallFrame of `extension_start`, `api`, `args.args` and `rets.rets`."""
TYPE, METADATA, DATA = 1, 3, 3
"""Positions of `type` in XLA_FFI_Extension_Base, `metadata` in XLA_FFI_Metadata_Extension, `data` in XLA_FFI_Buffer."""
MINOR_OF_API, MAJOR, MINOR, TRAITS = 9, 6, 7, 8
"""Positions, in words of 32 bits, of the version in XLA_FFI_Api, and of version and traits in XLA_FFI_Metadata."""


def _pointer(typing_context, address):
    def generate(context, builder, signature, values):
        return builder.inttoptr(values[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


pointer_to: Any = intrinsic(_pointer)
"""Return an integer as a pointer."""


@njit
def word_at(address, i):
    """Return word number i of a structure or list."""
    return carray(pointer_to(address), i + 1, np.int64)[i]


@njit
def report_version(frame):
    """Write the supported version if XLA registers the function: major 0, with the minor version of XLA."""
    extension = word_at(frame, EXTENSION)
    if extension == 0 or np.int32(word_at(extension, TYPE)) != 1:  # XLA_FFI_Extension_Metadata
        return False
    metadata = carray(pointer_to(word_at(extension, METADATA)), TRAITS + 1, np.int32)
    metadata[MAJOR] = 0
    metadata[MINOR] = carray(pointer_to(word_at(frame, API)), MINOR_OF_API + 1, np.int32)[MINOR_OF_API]
    metadata[TRAITS] = 0
    return True


@njit
def numbers_of(buffers, i):
    """Return the address of the numbers of an argument or result."""
    return word_at(word_at(buffers, i), DATA)


def kernel_handler(
    kernel: Any, num_envs: int, arrays: Mapping[str, NDArray], results: Sequence[str], repeats: int
) -> tuple[Any, int]:
    """Return a function of numba's `cfunc` with the type XLA_FFI_Handler, and the bytes of its last result, its memory.

    Args:
        kernel: A kernel of `ce_gym.compile` that repeats its steps and draws no random numbers.
        num_envs: Number of environments.
        arrays: Constant arrays of the kernel, which must stay in memory. XLA passes all others.
        results: Names of arrays that the kernel changes: the first arguments, in the memory of the first results.
        repeats: Number of repetitions.
    """
    names = [buffer.name for buffer in kernel.arguments]
    addresses = [arrays[name].ctypes.data if name in arrays else 0 for name in names]
    shapes = [n for buffer in kernel.arguments if buffer.kind == "table" for n in arrays[buffer.name].shape]
    words = np.array([*addresses, *shapes, repeats])
    arguments = [*results, *(name for name in names if name not in arrays and name not in results)]
    places = np.array([names.index(name) for name in arguments])
    run, scratch_words, n_tiles = kernel.code, kernel.scratch_words, -(-num_envs // kernel.lanes)
    n_words, n_results = len(words), len(results)

    @cfunc(types.int64(types.int64))
    def handler(frame):
        if report_version(frame):
            return 0
        given, returned = word_at(frame, ARGUMENTS), word_at(frame, RESULTS)
        scratch = numbers_of(returned, n_results)
        table = scratch + 8 * scratch_words
        entries = carray(pointer_to(table), n_words, np.int64)
        for i in range(n_words):
            entries[i] = words[i]
        for i in range(len(places)):
            entries[places[i]] = numbers_of(returned, i) if i < n_results else numbers_of(given, i)
        run(table, table + 8 * (n_words - 1), scratch, 0, n_tiles, num_envs)
        return 0

    return handler, 8 * (scratch_words + n_words)
