"""Ctrl-C while a program is still importing what it needs: one line. Programs import this first of all.

Importing torch takes seconds; `console.run` has not begun then.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType


def _say(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print what ended the program: of Ctrl-C one line, as usual of everything else."""
    if issubclass(kind, KeyboardInterrupt):
        print(f"{Path(sys.argv[0]).name}: interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


if Path(sys.argv[0]).resolve().parent == Path(__file__).resolve().parent:  # a program of ours, not one that tests it
    sys.excepthook = _say
