"""Write policies in the formats of programs on robots.

| suffix  | content                                                                  | needs |
|---------|--------------------------------------------------------------------------|-------|
| `.onnx` | network with the specification and mjlab's keys in its metadata          | onnx  |
| `.pt`   | network as TorchScript, with the same data in its extra files            | torch |
| `.h`    | weights, network and specification as a header for C                     |       |
| `.npz`  | weights and record, as numpy arrays                                      |       |

The networks of all formats take observations (n, n_obs) and return clipped mean actions (n, n_actions).
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ce_gym.files import ONNX, POLICY, Kind, check_output, json_kind, write_file
from ce_gym.policies.actor import Actor
from ce_gym.policies.c_header import to_c
from ce_gym.policies.environments import environment_of
from ce_gym.policies.errors import PolicyError
from ce_gym.policies.files import load_policy, read_actor, write_npz
from ce_gym.policies.places import locate_policy
from ce_gym.policies.records import record_of_id

WITHOUT_SOURCES = "ce_gym policy specification, version 1"
"""Format of specifications in which some observation blocks have no source, and joints the names of links."""


def export_policy(
    path: str | Path, out: Path, env: str | None = None, env_kwargs: Mapping[str, Any] = MappingProxyType({})
) -> dict[str, Any]:
    """Write a policy to `out` in the format of its suffix, and its specification beside it as JSON.

    Only weights and the record are read from the policy; no pickled code is run.

    Args:
        path: See `ce_gym.load_policy`.
        out: A file that ends in .onnx, .pt, .h or .npz; the suffix of the specification is `.json`.
        env: See `ce_gym.load_policy`.
        env_kwargs: See `ce_gym.load_policy`.

    Returns:
        The specification.

    Raises:
        PolicyError: If the policy cannot be read, its network or observation has no equivalent in this format, or a
            file cannot be written.
    """
    file = locate_policy(path)
    if out.suffix not in WRITERS:
        raise PolicyError(f"{out}: expected a name that ends in one of {', '.join(WRITERS)}")
    if file.suffix == out.suffix == ".onnx":
        record = load_policy(file).record
        content = file.read_bytes()
    else:
        actor, record = read_actor(file, env, env_kwargs)
        record = complete_record(record)
        content = WRITERS[out.suffix](actor, record)
    specification = json.dumps(record["policy_spec"], indent=2) + "\n"
    try:
        check_output(out, KINDS[out.suffix])
        write_file(out.with_suffix(".json"), specification, json_kind(specification))
        write_file(out, content, KINDS[out.suffix])
    except OSError as error:
        raise PolicyError(f"{error.filename}: cannot be written: {error.strerror}") from None
    return record["policy_spec"]


def complete_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with a specification of the present format, and with the latency of training in it.

    The environment yields the specification if the record is older.
    """
    spec = record["policy_spec"]
    if spec.get("format") == WITHOUT_SOURCES:
        spec = record_of_id(environment_of(record), record["env_kwargs"])["policy_spec"]
    trained = record.get("settings", {}).get("training", {})
    if "latency" in trained:
        spec = {**spec, "latency": [steps * spec["physics_dt"] for steps in trained["latency"]]}
    return {**record, "policy_spec": spec}


def _onnx(actor: Actor, record: dict[str, Any]) -> bytes:
    from ce_gym.policies.onnx_writer import to_onnx

    return to_onnx(actor, record).SerializeToString()


def _torchscript(actor: Actor, record: dict[str, Any]) -> bytes:
    from ce_gym.policies.torchscript import to_torchscript

    return to_torchscript(actor, record)


def _npz(actor: Actor, record: dict[str, Any]) -> bytes:
    content = io.BytesIO()
    write_npz(actor, record, content)
    return content.getvalue()


WRITERS: Mapping[str, Callable[[Actor, dict[str, Any]], bytes | str]] = {
    ".onnx": _onnx,
    ".pt": _torchscript,
    ".h": to_c,
    ".npz": _npz,
}
"""Contents of the files by suffix."""
KINDS = {
    ".onnx": ONNX,
    ".pt": Kind("a TorchScript policy", b"policy/"),
    ".h": Kind("a header of a policy", b"ce_gym"),
    ".npz": POLICY,
}
"""Kinds of the files by suffix."""
