"""Write a trained policy as ONNX, with the data that other programs need to run it.

The network takes observations `obs` (n, n_obs) and returns clipped mean actions `actions` (n, n_actions). The metadata
of the file contains the record of the policy with its specification: joint order, default pose, meaning of actions,
blocks of an observation, gains, time steps, robot, task and transmission level. The specification is also written
beside the file as JSON. Only weights are read from the policy; no pickled code is run. No robot or task is named here.

    python train/export.py runs/mini_cheetah_velocity policy.onnx
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import onnx
from onnx import TensorProto, helper, numpy_helper

from ce_gym.policies import RECORD_KEY, Actor, PolicyError

OPSET, IR_VERSION = 17, 8
"""Old versions, for the runtimes on robots."""


def to_onnx(actor: Actor, record: dict[str, Any]) -> onnx.ModelProto:
    """Return an actor as an ONNX model with the record in its metadata."""
    activation = actor.activation.capitalize()  # names in ONNX and torch.nn differ in capital letters only
    nodes, constants, value = [], [], "obs"
    for i, (weight, bias) in enumerate(actor.layers):
        if i:
            nodes.append(helper.make_node(activation, [value], [f"active_{i}"]))
            value = f"active_{i}"
        nodes.append(helper.make_node("Gemm", [value, f"weight_{i}", f"bias_{i}"], [f"linear_{i}"], transB=1))
        constants += [numpy_helper.from_array(x, f"{n}_{i}") for n, x in (("weight", weight), ("bias", bias))]
        value = f"linear_{i}"
    limits = [helper.make_tensor(name, TensorProto.FLOAT, (), [x]) for name, x in (("low", -1.0), ("high", 1.0))]
    nodes.append(helper.make_node("Clip", [value, "low", "high"], ["actions"]))
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", record[size]])
        for name, size in (("obs", "observation_size"), ("actions", "action_size"))
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], constants + limits)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    add_record(model, record)
    onnx.checker.check_model(model, full_check=True)
    return model


def add_record(model: onnx.ModelProto, record: dict[str, Any]) -> None:
    """Add the record of a policy, and each entry of its specification, to a model's metadata."""
    entries = {RECORD_KEY: record, **record["policy_spec"]}
    helper.set_model_props(model, {k: x if isinstance(x, str) else json.dumps(x) for k, x in entries.items()})


def write(model: onnx.ModelProto, record: dict[str, Any], out: Path) -> None:
    """Write a model to `out`, and the policy's specification beside it as JSON.

    Raises:
        PolicyError: If a file cannot be written.
    """
    try:
        onnx.save(model, out)
        out.with_suffix(".json").write_text(json.dumps(record["policy_spec"], indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise PolicyError(f"{out}: cannot be written: {error.strerror}") from None
