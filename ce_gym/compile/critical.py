"""`CriticalSection`: work that one thread does at a time and that Ctrl-C does not cut in two.

Python calls the handler of a signal in the main thread, between any two instructions there; that of SIGINT raises
KeyboardInterrupt. While the main thread is in a section, the handler is one that takes a note; the one before is called
when the section ends, or earlier where the section says so. A handler of another signal that raises is not held back.
"""

from __future__ import annotations

import threading

# The functions of `signal` turn what they take and return into enums, for ten times what the call itself costs.
from _signal import getsignal, signal  # pyright: ignore[reportMissingImports]
from collections.abc import Callable
from signal import SIGINT, raise_signal
from typing import Any

from ce_gym.compile.system import at_fork

_noted = False
"""Whether SIGINT has come since it was held back. This and the next belong to the main thread alone."""
_handler: Callable[[int, Any], Any] | None = None
"""What is called for SIGINT outside of all sections."""


class CriticalSection:
    """Entered by `with`, by one thread at a time; SIGINT is held back inside. May be entered inside another one.

    Args:
        name: whose section it is, for the error.

    Raises:
        RuntimeError: if it is entered while somebody is inside; one line.
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
        holds = self._holds  # read while nobody else can be inside
        self._lock.release()
        if holds:
            _release()

    def __reduce__(self) -> tuple[type[CriticalSection], tuple[str]]:
        return CriticalSection, (self._name,)  # a copy of what it guards has a section of its own

    def interruption_point(self) -> None:
        """Call the handler of SIGINT if that has come: where an exception is in order. Not inside another section."""
        global _noted
        if self._holds and _noted and _handler is not None:
            _noted = False
            _handler(SIGINT, None)


def _note(number: int, frame: object) -> None:
    global _noted
    _noted = True


def _hold() -> bool:
    """Hold SIGINT back; whether it was this call that did, and not a section around it.

    Where an interruption raises, nothing is held back yet.
    """
    global _noted, _handler
    if threading.current_thread() is not threading.main_thread():  # handlers do not run here
        return False
    handler = getsignal(SIGINT)
    if handler is _note or not callable(handler):  # held back already; ignored, or the end of the process
        return False
    _noted, _handler = False, handler
    signal(SIGINT, _note)
    return True


def _release() -> None:
    """Have SIGINT handled as before, the one that was held back first."""
    signal(SIGINT, _handler)
    if _noted:
        raise_signal(SIGINT)


def _after_fork() -> None:
    """A child forked by another thread while the main one was in a section has no section to end."""
    if getsignal(SIGINT) is _note:
        signal(SIGINT, _handler)


at_fork(in_child=_after_fork)
