"""Kernels of programs in CUDA C: emitted by `source`, compiled by `nvrtc`, launched by `gpu`, or run by `host`.

Importing this package imports neither torch nor the packages of NVIDIA.
"""

from ce_gym.compile.cuda.kernel import CudaKernel
from ce_gym.compile.cuda.loading import host_kernel, load_cuda_kernel
from ce_gym.compile.cuda.nvrtc import CudaUnavailable

__all__ = ["CudaKernel", "CudaUnavailable", "host_kernel", "load_cuda_kernel"]
