"""Read the weights in a `policy.zip` of Stable-Baselines3 without torch and without running code.

The zip contains files of torch such as `policy.pth`. Each of these files is a zip, too: `data.pkl` is a pickle that
names the arrays, and `data/` has their bytes. A pickle can call any function. This reader knows the few functions that
rebuild an array and refuses all others.
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

from ce_gym.model.formats.archive import read_member


def read_weights(file: Path, member: str = "policy.pth") -> dict[str, Any]:
    """Return the arrays of a policy by name, or the content of another member.

    Raises:
        Exception: Errors of many classes, if the file is damaged, too large, or names anything but arrays.
    """
    with zipfile.ZipFile(file) as outer, zipfile.ZipFile(io.BytesIO(read_member(outer, member))) as inner:
        return dict(_Arrays(inner).load())


class _Arrays(pickle.Unpickler):
    """Unpickler that rebuilds arrays and refuses everything else."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        (index,) = (name for name in archive.namelist() if name.endswith("data.pkl"))
        self._archive, self._root = archive, index.removesuffix("data.pkl")
        super().__init__(io.BytesIO(read_member(archive, index)))

    def find_class(self, module: str, name: str) -> Any:
        known = {
            "collections.OrderedDict": OrderedDict,
            "torch._utils._rebuild_tensor_v2": _rebuild,
            "torch.FloatStorage": "<f4",  # as text: a pickle may change the state of objects
            "torch.DoubleStorage": "<f8",
        }
        if f"{module}.{name}" not in known:
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a policy's weights")
        return known[f"{module}.{name}"]

    def persistent_load(self, pid: Any) -> NDArray:
        _, dtype, name, *_ = pid  # "storage", its type, its file, device, size
        return np.frombuffer(read_member(self._archive, f"{self._root}data/{name}"), dtype)


def _rebuild(storage: NDArray, offset: int, shape: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> NDArray:
    """Return a tensor stored row by row."""
    count = int(np.prod(shape))
    if stride != tuple(int(np.prod(shape[i + 1 :])) for i in range(len(shape))):
        raise pickle.UnpicklingError(f"strides {stride}; expected an array of shape {shape} stored row by row")
    return storage[offset : offset + count].reshape(shape)
