"""Where robots live: numpy arrays and the CPU's kernels, or torch tensors and a GPU's.

A device makes, reads and writes the state arrays of `ce_gym.sim.tiles` and loads the kernels that work on them; whoever
holds robots asks it and does not mind which it is. A GPU's arrays are one tile with a lane for each robot. torch is
imported when a GPU is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ce_gym.compile import Program, load_kernel
from ce_gym.sim import tiles as host_tiles

Array = Any
"""A numpy array on the CPU, a torch tensor on a GPU."""
Build = Callable[[], Sequence[Program]]


class Device(Protocol):
    """What is asked of a place where robots live.

    Attributes:
        name: "cpu", "cuda", "cuda:1" and so on.
        fuses: Whether stages that follow each other are one kernel.
    """

    name: str
    fuses: bool

    def tiles(self, num_envs: int, size: int, dtype: str) -> Array:
        """Return zeros for `size` values of each robot, as kernels take them."""
        ...

    def copy(self, array: Array) -> Array:
        """Return a copy of such an array."""
        ...

    def read(self, array: Array, num_envs: int) -> Array:
        """Return a copy of such an array as rows, shape (num_envs, size)."""
        ...

    def write(self, array: Array, rows: Any, mask: Any = None) -> None:
        """Write rows, shape (num_envs, size) or anything that broadcasts to it, of robots where `mask` is true."""
        ...

    def rows(self, values: Any, dtype: str, shape: tuple[int, ...] = ()) -> Array:
        """Return values as an array of this device, contiguous; broadcast to `shape`, if one is given."""
        ...

    def zeros(self, shape: tuple[int, ...], dtype: str) -> Array:
        """Return zeros as a plain array, one robot per row."""
        ...

    def empty(self, shape: tuple[int, ...], dtype: str) -> Array:
        """Return a plain array whose values are yet to be written."""
        ...

    def assign(self, array: Array, rows: Any, mask: Any = None) -> None:
        """Write rows of a plain array, where `mask` is true."""
        ...

    def host(self, array: Array) -> NDArray:
        """Return a plain array in the memory of the CPU, its type kept."""
        ...

    def kernel(self, key: str, build: Build, dtype: str) -> Any:
        """Return the kernel of some stages, see `ce_gym.compile.load_kernel`."""
        ...


class Cpu:
    """numpy arrays and the kernels of `ce_gym.compile`."""

    name, fuses = "cpu", False
    tiles = staticmethod(host_tiles.tiles)
    read = staticmethod(host_tiles.read_rows)
    write = staticmethod(host_tiles.write_rows)

    def copy(self, array: Array) -> NDArray:
        """Return a copy."""
        return array.copy()

    def rows(self, values: Any, dtype: str, shape: tuple[int, ...] = ()) -> NDArray:
        """Return values as an array; broadcast to `shape` and contiguous, if one is given."""
        array = np.asarray(values, dtype)
        return np.ascontiguousarray(np.broadcast_to(array, shape)) if shape else array

    def zeros(self, shape: tuple[int, ...], dtype: str) -> NDArray:
        """Return zeros."""
        return np.zeros(shape, dtype)

    def empty(self, shape: tuple[int, ...], dtype: str) -> NDArray:
        """Return an array whose values are yet to be written."""
        return np.empty(shape, dtype)

    def assign(self, array: Array, rows: Any, mask: Any = None) -> None:
        """Write rows where `mask` is true."""
        array[...] = rows if mask is None else np.where(_beside(mask, array.ndim), rows, array)

    def host(self, array: Array) -> NDArray:
        """Return the array itself."""
        return array

    def kernel(self, key: str, build: Build, dtype: str) -> Any:
        """Return the kernel of one stage."""

        def only() -> Program:
            (stage,) = build()
            return stage

        return load_kernel(key, only, dtype)


class Cuda:
    """torch tensors and the kernels of `ce_gym.compile.cuda`.

    Args:
        gpu: Number of the GPU.

    Raises:
        CudaUnavailable: If there is no such GPU, or a package is missing; one line.
    """

    fuses = True

    def __init__(self, gpu: int = 0) -> None:
        from ce_gym.compile.cuda.gpu import architecture

        architecture(gpu)
        self.name = self._place = f"cuda:{gpu}"
        self._gpu = gpu

    def tiles(self, num_envs: int, size: int, dtype: str) -> Array:
        """Return zeros, shape (1, size, num_envs)."""
        import torch

        return torch.zeros((1, size, num_envs), dtype=getattr(torch, dtype), device=self._place)

    def copy(self, array: Array) -> Array:
        """Return a copy."""
        return array.clone()

    def read(self, array: Array, num_envs: int) -> Array:
        """Return a copy as rows, shape (num_envs, size)."""
        import torch

        return array[0].T.clone(memory_format=torch.contiguous_format)

    def write(self, array: Array, rows: Any, mask: Any = None) -> None:
        """Write rows of robots where `mask` is true."""
        import torch

        _, size, num_envs = array.shape
        rows = (
            rows if isinstance(rows, torch.Tensor) else np.array(rows, float)
        )  # torch warns of arrays it may not write
        values = torch.as_tensor(rows, dtype=array.dtype, device=array.device).expand(num_envs, size).T
        if mask is None:
            array[0] = values
        else:
            array[0] = torch.where(torch.as_tensor(mask, dtype=torch.bool, device=array.device), values, array[0])

    def rows(self, values: Any, dtype: str, shape: tuple[int, ...] = ()) -> Array:
        """Return values as a tensor, contiguous; broadcast to `shape`, if one is given."""
        import torch

        tensor = torch.as_tensor(values, dtype=getattr(torch, dtype), device=self._place)
        return (tensor.expand(shape) if shape else tensor).contiguous()

    def zeros(self, shape: tuple[int, ...], dtype: str) -> Array:
        """Return zeros."""
        import torch

        return torch.zeros(shape, dtype=getattr(torch, dtype), device=self._place)

    def empty(self, shape: tuple[int, ...], dtype: str) -> Array:
        """Return a tensor whose values are yet to be written."""
        import torch

        return torch.empty(shape, dtype=getattr(torch, dtype), device=self._place)

    def assign(self, array: Array, rows: Any, mask: Any = None) -> None:
        """Write rows where `mask` is true."""
        import torch

        new = torch.as_tensor(rows, dtype=array.dtype, device=array.device)
        chosen = None if mask is None else torch.as_tensor(mask, dtype=torch.bool, device=array.device)
        array[...] = new if chosen is None else torch.where(_beside(chosen, array.ndim), new, array)

    def host(self, array: Array) -> NDArray:
        """Return a copy in the memory of the CPU."""
        return array.cpu().numpy()

    def kernel(self, key: str, build: Build, dtype: str) -> Any:
        """Return the kernel of some stages."""
        from ce_gym.compile.cuda import load_cuda_kernel

        return load_cuda_kernel(key, build, dtype, self._gpu)


class Emulated(Cuda):
    """The GPU's tensors and sources on the CPU: for tests and comparisons where there is no GPU, and very slow."""

    def __init__(self) -> None:
        self.name, self._place = "emulated cuda", "cpu"

    def kernel(self, key: str, build: Build, dtype: str) -> Any:
        """Return the kernel of some stages, run by the CPU."""
        from ce_gym.compile.cuda import host_kernel

        return host_kernel(build, dtype)


def _beside(mask: Array, ndim: int) -> Array:
    """Return a mask of rows with a column for those of an array with two axes."""
    return mask[:, None] if ndim == 2 else mask


def device_named(device: str | Device) -> Device:
    """Return a device by name; one that is a device already stays as it is.

    Args:
        device: "cpu", "cuda", or "cuda:N" for another GPU than the first.

    Raises:
        ValueError: If there is no such device; one line.
    """
    if not isinstance(device, str):
        return device
    if device == "cpu":
        return Cpu()
    kind, _, number = device.partition(":")
    if kind != "cuda" or not (number.isdecimal() or (number == "" and ":" not in device)):
        raise ValueError(f"device={device!r}; expected 'cpu', 'cuda' or 'cuda:N'")
    return Cuda(int(number or 0))


def to_numpy(values: Any) -> NDArray:
    """Return numbers from anywhere as float64 in the CPU's memory."""
    return np.asarray(values.cpu() if hasattr(values, "cpu") else values, dtype=float)
