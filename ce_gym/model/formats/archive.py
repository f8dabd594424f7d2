"""Read untrusted zip files with limited memory and without unpickling.

Sizes in headers are not trusted: the stated size is checked before memory is allocated, a member is never unpacked
beyond it, and an array must fill its member exactly.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

MOST_BYTES = 2**28
"""Default limit on the unpacked size of a file [bytes]: 256 MiB."""


def read_member(archive: zipfile.ZipFile, name: str, most_bytes: int = MOST_BYTES) -> bytes:
    """Return the bytes of a member of a zip file.

    Raises:
        KeyError, ValueError, zipfile.BadZipFile, zlib.error, RuntimeError: If the member is missing, too large,
            encrypted, damaged, or compressed with another method than deflate.
    """
    member = archive.getinfo(name)
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name}: compression {member.compress_type}; expected none or deflate")
    if member.file_size > most_bytes:
        raise ValueError(f"{name}: {member.file_size} bytes unpacked; expected at most {most_bytes}")
    with archive.open(member) as opened:
        return opened.read(member.file_size)  # a bare read() would not limit the unpacked size


def read_npz(file: Path, most_bytes: int = MOST_BYTES) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz file by name: numbers and text, no objects.

    Args:
        file: File to read.
        most_bytes: Limit on the unpacked size of all arrays together [bytes].

    Raises:
        OSError, ValueError, zipfile.BadZipFile, zlib.error, RuntimeError: If the file cannot be read.
    """
    _check_regular(file)
    with zipfile.ZipFile(file) as archive:
        total = sum(member.file_size for member in archive.infolist())
        if total > most_bytes:
            raise ValueError(f"{total} bytes unpacked; expected at most {most_bytes}")
        return {name.removesuffix(".npy"): _array(read_member(archive, name), name) for name in archive.namelist()}


def _check_regular(file: Path) -> None:
    """Refuse folders, and pipes and devices, whose data may never end.

    Raises:
        OSError: If the path is not a regular file.
    """
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such file")
    if not file.is_file():
        raise OSError("not a regular file")


def _array(data: bytes, name: str) -> NDArray[Any]:
    """Return the array of an npy file of numbers or text.

    Raises:
        ValueError: If the array has other elements, or does not fill the file.
    """
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"{name}: version {version}; expected 1.0 or 2.0")
    shape, fortran, dtype = read(stream)
    if dtype.kind not in "biufU":
        raise ValueError(f"{name}: elements of type {dtype}; expected numbers or text")
    needed = math.prod(shape) * dtype.itemsize
    size = len(data) - stream.tell()
    if needed != size:
        raise ValueError(f"{name}: shape {shape} takes {needed} bytes; found {size}")
    if not size:
        return np.zeros(shape, dtype)
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape, order="F" if fortran else "C")


def read_json(file: Path, most_bytes: int = 2**24) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError, ValueError, RecursionError: If the file is missing, larger than `most_bytes`, or not JSON.
    """
    _check_regular(file)
    if file.stat().st_size > most_bytes:
        raise ValueError(f"{file.stat().st_size} bytes; expected at most {most_bytes}")
    return json.loads(file.read_text(encoding="utf-8"))
