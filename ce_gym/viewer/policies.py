"""Policy files: found by name, read without running code that they may carry, and run by numpy.

| file          | what it is                                                                                        |
|---------------|---------------------------------------------------------------------------------------------------|
| `policy.npz`  | the weights of the actor and its record, as train/card.py writes them                             |
| `policy.zip`  | of Stable-Baselines3, as train/ppo.py writes it, its `policy.json` beside it                      |
| `policy.onnx` | as train/export.py writes it; needs onnxruntime                                                   |

Knows file formats; knows no environments.
"""

from __future__ import annotations

import io
import json
import pickle
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model import assets_folder
from ce_gym.viewer.errors import ViewerError

Act = Callable[[Any], NDArray[np.float32]]
"""Actions (n, n_actions) for observations (n, n_obs), or a dictionary that has these as "policy"."""

Layers = list[tuple[NDArray, NDArray]]

NAMES = ("policy.npz", "policy.zip", "policy.onnx")
"""What a policy's file is called, in the order in which they are looked for."""

ACTIVATIONS: Mapping[str, Callable[[NDArray], NDArray]] = {
    "Tanh": np.tanh,
    "ReLU": lambda x: np.maximum(x, 0),
    "ELU": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}
"""By their names in torch.nn."""


def policy_file(path: Path) -> Path | None:
    """Return the policy that a path means: a file, a folder that has one, or the name of one that is shipped."""
    if path.is_file():
        return path if path.name in NAMES or path.suffix in (".zip", ".onnx") else None
    shelf = assets_folder() / "policies"
    folders = [path, *([shelf / path, shelf / f"{path}_exact"] if len(path.parts) == 1 and not path.suffix else [])]
    return next((file for folder in folders for name in NAMES if (file := folder / name).is_file()), None)


def read_policy(file: Path) -> tuple[Act, dict[str, Any]]:
    """Return a policy's mean action, clipped to [-1, 1], and its record.

    Raises:
        ViewerError: If the file is damaged or no policy.
    """
    read = {".zip": _read_zip, ".onnx": _read_onnx}.get(file.suffix, _read_npz)
    try:
        act, record = read(file)
        if missing := {"env", "env_kwargs"} - record.keys():
            raise KeyError(*sorted(missing))
    except ViewerError:
        raise
    except (OSError, LookupError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise _not_a_policy(file, error) from None
    except (pickle.UnpicklingError, AttributeError, NotImplementedError) as error:
        raise _not_a_policy(file, error) from None
    return act, record


def _not_a_policy(file: Path, error: Exception | str) -> ViewerError:
    return ViewerError(f"{file}: not a policy that can be run: {' '.join(str(error).split())}")


def _read_npz(file: Path) -> tuple[Act, dict[str, Any]]:
    with np.load(file, allow_pickle=False) as arrays:
        record = json.loads(str(arrays["record"]))
        n = sum(name.startswith("weight_") for name in arrays.files)
        layers = [(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(n)]
    return _network(file, layers, record), record


def _read_zip(file: Path) -> tuple[Act, dict[str, Any]]:
    record = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))
    with zipfile.ZipFile(file) as outer, zipfile.ZipFile(io.BytesIO(outer.read("policy.pth"))) as inner:
        tensors = _Tensors(inner).load()
    hidden = [name.removesuffix(".weight") for name in tensors if name.startswith("mlp_extractor.policy_net")]
    names = [name for name in hidden if f"{name}.bias" in tensors] + ["action_net"]
    layers = [(tensors[f"{name}.weight"], tensors[f"{name}.bias"]) for name in names]
    return _network(file, layers, record), record


class _Tensors(pickle.Unpickler):
    """Rebuilds the arrays of a file of torch's; anything else that it may name is refused, so no code is run."""

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


def _rebuild(storage: NDArray, offset: int, shape: tuple[int, ...], *_: Any) -> NDArray:
    """Return a tensor whose numbers lie one after the other, as those of saved weights do."""
    return storage[offset : offset + int(np.prod(shape))].reshape(shape)


def _read_onnx(file: Path) -> tuple[Act, dict[str, Any]]:
    try:
        import onnxruntime
    except ImportError:
        raise ViewerError(f'{file}: needs onnxruntime, which is not installed: pip install "ce_gym[export]"') from None
    try:
        session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        record = json.loads(session.get_modelmeta().custom_metadata_map["ce_gym_policy"])
    except Exception as error:  # onnxruntime has a class of its own for each kind of damage
        raise _not_a_policy(file, error) from None
    name = session.get_inputs()[0].name
    return lambda observation: np.asarray(session.run(None, {name: _rows(observation)})[0]), record


def _network(file: Path, layers: Layers, record: Mapping[str, Any]) -> Act:
    activate = ACTIVATIONS[record["activation"]]
    sizes = [int(record["observation_size"]), *(len(bias) for _, bias in layers)]
    if any(weight.shape != (len(bias), size) for (weight, bias), size in zip(layers, sizes, strict=False)):
        raise _not_a_policy(file, "its layers do not fit each other")

    def act(observation: Any) -> NDArray[np.float32]:
        x = _rows(observation)
        for i, (weight, bias) in enumerate(layers):
            x = (activate(x) if i else x) @ weight.T + bias
        return np.clip(x, -1.0, 1.0).astype(np.float32)

    return act


def _rows(observation: Any) -> NDArray[np.float32]:
    return np.asarray(observation["policy"] if isinstance(observation, Mapping) else observation, np.float32)
