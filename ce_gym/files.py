"""Write the files of commands: beside the target, then renamed, and never over a file that the command has read.

`guarded` is the context of a command. In it, a file that the command has read is not replaced, whoever has read it, and
a file of another kind only with `--force`. Python programs without this context replace files, as usual.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

HEAD = 128
"""Bytes at the beginning of a file that tell its kind."""


class Kind(NamedTuple):
    """A kind of file: a name for messages, and a mark in the first `HEAD` bytes; None if no file can be told by it."""

    name: str
    mark: bytes | None


ANY = Kind("a file", b"")
"""The kind of files in a folder that has an owner."""
CARD = Kind("a card or a report", b"# ")
ESTIMATES = Kind("a robot file of `identify`", b"# Identified from")
LOG = Kind("a log", None)
MAP = Kind("a height map", None)
ONNX = Kind("an ONNX file of ce_gym", b"ce_gym")
PAGE = Kind("a page of ce_gym", b"<!-- ce_gym: ")
PICTURE = Kind("a figure", b"Matplotlib")
POLICY = Kind("a policy", b"record.npy")
ROBOT = Kind("a robot file", None)
ROLLOUT = Kind("a rollout", b"header.npy")
VIDEOS = {
    ".mp4": Kind("an MP4 video", b"ftyp"),
    ".webm": Kind("a WebM video", b"webm"),
    ".gif": Kind("a GIF", b"GIF8"),
}


def json_kind(text: str) -> Kind:
    """Return the kind of JSON files that begin with the same key as a text."""
    return Kind("a result of this command", text.partition(":")[0].encode())


@dataclass
class Guard:
    """What a command may not replace.

    Attributes:
        force: Whether it may replace files of other kinds.
        read: Files that it has read.
        owned: Folders whose files it may replace although it has read them.
    """

    force: bool = False
    read: set[str] = field(default_factory=set)
    owned: list[Path] = field(default_factory=list)


_guard: Guard | None = None


@contextlib.contextmanager
def guarded() -> Iterator[Guard]:
    """Context of a command, in which all files that Python opens for reading are protected."""
    global _guard
    outer, _guard = _guard, Guard()
    _listen()
    try:
        yield _guard
    finally:
        _guard = outer


@cache
def _listen() -> None:
    """Note all files that are opened from now on; Python calls the function for each of its audit events."""
    sys.addaudithook(_note)


def _note(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and _guard is not None:
        path, _, flags = arguments
        if isinstance(path, str | bytes) and flags & (os.O_WRONLY | os.O_RDWR) != os.O_WRONLY:
            _guard.read.add(os.path.abspath(os.fsdecode(path)))


def is_forced() -> bool:
    """Return whether the command has `--force`, or there is no command."""
    return _guard is None or _guard.force


def set_force(force: bool) -> None:
    """Set whether the command may replace files of other kinds."""
    if _guard is not None:
        _guard.force = force


def own(folder: Path) -> None:
    """Let the command replace files of a folder that it has read: the run that it continues."""
    if _guard is not None:
        _guard.owned.append(folder.resolve())


def check_output(path: Path, kind: Kind) -> None:
    """Check that a command may write a file, before it computes the content.

    Raises:
        OSError: The path is a folder, or the command has read the file, or the file is of another kind.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder; expected the name of a file", str(path))
    if _guard is None or not path.is_file():
        return
    if _is_read(path) and not any(path.resolve().is_relative_to(folder) for folder in _guard.owned):
        raise FileExistsError(errno.EEXIST, "the command reads this file; expected another name", str(path))
    if not (_guard.force or _is_of(path, kind)):
        expected = "expected another name, or --force to replace it"
        reason = "exists already" if kind.mark is None else f"exists already and is not {kind.name}"
        raise FileExistsError(errno.EEXIST, f"{reason}; {expected}", str(path))


def _is_read(path: Path) -> bool:
    """Return whether the command has read a file, perhaps by another name."""
    target, read = path.stat(), _guard.read if _guard else ()
    for name in tuple(read):
        with contextlib.suppress(OSError, ValueError):
            if os.path.samestat(os.stat(name), target):
                return True
    return False


def _is_of(path: Path, kind: Kind) -> bool:
    with path.open("rb") as file:
        head = file.read(HEAD)
    if _guard is not None:
        _guard.read.discard(os.path.abspath(path))  # looking at the kind does not count
    return kind.mark is not None and (kind.mark in head or not head)


@contextlib.contextmanager
def written(path: str | os.PathLike[str], kind: Kind) -> Iterator[Path]:
    """Context that gives the name of a temporary file beside a path, and renames the file at the end.

    A device or a pipe is written directly.

    Raises:
        OSError: The file cannot be written; see `check_output`. An existing file is unchanged.
    """
    path = Path(path)
    check_output(path, kind)
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        yield target
        return
    if not target.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "no such folder; expected a name in an existing one", str(path))
    temporary = target.with_name(f".{os.getpid()}.{target.name}")
    try:
        yield temporary
        temporary.replace(target)
    except OSError as error:
        error.filename, error.filename2 = str(path), None  # not the name of the temporary file
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_file(path: str | os.PathLike[str], content: bytes | str, kind: Kind) -> None:
    """Write a file as a whole; see `written`."""
    with written(path, kind) as temporary:
        temporary.write_bytes(content.encode(errors="replace") if isinstance(content, str) else content)


def write_whole(files: Mapping[Path, bytes]) -> None:
    """Write several files of a folder that has an owner; none is replaced before all are on the disk.

    Raises:
        OSError: A file cannot be written; see `check_output`.
    """
    with contextlib.ExitStack() as stack:
        for file, content in reversed(list(files.items())):  # the stack renames in the opposite order
            file.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(written(file, ANY)).write_bytes(content)
