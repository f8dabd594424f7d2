"""The weights in a `policy.zip` of Stable-Baselines3, read without torch and without running code.

The zip holds `policy.pth`, a file of torch's: a zip of its own, in which `data.pkl` is a pickle that names the arrays
and `data/` has their bytes. A pickle can name any function to call; this reader knows the few that rebuild an array
and refuses all others.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def read_weights(file: Path) -> dict[str, NDArray]:
    """Return the arrays of a policy by name.

    Raises:
        OSError, LookupError, TypeError, ValueError, AttributeError, NotImplementedError, EOFError, zipfile.BadZipFile,
        zlib.error, pickle.UnpicklingError: If the file is damaged, or names anything but arrays.
    """
    with zipfile.ZipFile(file) as outer, zipfile.ZipFile(io.BytesIO(outer.read("policy.pth"))) as inner:
        return dict(_Arrays(inner).load())


class _Arrays(pickle.Unpickler):
    """Rebuilds arrays; anything else that a file may name is refused."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        (index,) = (name for name in archive.namelist() if name.endswith("data.pkl"))
        self._archive, self._root = archive, index.removesuffix("data.pkl")
        super().__init__(io.BytesIO(archive.read(index)))

    def find_class(self, module: str, name: str) -> Any:
        known = {
            "collections.OrderedDict": OrderedDict,
            "torch._utils._rebuild_tensor_v2": _rebuild,
            "torch.FloatStorage": np.dtype("<f4"),
            "torch.DoubleStorage": np.dtype("<f8"),
        }
        if f"{module}.{name}" not in known:
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a policy's weights")
        return known[f"{module}.{name}"]

    def persistent_load(self, pid: Any) -> NDArray:
        _, dtype, name, *_ = pid  # "storage", its type, its file, device, size
        return np.frombuffer(self._archive.read(f"{self._root}data/{name}"), dtype)


def _rebuild(storage: NDArray, offset: int, shape: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> NDArray:
    """Return a tensor whose numbers lie row by row."""
    count = int(np.prod(shape))
    if stride != tuple(int(np.prod(shape[i + 1 :])) for i in range(len(shape))):
        raise pickle.UnpicklingError(f"strides {stride}; expected an array of shape {shape} stored row by row")
    return storage[offset : offset + count].reshape(shape)
