"""Read and write policy files.

| file          | content                                                                                         |
|---------------|-------------------------------------------------------------------------------------------------|
| `policy.zip`  | archive of Stable-Baselines3; the record is in `policy.json` beside it                          |
| `policy.npz`  | weights of the actor and the record; a tenth of the size of the zip; format of shipped policies |
| `policy.onnx` | any network, with the record in its metadata; needs onnxruntime                                 |

Zip and npz files are read with limited memory, and only their weights and records.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np

from ce_gym.files import POLICY, written
from ce_gym.model.formats.archive import read_json, read_npz
from ce_gym.policies.actor import ACTIVATIONS, Actor, Policy
from ce_gym.policies.errors import LevelWarning, PolicyError
from ce_gym.policies.onnx_reader import policy_of_onnx
from ce_gym.policies.places import locate_policy
from ce_gym.policies.records import REQUIRED, checked_record, one_line, record_of_id, shortened
from ce_gym.policies.sb3_archives import read_sb3_activation, read_sb3_layers

OF_ACTOR = REQUIRED | {"activation": str}
"""Required keys of a record beside layers, with their types."""


def load_policy(
    path: str | Path,
    transmission: str | None = None,
    env: str | None = None,
    env_kwargs: Mapping[str, Any] = MappingProxyType({}),
) -> Policy:
    """Read a policy without running code from its file.

    Args:
        path: A policy file; a folder that contains one; or the name of a shipped policy such as
            "mini_cheetah_velocity_exact", where "_exact" may be omitted.
        transmission: Level at which the policy will run; a `LevelWarning` is issued if its training level differs.
        env: Id of the environment, for an archive of Stable-Baselines3 without a record.
        env_kwargs: Arguments of this environment.

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
    if file.suffix == ".onnx":
        policy = policy_of_onnx(file.read_bytes(), file)
    else:
        policy = Policy(*read_actor(file, env, env_kwargs))
    trained = policy.record["transmission"]
    if transmission not in (None, trained):
        warnings.warn(f"{file}: trained on {trained!r}, used on {transmission!r}", LevelWarning, stacklevel=2)
    return policy


def read_actor(
    path: str | Path, env: str | None = None, env_kwargs: Mapping[str, Any] = MappingProxyType({})
) -> tuple[Actor, dict[str, Any]]:
    """Return the layers and the record of a `policy.npz`, or of a `policy.zip` and the JSON beside it.

    Args:
        path: See `load_policy`.
        env: See `load_policy`.
        env_kwargs: See `load_policy`.

    Raises:
        PolicyError: If a file is missing, damaged or not a policy of linear layers.
    """
    file = locate_policy(path)
    if file.suffix == ".onnx":
        raise PolicyError(f"{file}: expected a policy of linear layers (.npz or .zip)")
    actor, record = _read_npz(file) if file.suffix == ".npz" else _read_zip(file, env, env_kwargs)
    check_actor(actor, record, file)
    return actor, record


def write_npz(actor: Actor, record: Mapping[str, Any], out: Path | BinaryIO) -> None:
    """Write weights (float32) and record (JSON) of an actor to one file that numpy reads without unpickling.

    Raises:
        PolicyError: If the file cannot be written.
    """
    arrays: dict[str, Any] = {}
    for i, (weight, bias) in enumerate(actor.layers):
        arrays |= {f"weight_{i}": np.float32(weight), f"bias_{i}": np.float32(bias)}
    if actor.normalisation is not None:
        arrays["normalisation"] = actor.normalisation
    arrays = {"record": np.array(json.dumps(record)), **arrays}
    try:
        if isinstance(out, Path):
            with written(out, POLICY) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **arrays)
        else:
            np.savez_compressed(out, **arrays)
    except OSError as error:
        raise PolicyError(f"{out}: cannot be written: {error.strerror}") from None


def _read_npz(file: Path) -> tuple[Actor, dict[str, Any]]:
    try:
        arrays = read_npz(file)
        record = json.loads(str(arrays.pop("record")))
        normalisation = arrays.pop("normalisation", None)
        layers = tuple((arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(len(arrays) // 2))
    except Exception as error:  # damaged files raise errors of many classes
        raise _unreadable(file, error) from None
    record = checked_record(record, file, OF_ACTOR)
    return Actor(layers, record["activation"], normalisation), record


def _read_zip(file: Path, env: str | None, env_kwargs: Mapping[str, Any]) -> tuple[Actor, dict[str, Any]]:
    beside = file.with_suffix(".json")
    if env and not beside.exists():
        actor = read_sb3_actor(file)
        return actor, record_of_id(env, env_kwargs) | {"activation": actor.activation}
    try:
        record = read_json(beside)
    except FileNotFoundError:
        raise PolicyError(
            f"{beside}: no such file: an archive of Stable-Baselines3 has no record of its environment; name the "
            "environment with --env ID, or save the policy with ce_gym.policies.save"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise PolicyError(f"{beside}: cannot be read as JSON: {one_line(error)}") from None
    record = checked_record(record, beside, OF_ACTOR)
    return read_sb3_actor(file, record["activation"]), record


def read_sb3_actor(file: Path, activation: str | None = None) -> Actor:
    """Return the actor in an archive of Stable-Baselines3.

    Args:
        file: The archive.
        activation: Name of the activation; None reads the name from the archive.

    Raises:
        PolicyError: If the archive is damaged, or its actor is not layers with one of `ACTIVATIONS`.
    """
    try:
        return Actor(read_sb3_layers(file), activation or read_sb3_activation(file))
    except Exception as error:  # damaged files raise errors of many classes
        raise _unreadable(file, error) from None


def _unreadable(file: Path, error: Exception) -> PolicyError:
    return PolicyError(f"{file}: no weights of an actor can be read from it: {one_line(error)}")


def check_actor(actor: Actor, record: dict[str, Any], file: Path) -> None:
    """Check the numbers and sizes of all layers, the activation and the normalisation.

    Raises:
        PolicyError: If sizes differ from each other or from the record, or an actor of these parts cannot be run.
    """
    for array, axes in ((array, axes) for layer in actor.layers for array, axes in zip(layer, (2, 1), strict=True)):
        if array.dtype.kind != "f" or array.ndim != axes:
            given = f"{array.dtype} of shape {array.shape}"
            raise PolicyError(f"{file}: {given}; expected a layer's numbers along {axes} axes")
        if not np.isfinite(array).all():
            raise PolicyError(f"{file}: a weight is NaN or infinite; expected finite numbers")
    if actor.activation not in ACTIVATIONS:
        raise PolicyError(
            f"{file}: activation: {shortened(actor.activation)}; expected one of {', '.join(ACTIVATIONS)}"
        )
    sizes = [record["observation_size"], *(len(bias) for _, bias in actor.layers)]
    for (weight, bias), size in zip(actor.layers, sizes, strict=False):
        if weight.shape != (len(bias), size):
            raise PolicyError(f"{file}: a layer takes {weight.shape[-1]} numbers; expected {size}")
    if not actor.layers or sizes[-1] != record["action_size"]:
        raise PolicyError(f"{file}: gives {sizes[-1]} numbers; expected the {record['action_size']} of its record")
    rows = actor.normalisation
    if rows is not None:
        if rows.dtype.kind != "f" or rows.shape != (3, sizes[0]):
            raise PolicyError(f"{file}: normalisation: {rows.dtype} of shape {rows.shape}; expected (3, {sizes[0]})")
        if not (np.isfinite(rows[:2]).all() and (rows[1:] > 0).all()):
            raise PolicyError(f"{file}: normalisation: expected finite means, and positive deviations and bounds")
