"""Write policies as ONNX, with the data that other programs need to run them; needs onnx.

The network takes observations `obs` (n, n_obs) and returns clipped mean actions `actions` (n, n_actions). The metadata
of the file contains the record of the policy with its specification: joint order, default pose, meaning of actions,
blocks of an observation, gains, time steps, robot, task and transmission level; and mjlab's keys.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, compose, helper, numpy_helper

from ce_gym.policies.actor import Actor
from ce_gym.policies.errors import PolicyError
from ce_gym.policies.robot_data import metadata

OPSET, IR_VERSION = 17, 8
"""Old versions, for the runtimes on robots."""


def to_onnx(actor: Actor, record: dict[str, Any]) -> onnx.ModelProto:
    """Return an actor as an ONNX model with the record in its metadata."""
    activation = actor.activation.capitalize()  # names in ONNX and torch.nn differ in capital letters only
    nodes, constants, value = [], [], "x"
    for i, (weight, bias) in enumerate(actor.layers):
        if i:
            nodes.append(helper.make_node(activation, [value], [f"active_{i}"]))
            value = f"active_{i}"
        nodes.append(helper.make_node("Gemm", [value, f"weight_{i}", f"bias_{i}"], [f"linear_{i}"], transB=1))
        constants += [_constant(f"weight_{i}", weight), _constant(f"bias_{i}", bias)]
        value = f"linear_{i}"
    graph = helper.make_graph(nodes, "layers", [_rows("x", None)], [_rows(value, None)], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    return complete(model, record, actor.normalisation)


def complete(network: onnx.ModelProto, record: dict[str, Any], normalisation: NDArray | None = None) -> onnx.ModelProto:
    """Return a model that normalises observations, runs a network, and clips its first output to -1..1.

    Args:
        network: A model with one input; also one that was written for a single row.
        record: The record of the policy, written to the metadata.
        normalisation: See `Actor`.

    Raises:
        PolicyError: If the network has several inputs.
        ValueError, onnx.checker.ValidationError: If the network is damaged.
    """
    model = compose.add_prefix(network, "network/")
    model.producer_name = "ce_gym"  # by which `ONNX` tells the file
    graph = model.graph
    weights = {constant.name for constant in graph.initializer}
    inputs = [value.name for value in graph.input if value.name not in weights]
    if len(inputs) != 1:
        names = ", ".join(name.removeprefix("network/") for name in inputs)
        raise PolicyError(f"inputs of the ONNX graph: {names}; expected one input, the observations, and no memory")
    constants = [_constant("low", -1.0), _constant("high", 1.0)]
    before = [helper.make_node("Identity", ["obs"], inputs)]
    if normalisation is not None:
        mean, std, bound = normalisation
        steps = (("Sub", mean), ("Div", std), ("Max", -bound), ("Min", bound))
        names = ["obs", *(f"obs_{operation}" for operation, _ in steps[:-1]), inputs[0]]
        constants += [_constant(operation, value) for operation, value in steps]
        before = [helper.make_node(o, [names[i], o], [names[i + 1]]) for i, (o, _) in enumerate(steps)]
    after = [
        helper.make_node("Max", [graph.output[0].name, "low"], ["bounded_below"]),
        helper.make_node("Min", ["bounded_below", "high"], ["actions"]),
    ]
    ends = [_rows("obs", record["observation_size"]), _rows("actions", record["action_size"])]
    graph = helper.make_graph(
        [*before, *graph.node, *after],
        "policy",
        ends[:1],
        ends[1:],
        [*graph.initializer, *constants],
        sparse_initializer=graph.sparse_initializer,
    )
    model.graph.CopyFrom(graph)
    helper.set_model_props(model, metadata(record))
    onnx.checker.check_model(model, full_check=True)
    return model


def _constant(name: str, value: NDArray | float) -> onnx.TensorProto:
    return numpy_helper.from_array(np.asarray(value, np.float32), name)


def _rows(name: str, size: int | None) -> onnx.ValueInfoProto:
    """Return the description of an array (n, size)."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size])
