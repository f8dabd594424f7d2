"""The folder of compiled kernels: one file per kernel, checked by a digest before its code is executed.

The digest guards against damage, `ce_gym.compile.private_files` guards against other users. A kernel that cannot be
read is compiled again. A kernel that cannot be written is used without being cached.
"""

import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from ce_gym.compile.private_files import prepare_folder, read_file
from ce_gym.compile.system import user_number

FOLDER_VARIABLE = "CE_GYM_CACHE_DIR"
DIGEST_BYTES = 32
LONG = 5.0
"""Compile time from which an estimate is printed [s]."""


def cache_folder() -> Path | None:
    """Return the folder of kernels: $CE_GYM_CACHE_DIR or the user's cache folder; else a temporary one; else None.

    Folders that cannot be written, or that other users could write, are skipped with one line to the user.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    wanted = os.environ.get(FOLDER_VARIABLE) or os.path.join(home, "ce_gym")
    for place in (wanted, os.path.join(tempfile.gettempdir(), f"ce_gym-{user_number() or 0}")):
        folder = Path(os.path.realpath(place))  # links are followed here only; their target is checked
        try:
            prepare_folder(folder)
        except OSError as problem:
            _tell_once(f"ce_gym: no kernels are kept in {folder}: {problem.strerror or problem}")
        else:
            return folder
    return None


def read_entry(folder: Path | None, name: str) -> tuple[dict, bytes] | None:
    """Return an entry of `write_entry`; None if the file is missing, damaged, or may come from another user."""
    if folder is None:
        return None
    try:
        content = read_file(_path(folder, name))
    except OSError:
        return None
    digest, payload = content[:DIGEST_BYTES], content[DIGEST_BYTES:]
    if digest != _digest(name, payload):
        return None
    record, _, code = payload.partition(b"\n")
    return json.loads(record), code


def write_entry(folder: Path | None, name: str, record: dict, code: bytes) -> None:
    """Write a kernel, or tell the user once why that failed.

    Args:
        folder: of `cache_folder`.
        name: of the kernel.
        record: JSON data.
        code: machine code.
    """
    if folder is None:
        return
    payload = json.dumps(record).encode() + b"\n" + code
    try:
        _replace(_path(folder, name), _digest(name, payload) + payload)
    except OSError as problem:
        _tell_once(f"ce_gym: kernels compiled now are not kept in {folder}: {problem.strerror or problem}")


def read_or_make(folder: Path | None, name: str, make: Callable[[], tuple[dict, bytes]]) -> tuple[dict, bytes]:
    """Return an entry of the cache; if there is none, make and write it."""
    entry = read_entry(folder, name)
    if entry is None:
        entry = make()
        write_entry(folder, name, *entry)
    return entry


def _path(folder: Path, name: str) -> Path:
    return folder / f"{name}.kernel"


def _digest(name: str, payload: bytes) -> bytes:
    """Return the digest of name and content: the name, so that no file is mistaken for another kernel."""
    return hashlib.sha256(name.encode() + b"\n" + payload).digest()


def _replace(path: Path, content: bytes) -> None:
    """Write a file atomically: a reader sees the old or the new content, and no temporary file stays."""
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.stem)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise


@cache
def _tell_once(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


@contextmanager
def announced(what: str, folder: Path | None, started: float, expected: float = 0.0) -> Iterator[None]:
    """Print that a kernel is being compiled, an estimate if that is long, and, in the end, how long that took.

    Args:
        what: name of the kernel.
        folder: of `cache_folder`.
        started: start of the measured time [s], of `time.perf_counter`.
        expected: estimate of that time on an idle machine [s]; 0 if unknown.
    """
    kept = "not kept" if folder is None else f"once; cached in {folder}"
    estimate = f", about {expected:.0f} s" if expected > LONG else ""
    print(f"ce_gym: compiling {what}, {kept}{estimate} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print(f" {time.perf_counter() - started:.1f} s", file=sys.stderr, flush=True)
