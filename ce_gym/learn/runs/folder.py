"""Write the files of a training run: completely or not at all; a full disk does not end training."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from ce_gym.console import file_error


def make_folder(out: Path) -> None:
    """Make the folder of a run and check that files can be written.

    Raises:
        OSError: If they cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out) as file:
        file.write(b"room")


def write_whole(files: Mapping[Path, bytes]) -> None:
    """Write several files; existing files are replaced only when all new ones are on the disk.

    Raises:
        OSError: If they cannot be written; then all files are unchanged.
    """
    temporaries = {file.with_name(f".{file.name}"): file for file in files}
    try:
        for temporary, file in temporaries.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(files[file])
        for temporary, file in temporaries.items():
            temporary.replace(file)
    finally:
        for temporary in temporaries:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def continue_if_full() -> Iterator[None]:
    """Print a warning instead of raising an error if a file cannot be written, so that training continues."""
    try:
        yield
    except OSError as error:
        print(f"warning: {file_error(error)}; training continues", file=sys.stderr, flush=True)
