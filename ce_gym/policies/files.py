"""Policy files, read and written.

| file          | what it is                                                                                        |
|---------------|---------------------------------------------------------------------------------------------------|
| `policy.zip`  | of Stable-Baselines3, as train/ppo.py writes it, its `policy.json` beside it: weights only are read |
| `policy.npz`  | weights of the actor and the record, nothing else; a tenth of the zip: policies are shipped so     |
| `policy.onnx` | as train/export.py writes it, the record in its metadata; needs onnxruntime                        |

So a stranger's policy can be judged and shown. To train one on is another matter: see `load_learner` in
train/evaluate.py. Knows formats; where files lie is the business of places.py.
"""

from __future__ import annotations

import json
import pickle
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.policies.actor import ACTIVATIONS, Actor, Policy
from ce_gym.policies.errors import LevelWarning, PolicyError
from ce_gym.policies.places import locate_policy
from ce_gym.policies.weights import read_weights

RECORD_KEY = "ce_gym_policy"
"""Key under which an ONNX file holds the record of its policy."""

REQUIRED = ("env", "env_kwargs", "transmission", "observation_size", "action_size", "activation", "contract")
"""What a record must say."""

DAMAGE = (
    OSError, LookupError, TypeError, ValueError, AttributeError, NotImplementedError, EOFError,
    zipfile.BadZipFile, zlib.error, pickle.UnpicklingError,
)  # fmt: skip
"""What reading a damaged file may raise."""


def load_policy(path: str | Path, transmission: str | None = None) -> Policy:
    """Read a policy without running code that it may carry.

    Args:
        path: A file; a folder that has one; or the name of a shipped policy such as "mini_cheetah_velocity_exact",
            whose level may be left out if it is exact.
        transmission: Level that it will run on; a `LevelWarning` tells if it was trained on another.

    Returns:
        The policy. `policy.predict(obs)[0]` is its mean action; `policy.record["env"]` names its environment.

    Raises:
        PolicyError: If a file is missing, damaged or of another kind.

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
        PolicyError: If a file is missing, damaged or no policy of linear layers.
    """
    file = locate_policy(path)
    layers, record = (_read_npz if file.suffix == ".npz" else _read_zip)(file)
    actor = Actor(layers, record["activation"])
    _check_sizes(actor, record, file)
    return actor, record


def write_npz(actor: Actor, record: Mapping[str, Any], out: Path) -> None:
    """Write an actor's weights, float32, and its record, as JSON, into one file that numpy reads without unpickling.

    Raises:
        PolicyError: If that cannot be done.
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
        with np.load(file, allow_pickle=False) as opened:
            arrays = {name: opened[name] for name in opened.files}
        record = json.loads(str(arrays.pop("record")))
        layers = tuple((arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(len(arrays) // 2))
    except DAMAGE as error:
        raise PolicyError(f"{file}: no weights of an actor can be read from it: {_one_line(error)}") from None
    return layers, _checked(record, file)


def _read_zip(file: Path) -> tuple[Any, dict[str, Any]]:
    beside = file.with_suffix(".json")
    try:
        record = _checked(json.loads(beside.read_text(encoding="utf-8")), beside)
    except FileNotFoundError:
        raise PolicyError(f"{beside}: no such file; expected the policy.json that training writes") from None
    except (OSError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise PolicyError(f"{beside}: cannot be read as JSON: {_one_line(error)}") from None
    try:
        weights = read_weights(file)
        hidden = [name.removesuffix(".weight") for name in weights if name.startswith("mlp_extractor.policy_net")]
        names = [*(name for name in hidden if f"{name}.bias" in weights), "action_net"]
        layers = tuple((weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names)
    except DAMAGE as error:
        raise PolicyError(f"{file}: no weights of an actor can be read from it: {_one_line(error)}") from None
    return layers, record


def _read_onnx(file: Path) -> Policy:
    try:
        import onnxruntime
    except ImportError:
        raise PolicyError(f'{file}: needs onnxruntime, which is not installed: pip install "ce_gym[export]"') from None
    try:
        session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        record = json.loads(session.get_modelmeta().custom_metadata_map.get(RECORD_KEY, "null"))
    except Exception as error:  # onnxruntime has a class of its own for each kind of damage
        raise PolicyError(f"{file}: not an ONNX file that can be run: {_one_line(error)}") from None
    name, record = session.get_inputs()[0].name, _checked(record, file)

    def act(observations: Any) -> np.ndarray:
        rows = np.asarray(observations, np.float32)
        actions = np.asarray(session.run(None, {name: np.atleast_2d(rows)})[0])
        return actions.reshape(*rows.shape[:-1], -1)

    return Policy(act, record)


def _checked(record: Any, file: Path) -> dict[str, Any]:
    """Return a record if it has what is needed to run its policy."""
    for key in REQUIRED:
        if not isinstance(record, dict) or key not in record:
            raise PolicyError(f"{file}: {key}: missing; expected a record written by this version of train/ppo.py")
    if record["activation"] not in ACTIVATIONS:
        raise PolicyError(f"{file}: activation: {record['activation']!r}; expected one of {', '.join(ACTIVATIONS)}")
    return record


def _check_sizes(actor: Actor, record: dict[str, Any], file: Path) -> None:
    """See that each layer takes what the one before gives, and both ends are as the record says."""
    sizes = [record["observation_size"], *(len(bias) for _, bias in actor.layers)]
    for (weight, bias), size in zip(actor.layers, sizes, strict=False):
        if weight.shape != (len(bias), size):
            raise PolicyError(f"{file}: a layer takes {weight.shape[-1]} numbers; expected {size}")
    if not actor.layers or sizes[-1] != record["action_size"]:
        raise PolicyError(f"{file}: gives {sizes[-1]} numbers; expected the {record['action_size']} of its record")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
