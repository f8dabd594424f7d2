"""Devices that hold the state of robots: numpy arrays and kernels of the CPU, or torch tensors and kernels of a GPU.

A device makes, reads and writes state arrays and loads kernels. A state array is in tiles, the layout of kernels (see
`ce_gym.sim.tiles`; a GPU has one tile with a lane for each robot), or plain, with one robot per row. torch is imported
only for a GPU.
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
    """Arrays and kernels of a device.

    Attributes:
        name: "cpu", "cuda", "cuda:1" and so on.
        fuses: Whether consecutive stages are one kernel.
        joint_space: Whether robots with short branches are solved in joint space, see `Scene`. On a GPU its values
            exceed the registers.
    """

    name: str
    fuses: bool
    joint_space: bool

    def tiles(self, num_envs: int, size: int, dtype: str) -> Array:
        """Return zeros in tiles, `size` values of each robot."""
        ...

    def zeros(self, shape: tuple[int, ...], dtype: str) -> Array:
        """Return zeros as a plain array."""
        ...

    def empty(self, shape: tuple[int, ...], dtype: str) -> Array:
        """Return an uninitialised plain array."""
        ...

    def rows(self, values: Any, dtype: str, shape: tuple[int, ...] = ()) -> Array:
        """Return values as a plain array of this device; if `shape` is given, broadcast to it and contiguous."""
        ...

    def copy(self, array: Array) -> Array:
        """Return a copy of an array, in tiles or plain."""
        ...

    def read(self, array: Array, num_envs: int) -> Array:
        """Return a copy of a state array as a plain one, shape (num_envs, size)."""
        ...

    def write(self, array: Array, rows: Any, mask: Any = None) -> None:
        """Write rows that broadcast to (num_envs, size) into a state array, where `mask` is true."""
        ...

    def host(self, array: Array) -> NDArray:
        """Return a plain array in the memory of the CPU, with the same dtype."""
        ...

    def kernel(self, key: str, build: Build, dtype: str) -> Any:
        """Return the kernel of some stages, see `ce_gym.compile.load_kernel`."""
        ...


class Cpu:
    """numpy arrays and the kernels of `ce_gym.compile`, one stage each.

    Args:
        joint_space: See `Device`; False computes the same bits as a GPU.
    """

    name, fuses = "cpu", False
    tiles = staticmethod(host_tiles.tiles)

    def __init__(self, joint_space: bool = True) -> None:
        self.joint_space = joint_space

    def zeros(self, shape: tuple[int, ...], dtype: str) -> NDArray:
        return np.zeros(shape, dtype)

    def empty(self, shape: tuple[int, ...], dtype: str) -> NDArray:
        return np.empty(shape, dtype)

    def rows(self, values: Any, dtype: str, shape: tuple[int, ...] = ()) -> NDArray:
        array = np.asarray(values, dtype)
        return np.ascontiguousarray(np.broadcast_to(array, shape)) if shape else array

    def copy(self, array: Array) -> NDArray:
        return array.copy()

    def read(self, array: Array, num_envs: int) -> NDArray:
        return host_tiles.read_rows(array, num_envs) if array.ndim == 3 else array.copy()

    def write(self, array: Array, rows: Any, mask: Any = None) -> None:
        if array.ndim == 3:
            host_tiles.write_rows(array, rows, mask)
        else:
            array[...] = rows if mask is None else np.where(_beside(mask, array.ndim), rows, array)

    def host(self, array: Array) -> NDArray:
        return array

    def kernel(self, key: str, build: Build, dtype: str) -> Any:
        return load_kernel(key, lambda: build()[0], dtype)


class Cuda:
    """torch tensors and the kernels of `ce_gym.compile.cuda`.

    Args:
        gpu: Number of the GPU.

    Raises:
        CudaUnavailable: If there is no such GPU, or a package is missing; one line.
    """

    fuses, joint_space = True, False

    def __init__(self, gpu: int = 0) -> None:
        from ce_gym.compile.cuda.gpu import architecture

        architecture(gpu)
        self.name = self._place = f"cuda:{gpu}"
        self._gpu = gpu

    def tiles(self, num_envs: int, size: int, dtype: str) -> Array:
        return self.zeros((1, size, num_envs), dtype)

    def zeros(self, shape: tuple[int, ...], dtype: str) -> Array:
        return _torch().zeros(shape, dtype=getattr(_torch(), dtype), device=self._place)

    def empty(self, shape: tuple[int, ...], dtype: str) -> Array:
        return _torch().empty(shape, dtype=getattr(_torch(), dtype), device=self._place)

    def rows(self, values: Any, dtype: str, shape: tuple[int, ...] = ()) -> Array:
        tensor = _torch().as_tensor(values, dtype=getattr(_torch(), dtype), device=self._place)
        return (tensor.expand(shape) if shape else tensor).contiguous()

    def copy(self, array: Array) -> Array:
        return array.clone()

    def read(self, array: Array, num_envs: int) -> Array:
        return array[0].T.clone(memory_format=_torch().contiguous_format) if array.ndim == 3 else array.clone()

    def write(self, array: Array, rows: Any, mask: Any = None) -> None:
        torch, target = _torch(), array[0].T if array.ndim == 3 else array
        if not isinstance(rows, torch.Tensor):
            rows = np.array(rows)  # torch warns of arrays it may not write
        new = torch.as_tensor(rows, dtype=array.dtype, device=array.device)
        if mask is not None:
            chosen = torch.as_tensor(mask, dtype=torch.bool, device=array.device)
            new = torch.where(_beside(chosen, target.ndim), new, target)
        target[...] = new

    def host(self, array: Array) -> NDArray:
        return array.cpu().numpy()

    def kernel(self, key: str, build: Build, dtype: str) -> Any:
        from ce_gym.compile.cuda import load_cuda_kernel

        return load_cuda_kernel(key, build, dtype, self._gpu)


class Emulated(Cuda):
    """Tensors and sources of the GPU on the CPU: for tests and comparisons without a GPU; very slow."""

    def __init__(self) -> None:
        self.name, self._place = "emulated cuda", "cpu"

    def kernel(self, key: str, build: Build, dtype: str) -> Any:
        from ce_gym.compile.cuda import host_kernel

        return host_kernel(build, dtype)


def _torch() -> Any:
    import torch

    return torch


def _beside(mask: Array, ndim: int) -> Array:
    """Return a mask of rows that broadcasts to an array with `ndim` axes."""
    return mask[:, None] if ndim == 2 else mask


def device_named(device: str | Device) -> Device:
    """Return a device by name, or the given device.

    Args:
        device: "cpu", "cuda" or "cuda:N".

    Raises:
        ValueError: If there is no such device; one line.
    """
    if isinstance(device, Cpu | Cuda):
        return device
    if not isinstance(device, str):
        raise ValueError(f"device={device!r}; expected 'cpu', 'cuda' or 'cuda:N'")
    if device == "cpu":
        return Cpu()
    kind, _, number = device.partition(":")
    if kind != "cuda" or not (number.isdecimal() or (number == "" and ":" not in device)):
        raise ValueError(f"device={device!r}; expected 'cpu', 'cuda' or 'cuda:N'")
    return Cuda(int(number or 0))


def to_numpy(values: Any) -> NDArray:
    """Return numbers of any kind, such as a torch tensor, as float64 in the memory of the CPU."""
    return np.asarray(values.cpu() if hasattr(values, "cpu") else values, dtype=float)
