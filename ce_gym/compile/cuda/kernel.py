"""A kernel of the GPU that can be called: checks of the tensors, their addresses, one launch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ce_gym.compile.cuda.source import Source
from ce_gym.compile.program import Buffer

Launcher = Callable[[Sequence[int], Sequence[int], int], None]
"""Takes the addresses of the arrays, 32-bit integers, and the number of robots."""


class CudaKernel:
    """Machine code that processes robots, with one or more threads for each.

    Args:
        source: source of the machine code.
        launch: launches the machine code.
        place: name of the device in torch.

    Attributes:
        name: of the first program.
        dtype: of the arithmetic.
        buffers: by name.
        repeats: names of the run-time integers.
    """

    def __init__(self, source: Source, launch: Launcher, place: str):
        layout = source.layout
        self.name, self.dtype, self.repeats = layout.name, layout.dtype, layout.repeats
        self.buffers: dict[str, Buffer] = {b.name: b for b in layout.buffers}
        self._arguments, self._is_random = layout.arguments, layout.is_random
        self._launch, self._place = launch, place

    def __call__(
        self,
        arrays: Mapping[str, Any],
        num_envs: int,
        repeats: Mapping[str, int] | None = None,
        keys: Any = None,
        counters: Any = None,
        num_threads: int = 1,
    ) -> None:
        """Run all stages on every robot; returns before the GPU has finished, as operations of torch do.

        Args:
            arrays: contiguous tensors by name of the buffer: `tiles`, shape (1, size, num_envs); `rows_*`, shape
                (num_envs, size); tables, shape (rows, columns). Other tensors are ignored.
            num_envs: number of robots.
            repeats: a number for each of `self.repeats`.
            keys: int64, the bits of the unsigned keys, shape (num_envs,), if random numbers are drawn.
            counters: int64, shape (num_envs,), if random numbers are drawn; incremented.
            num_threads: ignored; kernels of the CPU have this argument.

        Raises:
            ValueError: one line with the kernel, the array and the expected dtype, shape and device.
        """
        addresses, numbers = [], []
        for b in self._arguments:
            dtype = b.dtype or self.dtype
            if b.kind == "table":
                shape = tuple(arrays[b.name].shape) if b.name in arrays else ()
                numbers += shape
                if len(shape) != 2 or min(shape) < 3:
                    raise ValueError(f"kernel {self.name!r}: table {b.name!r} is {shape}, expected at least (3, 3)")
            else:
                shape = (1, b.size, num_envs) if b.kind == "tiles" else (num_envs, b.size)
            addresses.append(self._address(b.name, arrays.get(b.name), shape, dtype))
        if self._is_random:
            addresses += [
                self._address(name, array, (num_envs,), "int64")
                for name, array in (("keys", keys), ("counters", counters))
            ]
        for name in self.repeats:
            if repeats is None or name not in repeats:
                raise ValueError(f"kernel {self.name!r}: repeats lacks {name!r}, expected a number of repetitions")
            numbers.append(repeats[name])
        self._launch(addresses, numbers, num_envs)

    def _address(self, name: str, array: Any, shape: tuple[int, ...], dtype: str) -> int:
        if array is None:
            got = "nothing"
        elif not hasattr(array, "data_ptr"):
            got = type(array).__name__
        else:
            known = str(array.dtype).removeprefix("torch."), tuple(array.shape), str(array.device)
            if known == (dtype, shape, self._place) and array.is_contiguous():
                return array.data_ptr()
            got = f"{known[0]} {known[1]} on {known[2]}"
        expected = f"{dtype} {shape} on {self._place}, contiguous"
        raise ValueError(f"kernel {self.name!r}: array {name!r} is {got}, expected {expected}")
