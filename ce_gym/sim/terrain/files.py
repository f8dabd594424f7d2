"""Reads height maps: arrays of heights, and pictures whose brightness is the height."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.arguments import check

MOST_HEIGHTS = 2**24
"""Most heights that a kernel takes."""


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
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}; expected an array of heights") from None
    flat = isinstance(heights, np.ndarray) and heights.ndim == 2 and heights.dtype.kind in "fiu"
    check("file", str(path), flat, "an array (rows, columns) of numbers")
    _check_size(path, heights.size)
    return np.array(heights, dtype=float)


def _picture(path: Path, height: float) -> NDArray[np.float64]:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise ValueError(f"{path}: Pillow reads pictures and is not installed: pip install pillow") from None
    try:
        with Image.open(path) as picture:
            _check_size(path, picture.width * picture.height)
            values, white = _brightness(picture)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError) as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}; expected a picture or a .npy file") from None
    return height / white * values[::-1].T


def _brightness(picture: Any) -> tuple[NDArray[np.float64], float]:
    """Return the values of a picture and the largest that its format has; colours count by their brightness."""
    deep = picture.mode.startswith("I")  # 16 bits
    return np.asarray(picture if deep else picture.convert("L"), dtype=float), 65535.0 if deep else 255.0


def _check_size(path: Path, count: int) -> None:
    if count > MOST_HEIGHTS:
        raise ValueError(f"{path} has {count} heights; expected at most {MOST_HEIGHTS}")
