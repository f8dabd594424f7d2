"""Reads height maps: arrays of heights, and pictures whose brightness is the height."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.arguments import check

MOST_HEIGHTS = 2**24
"""Most heights that a kernel takes."""

FORMATS = ("PNG", "TIFF", "JPEG", "BMP", "GIF", "PPM", "WEBP")
"""Formats of pictures, by their names in Pillow."""

WHITE = {"1": 255.0, "L": 255.0, "LA": 255.0, "P": 255.0, "PA": 255.0, "RGB": 255.0, "RGBA": 255.0}
WHITE |= {"I;16": 65535.0, "I;16B": 65535.0, "I;16L": 65535.0}
"""Largest value of a pixel by its kind, as named in Pillow: 1, 8 and 16 bits."""

DEEP = ("PNG", "PPM")
"""Formats whose pixels of 16 bits some versions of Pillow read as kind "I", of 32 bits."""


def read_heights(file: str | Path, height: float) -> NDArray[np.float64]:
    """Read heights [m], shape (rows, columns); rows go along x, columns along y.

    Args:
        file: A NumPy array `.npy` of that shape [m]; or a picture, seen from above with x to the right and y up.
        height: Height of the brightest value of the picture's format [m]; black is 0.

    Raises:
        ValueError: If the file does not exist or has another format.
    """
    path = Path(file)
    check("file", str(file), path.is_file(), "a file with a height map")
    return _array(path) if path.suffix == ".npy" else _picture(path, height)


def _array(path: Path) -> NDArray[np.float64]:
    try:
        heights = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped, so that a false header takes no memory
    except Exception as error:  # damaged files raise errors of many classes
        raise _unreadable(path, error, "an array of heights") from None
    flat = isinstance(heights, np.ndarray) and heights.ndim == 2 and heights.dtype.kind in "fiu" and heights.size > 0
    check("file", str(path), flat, "an array (rows, columns) of numbers, one or more of each")
    _check_size(path, heights.size)
    return np.array(heights, dtype=float)


def _picture(path: Path, height: float) -> NDArray[np.float64]:
    try:
        from PIL import Image
    except ImportError:
        raise ValueError(f"{path}: Pillow reads pictures and is not installed: pip install pillow") from None
    try:
        with Image.open(path, formats=FORMATS) as picture:
            count, kind = picture.width * picture.height, picture.mode
            white = 65535.0 if kind == "I" and picture.format in DEEP else WHITE.get(kind)
            values = _brightness(picture) if count <= MOST_HEIGHTS and white else np.zeros((0, 0))
    except Exception as error:  # damaged files raise errors of many classes
        raise _unreadable(path, error, f"a picture ({', '.join(FORMATS)}) or a .npy file") from None
    _check_size(path, count)
    if white is None:
        expected = "1, 8 or 16 bits; or heights [m] in a .npy file"
        raise ValueError(f"{path}: pixels of kind {kind!r} have no white; expected {expected}")
    return height / white * values[::-1].T


def _brightness(picture: Any) -> NDArray[np.float64]:
    """Return the values of a picture; colours count by their brightness."""
    return np.asarray(picture if picture.mode.startswith("I") else picture.convert("L"), dtype=float)


def _unreadable(path: Path, error: Exception, expected: str) -> ValueError:
    problem = " ".join(str(error).split())[:200] or type(error).__name__
    return ValueError(f"{path}: {problem}; expected {expected}")


def _check_size(path: Path, count: int) -> None:
    if count > MOST_HEIGHTS:
        raise ValueError(f"{path} has {count} heights; expected at most {MOST_HEIGHTS}")
