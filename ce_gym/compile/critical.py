"""`CriticalSection`: work of one thread at a time that Ctrl-C does not interrupt.

Python calls signal handlers in the main thread, between any two instructions. The handler of SIGINT raises
KeyboardInterrupt. While the main thread is in a section, a substitute only records the signal. The original handler is
called at the end of the section or at an interruption point. Handlers of other signals are not replaced.
"""

from __future__ import annotations

import threading

# The functions of `signal` convert arguments and results to enums, which takes ten times as long as the call itself.
from _signal import getsignal, signal  # pyright: ignore[reportMissingImports]
from collections.abc import Callable
from signal import SIGINT, raise_signal
from typing import Any

from ce_gym.compile.system import at_fork

_noted = False
"""Whether SIGINT has arrived in the section. Only the main thread uses this variable and the next."""
_handler: Callable[[int, Any], Any] | None = None
"""The handler of SIGINT outside of all sections."""


class CriticalSection:
    """A context for one thread at a time in which SIGINT is deferred; sections may be nested.

    Args:
        name: owner of the section, for the error.

    Raises:
        RuntimeError: if another thread is in the section; one line.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._holds = False

    def __enter__(self) -> CriticalSection:
        holds = _hold()
        if not self._lock.acquire(blocking=False):
            if holds:
                _release()
            raise RuntimeError(f"{self._name}: called during another call, expected one call at a time")
        self._holds = holds
        return self

    def __exit__(self, *error: object) -> None:
        holds = self._holds  # read before another thread can enter
        self._lock.release()
        if holds:
            _release()

    def __reduce__(self) -> tuple[type[CriticalSection], tuple[str]]:
        return CriticalSection, (self._name,)  # a copy of the guarded object has its own section

    def interruption_point(self) -> None:
        """Call the handler of SIGINT if the signal has arrived; an exception must be safe here. No effect if nested."""
        global _noted
        if self._holds and _noted and _handler is not None:
            _noted = False
            _handler(SIGINT, None)


def _note(number: int, frame: object) -> None:
    global _noted
    _noted = True


def _hold() -> bool:
    """Defer SIGINT, and return whether this call did so and not an outer section.

    If KeyboardInterrupt is raised in here, SIGINT is not deferred yet.
    """
    global _noted, _handler
    if threading.current_thread() is not threading.main_thread():  # handlers do not run here
        return False
    handler = getsignal(SIGINT)
    if handler is _note or not callable(handler):  # deferred already; ignored, or fatal
        return False
    _noted, _handler = False, handler
    signal(SIGINT, _note)
    return True


def _release() -> None:
    """Restore the handler of SIGINT, and raise a deferred signal."""
    signal(SIGINT, _handler)
    if _noted:
        raise_signal(SIGINT)


def _after_fork() -> None:
    """Restore the handler in a child that another thread forked while the main thread was in a section."""
    if getsignal(SIGINT) is _note:
        signal(SIGINT, _handler)


at_fork(in_child=_after_fork)
