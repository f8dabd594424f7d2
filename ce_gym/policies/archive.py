"""Untrusted zip files, read within a limit on memory and without unpickling.

Sizes in headers are not trusted: a member is never unpacked beyond its stated size, that size is checked
before anything is allocated, and an array must fill its member exactly.
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
"""Most bytes that a file may unpack to, unless said otherwise: 256 MiB."""


def read_member(archive: zipfile.ZipFile, name: str, most_bytes: int = MOST_BYTES) -> bytes:
    """Return the bytes of a member of a zip file.

    Raises:
        KeyError, ValueError, zipfile.BadZipFile, zlib.error, RuntimeError: If there is none, it is too large, packed in
            an unusual way, encrypted or damaged.
    """
    member = archive.getinfo(name)
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name}: compression {member.compress_type}; expected none or deflate")
    if member.file_size > most_bytes:
        raise ValueError(f"{name}: {member.file_size} bytes unpacked; expected at most {most_bytes}")
    with archive.open(member) as opened:
        return opened.read(member.file_size)  # the size bounds what is unpacked, which a bare read() does not


def read_npz(file: Path, most_bytes: int = MOST_BYTES) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz by name: numbers and text, no objects.

    Args:
        file: To read.
        most_bytes: Most that all of them may take.

    Raises:
        OSError, ValueError, zipfile.BadZipFile, zlib.error, RuntimeError: If it cannot be read.
    """
    _check_regular(file)
    with zipfile.ZipFile(file) as archive:
        total = sum(member.file_size for member in archive.infolist())
        if total > most_bytes:
            raise ValueError(f"{total} bytes unpacked; expected at most {most_bytes}")
        return {name.removesuffix(".npy"): _array(read_member(archive, name), name) for name in archive.namelist()}


def _check_regular(file: Path) -> None:
    """Refuse folders; and pipes and devices, which may never end."""
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such file")
    if not file.is_file():
        raise OSError("not a regular file")


def _array(data: bytes, name: str) -> NDArray[Any]:
    """Return the array of a npy file, if it is one of numbers or text that fills the file."""
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"{name}: version {version}; expected 1.0 or 2.0")
    shape, fortran, dtype = read(stream)
    if dtype.kind not in "biufU":
        raise ValueError(f"{name}: elements of type {dtype}; expected numbers or text")
    needed, found = math.prod(shape) * dtype.itemsize, len(data) - stream.tell()
    if needed != found:
        raise ValueError(f"{name}: shape {shape} takes {needed} bytes; found {found}")
    if not found:
        return np.zeros(shape, dtype)
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape, order="F" if fortran else "C")


def read_json(file: Path, most_bytes: int = 2**24) -> Any:
    """Return what a JSON file holds.

    Raises:
        OSError, ValueError, RecursionError: If it is missing, larger than `most_bytes`, or no JSON.
    """
    _check_regular(file)
    if file.stat().st_size > most_bytes:
        raise ValueError(f"{file.stat().st_size} bytes; expected at most {most_bytes}")
    return json.loads(file.read_text(encoding="utf-8"))
