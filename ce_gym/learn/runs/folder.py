"""The folder of a training run: it has one owner, and a full disk does not end training."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import sys
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from ce_gym.compile.system import lock
from ce_gym.console import file_error
from ce_gym.files import ANY, check_output, is_forced, own

LOG = "progress.csv"
"""Name of the file of statistics in the folder of a run."""

LOCK = ".lock"
"""Name of the file that names the process that writes into a folder."""

FILES = ("policy.*", "checkpoints/policy_*", "model_*.pt", "events.out.tfevents.*")
"""Files of a run, apart from its log, which is written anew."""

HELD = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
"""Errors of the system for a lock that another process has."""


def make_folder(out: Path) -> None:
    """Make the folder of a run and check that files can be written.

    Raises:
        OSError: If they cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out) as file:
        file.write(b"room")


def has_run(folder: Path) -> bool:
    """Return whether a folder has a run that has made an update."""
    return (folder / LOG).exists() or any(folder.glob("policy.*")) or any(folder.glob("checkpoint*"))


def unused_folder(folder: Path, several: bool = False) -> Path:
    """Return a folder, or its name with the first number from 2 on, that has no run and no owner.

    Args:
        folder: The folder.
        several: Whether it is for several runs in subfolders, which go on in the folder that has them.
    """
    for number in count(1):
        candidate = folder.with_name(folder.name + (f"-{number}" if number > 1 else ""))
        places = [candidate, *([] if several else [log.parent for log in candidate.glob(f"**/{LOG}")])]
        if not any(has_run(place) or (place / LOCK).exists() for place in places):
            return candidate
    raise AssertionError("unreachable")


def run_of(policy: Path) -> Path:
    """Return the folder of the run of a policy, which may be a checkpoint."""
    return policy.parent.parent if policy.parent.name == "checkpoints" else policy.parent


def check_unused(out: Path, resume: Path | None = None) -> None:
    """Check that a folder has no run, or the run that continues, or that the command has `--force`.

    Raises:
        OSError: If it has another run.
    """
    if has_run(out) and not is_forced() and not _continues(out, resume):
        expected = "expected --resume to continue it, --force to replace it, or another folder"
        raise FileExistsError(errno.EEXIST, f"has a run already; {expected}", str(out))


def _continues(out: Path, resume: Path | None) -> bool:
    return resume is not None and run_of(resume).resolve() == out.resolve()


@contextlib.contextmanager
def run_folder(out: Path, resume: Path | None = None) -> Iterator[list[Path]]:
    """Context in which this process alone writes a run into a folder, which is made.

    Args:
        out: The folder.
        resume: Policy that the run continues.

    Yields:
        The files of an earlier run that the first update replaces; none if the run goes on.

    Raises:
        OSError: If another process writes into the folder, or the folder has another run, or it cannot be written.
    """
    make_folder(out)
    with _locked(out / LOCK):
        check_unused(out, resume)
        if _continues(out, resume):
            own(out)
            yield []
        else:
            yield [file for pattern in FILES for file in out.glob(pattern)]


def remove(files: list[Path]) -> None:
    """Remove the files of an earlier run.

    Raises:
        OSError: If the command has read a file.
    """
    for file in files:
        check_output(file, ANY)
    while files:
        files.pop().unlink(missing_ok=True)


@contextlib.contextmanager
def _locked(file: Path) -> Iterator[None]:
    """Context in which this process has a lock file; the system frees the lock of a process that has ended.

    Raises:
        OSError: If another process has it.
    """
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
    owner = os.read(descriptor, 200).decode(errors="replace")
    try:
        lock(descriptor)
        is_free = os.path.samestat(os.fstat(descriptor), file.stat())  # the last owner may have removed the file
    except OSError as error:  # a file system without locks, or the file has just been removed
        is_free = error.errno not in (*HELD, errno.ENOENT) and _has_ended(owner)
    if not is_free:
        os.close(descriptor)
        problem = f"{owner or 'another process'} writes into this folder; expected another folder"
        raise FileExistsError(errno.EEXIST, problem, str(file.parent))
    try:
        os.ftruncate(descriptor, 0)
        os.lseek(descriptor, 0, os.SEEK_SET)
        os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        if sys.platform == "win32":  # where an open file cannot be removed
            os.close(descriptor)
        file.unlink(missing_ok=True)
        if sys.platform != "win32":
            os.close(descriptor)


def _has_ended(owner: str) -> bool:
    """Return whether the process in the text of a lock file has ended; False if that cannot be known."""
    match = re.fullmatch(rf"process (\d+) on {re.escape(socket.gethostname())}", owner)
    if not owner or (match and sys.platform == "win32"):
        return True
    try:
        if match:
            os.kill(int(match[1]), 0)
    except ProcessLookupError:
        return True
    except OSError:
        pass
    return False


@contextlib.contextmanager
def continue_if_full() -> Iterator[None]:
    """Print a warning instead of raising an error if a file cannot be written, so that training continues."""
    try:
        yield
    except OSError as error:
        print(f"warning: {file_error(error)}; training continues", file=sys.stderr, flush=True)
