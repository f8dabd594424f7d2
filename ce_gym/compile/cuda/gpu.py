# pyright: reportAttributeAccessIssue=false
"""Detection of a GPU, and launches of machine code on it.

Memory and streams come from torch, so that operations of torch before and after a launch stay in order. `cuda.core`
launches. The first line turns off checks of types, because compiled modules have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from ce_gym.compile.cuda.nvrtc import CudaUnavailable, compiler_version
from ce_gym.compile.cuda.source import BLOCK, ENTRY


@cache
def architecture(gpu: int = 0) -> str:
    """Return the architecture of a GPU, such as `sm_90`.

    Raises:
        CudaUnavailable: If there is no such GPU, or a package is missing; one line.
    """
    try:
        import torch
    except ImportError:
        raise CudaUnavailable(
            "device='cuda': torch was not found; expected the extra gpu: pip install 'ce_gym[gpu]'"
        ) from None
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if gpu >= count:
        seen = f"{count} NVIDIA GPUs" if count else "no NVIDIA GPU"
        raise CudaUnavailable(f"device='cuda:{gpu}': torch {torch.__version__} sees {seen}; expected device='cpu'")
    compiler_version()
    major, minor = torch.cuda.get_device_capability(gpu)
    return f"sm_{major}{minor}"


class _Stream:
    """The current stream of torch, in the form that `cuda.core` takes."""

    def __init__(self, handle: int):
        self._handle = handle

    def __cuda_stream__(self) -> tuple[int, int]:
        return 0, self._handle


class GpuLauncher:
    """One kernel on one GPU.

    Args:
        code: machine code for the architecture of the GPU.
        threads: threads of a robot.
        gpu: number of the GPU.
    """

    def __init__(self, code: bytes, threads: int, gpu: int = 0):
        import torch
        from cuda.core import Device, LaunchConfig, ObjectCode, launch

        torch.cuda.init()
        self._device, self._launch, self._config, self._torch = Device(gpu), launch, LaunchConfig, torch
        self._device.set_current()
        self._kernel = ObjectCode.from_cubin(code).get_kernel(ENTRY)
        self._gpu, self._threads = gpu, threads

    def __call__(self, addresses: Sequence[int], numbers: Sequence[int], count: int) -> None:
        """Launch on the current stream of torch, with the threads of each robot."""
        stream = _Stream(self._torch.cuda.current_stream(self._gpu).cuda_stream)
        self._device.set_current()
        config = self._config(grid=-(-count * self._threads // BLOCK), block=BLOCK)
        self._launch(stream, config, self._kernel, *addresses, *map(np.int32, (*numbers, count)))
