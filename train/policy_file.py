"""Trained policies as files that are safe to open, where they are found, and acting with one.

A `policy.zip` of Stable-Baselines3 holds pickled Python objects next to the weights, and unpickling runs whatever its
author wanted. Here only the weights are read (`torch.load(weights_only=True)`) and the plain `policy.json` beside
them; an ONNX file holds no code at all. A `policy.npz`, in which policies are shipped, has the actor's weights and the
record and nothing else: a tenth of the zip, readable by numpy alone with pickling forbidden. So a stranger's policy can
be judged; to train one on is another matter, see `evaluate.load_policy`. Knows the formats and where shipped policies
lie; no environments, robots or tasks.
"""

from __future__ import annotations

import io
import json
import pickle
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

METADATA = "ce_gym_policy"
"""Key under which an ONNX file holds the record of its policy."""

SHIPPED = Path(__file__).resolve().parents[1] / "assets" / "policies"
"""Policies that come with the repository: a folder each, named `<robot>_<task>_<level>`."""

WHERE = "a file (policy.zip, .npz or .onnx), the folder of a training run, or the name of a shipped policy"
"""What `locate` takes, for help texts."""


FORMATS = (".zip", ".npz", ".onnx")
"""Kinds of policy files, in the order in which they are looked for."""

LAYER = ("weight", "bias")


class PolicyError(ValueError):
    """A policy that cannot be used; the message is one line for the user."""


class LevelWarning(UserWarning):
    """A policy runs on another transmission level than it was trained on."""


@dataclass(frozen=True)
class Actor:
    """The layers that turn observations into mean actions.

    Attributes:
        layers: Weight (n_out, n_in) and bias (n_out,) of each linear layer.
        activation: Name of a module of `torch.nn`, applied between layers.
    """

    layers: tuple[tuple[torch.Tensor, torch.Tensor], ...]
    activation: str

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions in [-1, 1], shape (n, n_actions), for observations (n, n_obs)."""
        activate = getattr(torch.nn, self.activation)()
        x = torch.from_numpy(np.asarray(observations, np.float32))
        with torch.no_grad():
            for i, (weight, bias) in enumerate(self.layers):
                x = torch.nn.functional.linear(activate(x) if i else x, weight, bias)
        return x.clamp(-1.0, 1.0).numpy()


@dataclass(frozen=True)
class Policy:
    """A policy that can act, in the shape in which `evaluate` and Stable-Baselines3 expect one.

    Attributes:
        act: Actions (n, n_actions) for observations (n, n_obs), float32.
        record: What training wrote: environment, level, contract and so on.
    """

    act: Callable[[NDArray[np.float32]], NDArray[np.float32]]
    record: dict[str, Any]

    def predict(self, observation: Any, deterministic: bool = True) -> tuple[NDArray[np.float32], None]:
        """Return mean actions for observations, an array (n, n_obs) or a dictionary that has one as "policy".

        Raises:
            PolicyError: If the observations have another size, or actions are to be drawn at random.
        """
        if not deterministic:
            raise PolicyError("deterministic=False; expected True: a policy file has mean actions only")
        rows = observation["policy"] if isinstance(observation, Mapping) else observation
        size = self.record["observation_size"]
        if rows.shape[-1] != size:
            raise PolicyError(f"observation has {rows.shape[-1]} numbers; expected the {size} of the policy")
        return self.act(rows), None


def locate(path: str | Path) -> Path:
    """Return the file of a policy.

    Args:
        path: A file; a folder that has one; or the name of a shipped policy, whose level may be left out if it is
            exact.

    Raises:
        PolicyError: If there is none.
    """
    path = Path(path)
    if path.suffix in FORMATS:
        return path
    folders = [path, *([SHIPPED / path, SHIPPED / f"{path}_exact"] if len(path.parts) == 1 else [])]
    files = [folder / f"policy{suffix}" for folder in folders for suffix in FORMATS]
    for file in (*files, path.with_name(f"{path.name}.zip")):
        if file.is_file():
            return file
    known = ", ".join(shipped()) or "none yet"
    raise PolicyError(f"{path}: no such policy; expected {WHERE} (there are: {known})")


def shipped() -> list[str]:
    """Return the names of the policies that come with the repository."""
    return sorted(file.parent.name for file in SHIPPED.glob("*/policy.npz"))


def read_policy(path: str | Path, transmission: str | None = None) -> Policy:
    """Read a policy without running code that it may carry.

    Args:
        path: What `locate` takes: `<name>.zip` with its `<name>.json`, as train/ppo.py writes them, `<name>.npz` of
            train/card.py or `<name>.onnx` of train/export.py, or where one lies.
        transmission: Level that it will run on; a `LevelWarning` tells if it was trained on another.

    Raises:
        PolicyError: If a file is missing, damaged or of another kind.
    """
    path = locate(path)
    if path.suffix == ".onnx":
        policy = _read_onnx(path)
    else:
        actor, record = read_actor(path)
        policy = Policy(actor, record)
    trained = policy.record["transmission"]
    if transmission not in (None, trained):
        warnings.warn(f"{path}: trained on {trained!r}, used on {transmission!r}", LevelWarning, stacklevel=2)
    return policy


def read_actor(path: str | Path) -> tuple[Actor, dict[str, Any]]:
    """Read the actor's layers, weights only, and the record: of a `policy.npz`, or a `policy.zip` and its JSON.

    Raises:
        PolicyError: If a file is missing, damaged or no policy of linear layers.
    """
    policy = locate(path)
    if policy.suffix == ".npz":
        return _read_npz(policy)
    policy = policy.with_suffix(".zip")
    record = _read_record(policy.with_suffix(".json"))
    if not policy.exists():
        raise PolicyError(f"{policy}: no such file; expected a policy.zip as train/ppo.py writes it")
    try:
        with zipfile.ZipFile(policy) as archive:
            weights = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True, map_location="cpu")
        names = [name.removesuffix(".weight") for name in weights if name.startswith("mlp_extractor.policy_net")]
        names = [name for name in dict.fromkeys(names) if f"{name}.bias" in weights] + ["action_net"]
        layers = tuple((weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names)
    except (OSError, KeyError, RuntimeError, ValueError, zipfile.BadZipFile, pickle.UnpicklingError) as error:
        raise PolicyError(f"{policy}: no weights of an actor can be read from it: {_one_line(error)}") from None
    return _fitting(Actor(layers, record["activation"]), record, policy)


def write_npz(actor: Actor, record: dict[str, Any], out: Path) -> None:
    """Write an actor's weights, float32, and its record, as JSON, into one file that numpy reads without unpickling.

    Raises:
        PolicyError: If that cannot be done.
    """
    named = [(i, zip(LAYER, layer, strict=True)) for i, layer in enumerate(actor.layers)]
    arrays: dict[str, Any] = {f"{name}_{i}": tensor.numpy() for i, layer in named for name, tensor in layer}
    try:
        np.savez_compressed(out, record=np.array(json.dumps(record)), **arrays)
    except OSError as error:
        raise PolicyError(f"{out}: cannot be written: {error.strerror}") from None


def _read_npz(path: Path) -> tuple[Actor, dict[str, Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        record = json.loads(str(arrays.pop("record")))
        n = len(arrays) // len(LAYER)
        layers = tuple(tuple(torch.from_numpy(arrays[f"{name}_{i}"]) for name in LAYER) for i in range(n))
    except FileNotFoundError:
        raise PolicyError(f"{path}: no such file; expected a policy.npz as train/card.py writes it") from None
    except (OSError, KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise PolicyError(f"{path}: no weights of an actor can be read from it: {_one_line(error)}") from None
    record = checked_record(record, path)
    return _fitting(Actor(layers, record["activation"]), record, path)  # type: ignore[arg-type]  # two of each


def _fitting(actor: Actor, record: dict[str, Any], path: Path) -> tuple[Actor, dict[str, Any]]:
    """Return both if each layer takes what the one before gives, the first what the record says."""
    sizes = [record["observation_size"], *(len(bias) for _, bias in actor.layers)]
    for (weight, bias), size in zip(actor.layers, sizes, strict=False):
        if weight.shape != (len(bias), size):
            raise PolicyError(f"{path}: a layer takes {weight.shape[-1]} numbers; expected {size}")
    if sizes[1:] == [] or sizes[-1] != record["action_size"]:
        raise PolicyError(f"{path}: gives {sizes[-1]} numbers; expected the {record['action_size']} of its record")
    return actor, record


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise PolicyError(f"{path}: no such file; expected the policy.json that training writes") from None
    except (OSError, ValueError) as error:
        raise PolicyError(f"{path}: cannot be read as JSON: {_one_line(error)}") from None
    return checked_record(record, path)


def checked_record(record: Any, path: Path) -> dict[str, Any]:
    """Return the record of a policy if it has what is needed to run it.

    Raises:
        PolicyError: If it lacks something.
    """
    for key in ("env", "env_kwargs", "transmission", "observation_size", "action_size", "activation", "contract"):
        if not isinstance(record, dict) or key not in record:
            raise PolicyError(f"{path}: {key}: missing; expected a record written by this version of train/ppo.py")
    if not isinstance(getattr(torch.nn, str(record["activation"]), None), type):
        raise PolicyError(f"{path}: activation: {record['activation']!r}; expected a module of torch.nn")
    return record


def _read_onnx(path: Path) -> Policy:
    try:
        import onnxruntime
    except ImportError:
        raise PolicyError(f"{path}: needs onnxruntime; pip install ce_gym[export]") from None
    if not path.exists():
        raise PolicyError(f"{path}: no such file; expected an ONNX file that train/export.py has written")
    try:
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        text = session.get_modelmeta().custom_metadata_map.get(METADATA, "null")
        record = checked_record(json.loads(text), path)
    except PolicyError:
        raise
    except Exception as error:  # onnxruntime has a class of its own for each kind of damage
        raise PolicyError(f"{path}: not an ONNX file that can be run: {_one_line(error)}") from None
    name = session.get_inputs()[0].name

    def act(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(session.run(None, {name: np.asarray(observations, np.float32)})[0])

    return Policy(act, record)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
