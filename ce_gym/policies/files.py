"""Read and write policy files.

| file          | content                                                                                         |
|---------------|-------------------------------------------------------------------------------------------------|
| `policy.zip`  | archive of Stable-Baselines3, written by train/ppo.py with the record in `policy.json` beside it |
| `policy.npz`  | weights of the actor and the record; a tenth of the size of the zip; format of shipped policies |
| `policy.onnx` | network written by train/export.py, with the record in its metadata; needs onnxruntime          |

Zip and npz files are read with limited memory, and only their weights and records.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ce_gym.policies.actor import ACTIVATIONS, Actor, Policy
from ce_gym.policies.archive import read_json, read_npz
from ce_gym.policies.arguments import RESERVED
from ce_gym.policies.environments import shown
from ce_gym.policies.errors import LevelWarning, PolicyError
from ce_gym.policies.height_maps import with_map
from ce_gym.policies.places import locate_policy
from ce_gym.policies.weights import read_weights

RECORD_KEY = "ce_gym_policy"
"""Key of the record in the metadata of an ONNX file."""

REQUIRED: dict[str, type] = {
    "env": str, "env_kwargs": dict, "transmission": str, "observation_size": int, "action_size": int,
    "activation": str, "policy_spec": dict,
}  # fmt: skip
"""Required keys of a record, with their types."""

KINDS = {str: "text", dict: "a JSON object", int: "a whole number"}


def load_policy(path: str | Path, transmission: str | None = None) -> Policy:
    """Read a policy without running code from its file.

    Args:
        path: A policy file; a folder that contains one; or the name of a shipped policy such as
            "mini_cheetah_velocity_exact", where "_exact" may be omitted.
        transmission: Level at which the policy will run; a `LevelWarning` is issued if its training level differs.

    Returns:
        The policy. `policy.predict(obs)[0]` is its mean action; `policy.record["env"]` names its environment.

    Raises:
        PolicyError: If the file is missing, damaged or not a policy.

    Examples:
        >>> policy = ce_gym.load_policy("mini_cheetah_velocity")
        >>> print(policy.record["env"], policy.predict(np.zeros(48))[0].shape)
        ce_gym/MiniCheetahVelocity-v0 (12,)
    """
    file = locate_policy(path)
    policy = _read_onnx(file) if file.suffix == ".onnx" else Policy(*read_actor(file))
    trained = policy.record["transmission"]
    if transmission not in (None, trained):
        warnings.warn(f"{file}: trained on {trained!r}, used on {transmission!r}", LevelWarning, stacklevel=2)
    return policy


def read_actor(path: str | Path) -> tuple[Actor, dict[str, Any]]:
    """Return the layers and the record of a `policy.npz`, or of a `policy.zip` and the JSON beside it.

    Raises:
        PolicyError: If a file is missing, damaged or not a policy of linear layers.
    """
    file = locate_policy(path)
    layers, record = (_read_npz if file.suffix == ".npz" else _read_zip)(file)
    actor = Actor(layers, record["activation"])
    _check_sizes(actor, record, file)
    return actor, record


def write_npz(actor: Actor, record: Mapping[str, Any], out: Path | BinaryIO) -> None:
    """Write weights (float32) and record (JSON) of an actor to one file that numpy reads without unpickling.

    Raises:
        PolicyError: If the file cannot be written.
    """
    arrays: dict[str, Any] = {}
    for i, (weight, bias) in enumerate(actor.layers):
        arrays |= {f"weight_{i}": np.float32(weight), f"bias_{i}": np.float32(bias)}
    try:
        np.savez_compressed(out, record=np.array(json.dumps(record)), **arrays)
    except OSError as error:
        raise PolicyError(f"{out}: cannot be written: {error.strerror}") from None


def _read_npz(file: Path) -> tuple[Any, dict[str, Any]]:
    try:
        arrays = read_npz(file)
        record = json.loads(str(arrays.pop("record")))
        layers = tuple(_layer(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(len(arrays) // 2))
    except Exception as error:  # damaged files raise errors of many classes
        raise PolicyError(f"{file}: no weights of an actor can be read from it: {_one_line(error)}") from None
    return layers, _checked(record, file)


def _read_zip(file: Path) -> tuple[Any, dict[str, Any]]:
    beside = file.with_suffix(".json")
    try:
        record = read_json(beside)
    except FileNotFoundError:
        raise PolicyError(
            f"{beside}: no such file; expected the record that train/ppo.py writes beside a policy. Train with "
            f"train/ppo.py, or run {file.name} with PPO.load of Stable-Baselines3 and ce_gym.adapters.sb3"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise PolicyError(f"{beside}: cannot be read as JSON: {_one_line(error)}") from None
    record = _checked(record, beside)
    try:
        weights = read_weights(file)
        hidden = [name.removesuffix(".weight") for name in weights if name.startswith("mlp_extractor.policy_net")]
        names = [*(name for name in hidden if f"{name}.bias" in weights), "action_net"]
        layers = tuple(_layer(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names)
    except Exception as error:  # damaged files raise errors of many classes
        raise PolicyError(f"{file}: no weights of an actor can be read from it: {_one_line(error)}") from None
    return layers, record


def _layer(weight: NDArray, bias: NDArray) -> tuple[NDArray, NDArray]:
    """Return the arrays of a linear layer after checking them.

    Raises:
        ValueError: If they are not finite floating-point arrays with 2 and 1 axes.
    """
    for array, axes in ((weight, 2), (bias, 1)):
        if array.dtype.kind != "f" or array.ndim != axes:
            raise ValueError(f"{array.dtype} of shape {array.shape}; expected a layer's numbers along {axes} axes")
        if not np.isfinite(array).all():
            raise ValueError("a weight is NaN or infinite; expected finite numbers")
    return weight, bias


def _read_onnx(file: Path) -> Policy:
    try:
        import onnxruntime
    except ImportError:
        raise PolicyError(f'{file}: needs onnxruntime, which is not installed: pip install "ce_gym[export]"') from None
    try:
        session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        record = json.loads(session.get_modelmeta().custom_metadata_map.get(RECORD_KEY, "null"))
        name = session.get_inputs()[0].name
    except Exception as error:  # onnxruntime raises a different class for each kind of damage
        raise PolicyError(f"{file}: not an ONNX file that can be run: {_one_line(error)}") from None
    record = _checked(record, file)

    def act(observations: Any) -> np.ndarray:
        rows = np.asarray(observations, np.float32)
        actions = np.asarray(session.run(None, {name: np.atleast_2d(rows)})[0])
        return actions.reshape(*rows.shape[:-1], -1)

    try:
        actions = act(np.zeros((2, record["observation_size"]), np.float32))
    except Exception as error:
        raise PolicyError(f"{file}: not an ONNX file that can be run: {_one_line(error)}") from None
    if actions.shape != (2, record["action_size"]) or not np.isfinite(actions).all():
        raise PolicyError(f"{file}: gives {actions.shape[-1]} numbers; expected {record['action_size']}, finite ones")
    return Policy(act, record)


def _checked(record: Any, file: Path) -> dict[str, Any]:
    """Return a record after checking the keys that running its policy needs.

    Raises:
        PolicyError: If a key is missing or has a wrong value.
    """
    if isinstance(record, dict):
        record = {str(key): value for key, value in record.items()}
    for key, kind in REQUIRED.items():
        if not isinstance(record, dict) or key not in record:
            raise PolicyError(f"{file}: {key}: missing; expected a record written by this version of train/ppo.py")
        if type(record[key]) is not kind:  # a bool is an int
            raise PolicyError(f"{file}: {key}: {_shortened(record[key])}; expected {KINDS[kind]}")
    if reserved := RESERVED & record["env_kwargs"].keys():
        raise PolicyError(f"{file}: env_kwargs: {min(reserved)}: expected arguments of the environment alone")
    if record["activation"] not in ACTIVATIONS:
        raise PolicyError(
            f"{file}: activation: {_shortened(record['activation'])}; expected one of {', '.join(ACTIVATIONS)}"
        )
    record["env_kwargs"] = with_map(record["env_kwargs"], file)
    return record


def _check_sizes(actor: Actor, record: dict[str, Any], file: Path) -> None:
    """Check the sizes of all layers against each other and against the record.

    Raises:
        PolicyError: If two sizes differ.
    """
    sizes = [record["observation_size"], *(len(bias) for _, bias in actor.layers)]
    for (weight, bias), size in zip(actor.layers, sizes, strict=False):
        if weight.shape != (len(bias), size):
            raise PolicyError(f"{file}: a layer takes {weight.shape[-1]} numbers; expected {size}")
    if not actor.layers or sizes[-1] != record["action_size"]:
        raise PolicyError(f"{file}: gives {sizes[-1]} numbers; expected the {record['action_size']} of its record")


def _one_line(error: Exception) -> str:
    return _shortened(" ".join(str(error).split()), str) or type(error).__name__


def _shortened(value: Any, text: Callable[[Any], str] = repr) -> str:
    """Return a value as text of at most 200 printable characters."""
    try:
        return shown(text(value)[:200])
    except RecursionError:
        return "a deeply nested value"
