"""Worker threads shared by all kernels, and memory blocks that one thread uses at a time."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from ce_gym.compile.arrays import aligned_zeros
from ce_gym.compile.critical import CriticalSection
from ce_gym.compile.system import at_fork

_pool: ThreadPoolExecutor | None = None
_lock = threading.Lock()


class MemoryPool:
    """Aligned blocks of equal length, allocated on demand and reused.

    A block that is not given back because of an exception is freed. `take` and `give` may be called from any thread,
    because pop and append of a list are atomic.
    """

    def __init__(self, n_words: int):
        self._n_words = max(n_words, 1)
        self._free: list[tuple[np.ndarray, int]] = []

    def take(self) -> tuple[np.ndarray, int]:
        """Return a block of 64-bit integers, shape (n_words,), and its address."""
        try:
            return self._free.pop()
        except IndexError:
            block = aligned_zeros(self._n_words, np.int64)
            return block, block.ctypes.data

    def give(self, block: tuple[np.ndarray, int]) -> None:
        """Return a block to the pool."""
        self._free.append(block)


def run_chunks(work: Callable[[int, int], None], count: int, num_threads: int) -> None:
    """Call `work(first, end)` on contiguous parts of range(count), one part per thread, the first part in this thread.

    When this function returns or raises, no part is running; Ctrl-C waits for running parts. This thread also executes
    parts that no other thread has started by then, because all threads are busy with other calls.
    """
    num_threads = min(num_threads, count)
    if num_threads <= 1:
        work(0, count)
        return
    parts = list(pairwise(count * i // num_threads for i in range(num_threads + 1)))
    begun: list[tuple[Future[None], tuple[int, int]]] = []
    with CriticalSection("run_chunks"):
        try:
            for part in parts[1:]:
                begun.append((_threads().submit(work, *part), part))
            work(*parts[0])
            for other, part in begun:
                if other.cancel():
                    work(*part)
        finally:
            errors = [other.exception() for other, _ in begun if not other.cancel()]
    for error in errors:
        if error is not None:
            raise error


def _threads() -> ThreadPoolExecutor:
    """Return the workers, which are started at their first use."""
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max(1, (os.cpu_count() or 1) - 1), "ce_gym")
        return _pool


def _after_fork() -> None:
    """Let a forked child start its own threads, because threads of the parent do not exist there."""
    global _pool, _lock
    _pool, _lock = None, threading.Lock()


at_fork(in_child=_after_fork)
