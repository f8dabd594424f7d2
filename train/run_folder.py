"""The folder of a training run: files are written whole or not at all, and a full disk does not end training."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from console import said


def make_folder(out: Path) -> None:
    """Make the folder of a run, and see that it can be written to, before any time is spent.

    Raises:
        OSError: If it cannot.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out) as file:
        file.write(b"room")


def write_whole(files: Mapping[Path, bytes]) -> None:
    """Write files that belong together: each is replaced only when all are on the disk.

    Raises:
        OSError: If they cannot be written; then nothing has changed.
    """
    fresh = {file.with_name(f".{file.name}"): file for file in files}
    try:
        for temporary, file in fresh.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(files[file])
        for temporary, file in fresh.items():
            temporary.replace(file)
    finally:
        for temporary in fresh:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def going_on() -> Iterator[None]:
    """Do something that training can go on without; should a disk be full, that is one line."""
    try:
        yield
    except OSError as error:
        print(f"warning: {said(error)}; training goes on", file=sys.stderr, flush=True)


def save_somewhere(save: Callable[[Path], Path], out: Path) -> Path:
    """Save a policy into a folder, or into a temporary one if that is full or gone; return what `save` returns.

    Raises:
        OSError: If that cannot be written either.
    """
    try:
        return save(out)
    except OSError as error:
        elsewhere = Path(tempfile.mkdtemp(prefix="ce_gym-"))
        print(f"warning: {said(error)}; saving to {elsewhere}", file=sys.stderr, flush=True)
        return save(elsewhere)
