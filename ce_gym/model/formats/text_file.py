"""The text of a robot file: only regular files of limited size, so that reading always ends."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ce_gym.model.errors import RobotError

LARGEST_FILE = 4 * 2**20
"""Largest robot file [bytes]; the largest of the package has 50 kB."""


def read_text(path: Path, kind: str, largest: int = LARGEST_FILE) -> str:
    """Return the text of a file.

    Args:
        path: The file.
        kind: Kind of the file for messages, such as "a YAML file".
        largest: Largest number of bytes.

    Raises:
        RobotError: The file is missing, not a regular file (a folder, a device, a pipe), too large, or not UTF-8.
    """
    data = read_bytes(path, kind, largest)
    try:
        return data.decode("utf-8").replace("\r\n", "\n")
    except ValueError as error:
        raise _unreadable(path, kind, error) from None


def read_bytes(path: Path, kind: str, largest: int = LARGEST_FILE) -> bytes:
    """Return the content of a file; see `read_text`.

    Raises:
        RobotError: The file is missing, not a regular file, or too large.
    """
    try:
        return _read(path, kind, largest)
    except RobotError:
        raise
    except (OSError, ValueError) as error:
        raise _unreadable(path, kind, error) from None


def _unreadable(path: Path, kind: str, error: Exception) -> RobotError:
    return RobotError(f"{path}: cannot be read: expected {kind} ({one_line(error)})")


def _read(path: Path, kind: str, largest: int) -> bytes:
    """Read a file without waiting for the writer of a pipe."""
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
    descriptor = os.open(path, flags)
    try:
        check_regular(str(path), os.fstat(descriptor), kind, largest)
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            data = file.read(largest + 1)
    finally:
        os.close(descriptor)
    if len(data) > largest:
        raise RobotError(f"{path}: more than {largest} bytes: expected {kind} of at most {largest}")
    return data


def check_regular(name: str, status: os.stat_result, kind: str, largest: int) -> None:
    """Check that a file is a regular one and not too large.

    Raises:
        RobotError: The file is not regular or too large.
    """
    if not stat.S_ISREG(status.st_mode):
        raise RobotError(f"{name}: not a regular file: expected {kind}")
    if status.st_size > largest:
        raise RobotError(f"{name}: {status.st_size} bytes: expected {kind} of at most {largest}")


def one_line(error: Exception) -> str:
    """Return the message of a dependency's error as one line."""
    return " ".join(str(error).split())[:300]
