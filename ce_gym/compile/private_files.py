"""Folders and files that only this user or the administrator can have written; the package executes code from them.

On Windows, where permissions are not mode bits, nothing is checked. The default folder lies in the profile of the user.
"""

import os
import stat
from pathlib import Path

from ce_gym.compile.system import user_number

OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
HAS_MODES = user_number() is not None


def prepare_folder(folder: Path) -> None:
    """Make a folder and its missing parents for this user alone, or check that an existing folder is safe.

    Args:
        folder: A path without symbolic links.

    Raises:
        OSError: If the folder cannot be written, or if other users own or may write the folder or one of its parents.
            They may write a parent whose sticky bit is set, such as /tmp, where they cannot rename foreign files.
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
    """Return the content of a regular file in a folder of `prepare_folder`.

    Raises:
        OSError: If the file cannot be read, is a link or a device, or other users own or may write the file.
    """
    with open(path, "rb", opener=_open_itself) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise PermissionError(f"{path}: not a regular file")
        if HAS_MODES and (_owned_by_others(status) or status.st_mode & OTHERS_WRITE):
            raise PermissionError(f"{path}: other users could have written it")
        return file.read()


def _open_itself(path: str, flags: int) -> int:
    """Open without following a link or waiting for the other end of a pipe."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
