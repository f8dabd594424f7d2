"""A compiled kernel that can be called: checks of its arguments, addresses, threads."""

import weakref
from collections.abc import Callable, Mapping

import numpy as np

from ce_gym.compile.arrays import ALIGNMENT, lane_count, tile_count
from ce_gym.compile.layout import Layout, MachineCode
from ce_gym.compile.program import Buffer
from ce_gym.compile.threads import MemoryPool, run_chunks

KEYS, COUNTERS = np.dtype(np.uint64), np.dtype(np.int64)
WORD = 8
"""Bytes of an address or a count."""
LARGEST_TABLE = 2**31 - 1
"""Most entries of a table, because indices are 32-bit integers."""
LONGEST_SIDE = 2**23
"""Most rows or columns of a table, so that half indices are exact in single precision."""


class Kernel:
    """Machine code that processes tiles of environments. Several threads may call the same kernel at a time.

    Attributes:
        name: Name of the program.
        dtype: Type of the numbers in lanes.
        lanes: Environments in a tile.
        buffers: Buffers by name.
        repeats: Names of the run-time integers.
        code: The machine code.
        digest: Name of the kernel in the cache, which depends on the whole program.
        arguments: Buffers whose arrays the caller passes, in the order of their addresses.
        scratch_words: 64-bit words of memory for each thread.
    """

    def __init__(self, layout: Layout, run: MachineCode, digest: str):
        self.name = layout.name
        self.digest = digest
        self.dtype = layout.dtype
        self.lanes = lane_count(layout.dtype)
        self.buffers: dict[str, Buffer] = {b.name: b for b in layout.buffers}
        self.repeats = layout.repeats
        self.arguments = layout.arguments
        self.scratch_words = layout.scratch_bytes // WORD
        self.code = run
        self._is_random = layout.is_random
        self._arguments = [
            (b.name, b.kind, b.size, np.dtype(b.dtype or layout.dtype), b.name in layout.written)
            for b in layout.arguments
        ]
        self._n_words = layout.counts
        self._tables = MemoryPool(self._n_words + len(self.repeats))
        self._scratch = MemoryPool(self.scratch_words)
        self._known: dict[str, tuple[weakref.ref[np.ndarray], int]] = {}

    def __call__(
        self,
        arrays: Mapping[str, np.ndarray],
        num_envs: int,
        repeats: Mapping[str, int] | None = None,
        keys: np.ndarray | None = None,
        counters: np.ndarray | None = None,
        num_threads: int = 1,
    ) -> None:
        """Run the program on every tile.

        Args:
            arrays: Arrays by name of the buffer: `tiles`, shape (n_tiles, size, lanes); `rows_*`, shape (num_envs,
                size); tables, shape (rows, columns). Other arrays are ignored. Outputs are changed in place.
            num_envs: Number of environments; the last tile may be padded.
            repeats: A number for each entry of `self.repeats`.
            keys: uint64, shape (num_envs,), if the program draws random numbers.
            counters: int64, shape (num_envs,), if the program draws random numbers.
            num_threads: threads that share the tiles; the result does not depend on this number.

        Raises:
            ValueError: one line with the kernel, the array and the expected shape and dtype.
        """
        if num_envs == 0:
            return
        n_tiles = tile_count(num_envs, self.dtype)
        words = self._addresses(arrays, num_envs, n_tiles)
        if self._is_random:
            words.append(self._address("keys", keys, (num_envs,), KEYS))
            words.append(self._address("counters", counters, (num_envs,), COUNTERS))
        words += [self._count(name, repeats) for name in self.repeats]
        block = self._tables.take()
        table, address = block
        table[: len(words)] = words
        counts = address + WORD * self._n_words

        # The default argument keeps the arrays alive as long as a thread works, even if this call is interrupted.
        def work(first_tile: int, end_tile: int, _kept: object = (block, arrays, keys, counters)) -> None:
            scratch = self._scratch.take()
            self.code(address, counts, scratch[1], first_tile, end_tile, num_envs)
            self._scratch.give(scratch)

        run_chunks(work, n_tiles, num_threads)
        self._tables.give(block)

    def bind(self, arrays: Mapping[str, np.ndarray], num_envs: int) -> Callable[[], None]:
        """Return a function that runs the program on the same arrays at each call, in one thread at a time.

        Args:
            arrays: as in a call.
            num_envs: number of environments.

        Raises:
            ValueError: as in a call; or if the program repeats steps or draws random numbers.
        """
        if self.repeats or self._is_random:
            raise ValueError(f"kernel {self.name!r}: repeats or draws, expected a program that does neither to bind")
        n_tiles = tile_count(num_envs, self.dtype)
        words = self._addresses(arrays, num_envs, n_tiles)
        table, scratch = self._tables.take(), self._scratch.take()
        table[0][: len(words)] = words
        run_code, address, memory = self.code, table[1], scratch[1]

        def run(_kept: object = (arrays, table, scratch)) -> None:
            run_code(address, address, memory, 0, n_tiles, num_envs)

        return run

    def _addresses(self, arrays: Mapping[str, np.ndarray], num_envs: int, n_tiles: int) -> list[int]:
        """Return the addresses of all arrays, then the shapes of tables, in the order of the layout."""
        addresses, shapes = [], []
        for name, kind, size, dtype, written in self._arguments:
            array = arrays.get(name)
            if kind == "table":
                shape = self._table_shape(name, array)
                shapes += shape
            else:
                shape = (n_tiles, size, self.lanes) if kind == "tiles" else (num_envs, size)
            address = self._address(name, array, shape, dtype)
            if kind == "tiles" and address % ALIGNMENT:
                raise ValueError(f"kernel {self.name!r}: array {name!r} is not aligned; make it with aligned_zeros")
            if written and not arrays[name].flags.writeable:
                raise ValueError(f"kernel {self.name!r}: array {name!r} is read-only, expected a writeable one")
            addresses.append(address)
        return addresses + shapes

    def _table_shape(self, name: str, array: object) -> tuple[int, ...]:
        """Return the rows and columns of a table."""
        shape = array.shape if isinstance(array, np.ndarray) else ()
        if len(shape) != 2 or not all(3 <= n <= LONGEST_SIDE for n in shape) or np.prod(shape) > LARGEST_TABLE:
            got = shape if isinstance(array, np.ndarray) else "nothing" if array is None else type(array).__name__
            expected = f"(rows, columns), 3 to {LONGEST_SIDE} of each and at most {LARGEST_TABLE} entries"
            raise ValueError(f"kernel {self.name!r}: table {name!r} is {got}, expected {expected}")
        return shape

    def _address(self, name: str, array: object, shape: tuple[int, ...], dtype: np.dtype) -> int:
        """Return the address of an array after checks of its shape, dtype and order."""
        known = self._known.get(name)  # faster than checks, and most arrays have been seen before
        if known is not None and known[0]() is array and array is not None and array.shape == shape:  # type: ignore[attr-defined]
            return known[1]
        if not isinstance(array, np.ndarray):
            got = "nothing" if array is None else type(array).__name__
        elif array.shape == shape and array.dtype == dtype and array.flags.c_contiguous:
            self._known[name] = (weakref.ref(array), array.ctypes.data)
            return self._known[name][1]
        else:
            order = "C order" if array.flags.c_contiguous else "not in C order"
            got = f"{array.dtype} {array.shape} {order}"
        raise ValueError(f"kernel {self.name!r}: array {name!r} is {got}, expected {dtype} {shape} C order")

    def _count(self, name: str, repeats: Mapping[str, int] | None) -> int:
        if repeats is None or name not in repeats:
            raise ValueError(f"kernel {self.name!r}: repeats lacks {name!r}, expected a number of repetitions")
        return repeats[name]
