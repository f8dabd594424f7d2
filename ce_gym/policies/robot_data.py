"""Data of a policy for programs on a robot: keys of mjlab, and the observation in words."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ce_gym.policies.records import RECORD_KEY

MJLAB_KEYS = {
    "joint_names": "joints",
    "joint_stiffness": "kp",
    "joint_damping": "kd",
    "default_joint_pos": "default_pose",
}
"""Keys of mjlab in the metadata of an ONNX file, and keys of our specification (mjlab, `rl/exporter_utils.py`)."""


def metadata(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the metadata of a network file: the record, each entry of its specification, and the keys of mjlab."""
    entries = {RECORD_KEY: record, **record["policy_spec"], **mjlab_metadata(record["policy_spec"])}
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in entries.items()}


def mjlab_metadata(spec: Mapping[str, Any]) -> dict[str, str]:
    """Return the data of a specification under the keys of mjlab: names and numbers separated by commas.

    Empty if the specification lacks one of them. As in mjlab, `action_scale` has the order of the actions.
    """
    if not {*MJLAB_KEYS.values(), "action", "observation"} <= spec.keys():
        return {}
    values = {key: spec[ours] for key, ours in MJLAB_KEYS.items()}
    names = [block["name"] for block in spec["observation"]["blocks"]]
    values |= {"action_scale": spec["action"]["scale"], "observation_names": names}
    values["command_names"] = [name for name in names if "command" in name]
    return {key: ",".join(map(str, value)) for key, value in values.items()}


def observation_in_words(spec: Mapping[str, Any]) -> list[str]:
    """Return a line for each block of an observation: its rows, its name and its meaning."""
    lines, start, history = [], 0, spec["observation"]["history"]
    for block in spec["observation"]["blocks"]:
        end = start + block["size"]
        lines.append(f"{start:>4}..{end - 1:<4} {block['name']}: {block['meaning']}")
        start = end
    if history > 1:
        last = history * start - 1
        lines.append(f"{start:>4}..{last:<4} the observations of the {history - 1} steps before, newest first")
    return lines
