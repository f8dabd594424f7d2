"""Report Ctrl-C during imports in one line. Programs import this file first.

Importing torch takes seconds, and `console.run` has not started by then.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType


def _report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print one line for Ctrl-C, and the usual traceback for other errors."""
    if issubclass(kind, KeyboardInterrupt):
        print(f"{Path(sys.argv[0]).name}: interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


if Path(sys.argv[0]).resolve().parent == Path(__file__).resolve().parent:  # a program of this folder, not a test
    sys.excepthook = _report
