"""The calling convention of a kernel: the order of addresses and repeat counts, and offsets of scratch values.

The layout is stored beside the machine code, so that a cached kernel needs neither CasADi nor the program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from ce_gym.compile.arrays import ALIGNMENT
from ce_gym.compile.program import Buffer, Program, run_time_integers

MachineCode = Callable[[int, int, int, int, int, int], None]
"""Takes addresses of the list of arrays, the repeat counts and scratch memory; first tile, end tile, environments."""


@dataclass(frozen=True)
class Layout:
    """The calling convention of one kernel.

    Attributes:
        name: of the program.
        dtype: of the lanes.
        buffers: all buffers of the program, in its order.
        repeats: names of the run-time integers, in order.
        written: buffers that some call writes.
    """

    name: str
    dtype: str
    buffers: tuple[Buffer, ...]
    repeats: tuple[str, ...]
    written: tuple[str, ...]

    @cached_property
    def arguments(self) -> tuple[Buffer, ...]:
        """Buffers whose arrays the caller passes, in the order of the addresses; shapes of tables come last."""
        return tuple(b for b in self.buffers if b.kind in ("tiles", "rows_in", "rows_out", "table"))

    @cached_property
    def shapes(self) -> dict[str, int]:
        """Position of the number of rows of each table among the addresses; the number of columns comes next."""
        tables = [b.name for b in self.arguments if b.kind == "table"]
        return {name: len(self.arguments) + 2 * i for i, name in enumerate(tables)}

    @property
    def keys(self) -> int:
        """Position of the address of the keys among the addresses; the address of the counters comes next."""
        return len(self.arguments) + 2 * len(self.shapes)

    @property
    def counts(self) -> int:
        """Number of 64-bit words before the repeat counts."""
        return self.keys + 2 * self.is_random

    @cached_property
    def is_random(self) -> bool:
        """Whether the kernel draws random numbers, which takes keys and counters."""
        return any(b.kind == "random" for b in self.buffers)

    @cached_property
    def scratch_offsets(self) -> dict[str, int]:
        """First byte of each buffer in the memory of a thread; one vector has 64 bytes in either dtype."""
        offsets, end = {}, 0
        for buffer in self.buffers:
            if buffer.kind != "tiles" and not buffer.within:
                offsets[buffer.name] = end
                end += ALIGNMENT * buffer.size
        for buffer in self.buffers:
            if buffer.within:
                offsets[buffer.name] = offsets[buffer.within] + ALIGNMENT * buffer.start
        return offsets

    @cached_property
    def scratch_bytes(self) -> int:
        """Bytes of memory for each thread."""
        return ALIGNMENT * sum(b.size for b in self.buffers if b.kind != "tiles" and not b.within)


def layout_of(program: Program, dtype: str) -> Layout:
    """Return the calling convention of a program."""
    repeats = dict.fromkeys(run_time_integers(program.steps))
    written = dict.fromkeys(name for call in program.calls for name in call.outputs)
    return Layout(program.name, dtype, program.buffers, tuple(repeats), tuple(written))


def layout_from(record: dict) -> Layout:
    """Return a layout from its `dataclasses.asdict`, which may have passed through JSON."""
    buffers = tuple(Buffer(**buffer) for buffer in record["buffers"])
    return Layout(record["name"], record["dtype"], buffers, tuple(record["repeats"]), tuple(record["written"]))
