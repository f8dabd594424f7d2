"""Worker threads shared by all kernels, and memory lent to one thread at a time. Knows nothing of kernels."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ce_gym.compile.arrays import aligned_zeros

_pool: ThreadPoolExecutor | None = None
_lock = threading.Lock()


class MemoryPool:
    """Aligned blocks of equal length, made when first needed and kept for the next user.

    `take` and `give` may be called from any thread: a list's pop and append are atomic.
    """

    def __init__(self, n_words: int):
        self._n_words = max(n_words, 1)
        self._free: list[tuple[np.ndarray, int]] = []

    def take(self) -> tuple[np.ndarray, int]:
        """A block as 64-bit integers, shape (n_words,), and its address."""
        try:
            return self._free.pop()
        except IndexError:
            block = aligned_zeros(self._n_words, np.int64)
            return block, block.ctypes.data

    def give(self, block: tuple[np.ndarray, int]) -> None:
        """Back to the pool."""
        self._free.append(block)


def run_chunks(work: Callable[[int, int], None], count: int, num_threads: int) -> None:
    """Call `work(first, end)` on contiguous parts of range(count), one part per thread, the first in this one."""
    num_threads = min(num_threads, count)
    if num_threads <= 1:
        work(0, count)
        return
    edges = [count * i // num_threads for i in range(num_threads + 1)]
    others = [_threads().submit(work, *edges[i : i + 2]) for i in range(1, num_threads)]
    try:
        work(0, edges[1])
    finally:  # nobody may still write to the caller's arrays when this returns or raises
        for other in others:
            other.result()


def _threads() -> ThreadPoolExecutor:
    """The workers, started when first needed."""
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max(1, (os.cpu_count() or 1) - 1), "ce_gym")
        return _pool


def _after_fork() -> None:
    """A forked child has none of its parent's threads: it starts its own."""
    global _pool, _lock
    _pool, _lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
