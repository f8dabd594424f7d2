"""Folders and files that nobody but this user, or the administrator, can have written.

Code is run from them. On Windows, where permissions are not mode bits, nothing is checked: the user's profile, in which
the default folder lies, is the user's own.
"""

import os
import stat
from pathlib import Path

from ce_gym.compile.system import user_number

OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
HAS_MODES = user_number() is not None


def prepare_folder(folder: Path) -> None:
    """Make a folder, and those above it that are missing, for this user alone; or see that it is so.

    Args:
        folder: its path has no symbolic links.

    Raises:
        OSError: If it cannot be written, or if other users could put files there: one above it, or itself, belongs to
            them or lets them write. One above it may let them if its sticky bit is set, as that of /tmp: there they
            cannot rename or remove what is not theirs.
    """
    places = (folder, *folder.parents)
    for place in reversed(places):
        if not place.exists():
            place.mkdir(mode=0o700, exist_ok=True)
        if HAS_MODES:
            _check(place, may_be_sticky=place != folder)
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError("it is not a folder that can be written")


def _check(place: Path, may_be_sticky: bool) -> None:
    status = place.lstat()
    if _owned_by_others(status):
        raise PermissionError(f"{place} belongs to another user")
    if status.st_mode & OTHERS_WRITE and not (may_be_sticky and status.st_mode & stat.S_ISVTX):
        raise PermissionError(f"other users may write {place}; expected what `chmod go-w` leaves")


def _owned_by_others(status: os.stat_result) -> bool:
    return status.st_uid not in (user_number(), 0)


def read_file(path: Path) -> bytes:
    """Content of a regular file in a folder of `prepare_folder`.

    Raises:
        OSError: If it cannot be read, is a link or a device, or other users own it or may write it.
    """
    with open(path, "rb", opener=_open_itself) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise PermissionError(f"{path}: not a regular file")
        if HAS_MODES and (_owned_by_others(status) or status.st_mode & OTHERS_WRITE):
            raise PermissionError(f"{path}: other users could have written it")
        return file.read()


def _open_itself(path: str, flags: int) -> int:
    """Follow no link, and wait for nobody at the other end of a pipe."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
