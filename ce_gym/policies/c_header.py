"""Write policies as a header for C99: figures of the robot, sources of the observation, weights and network."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.policies.actor import Actor
from ce_gym.policies.errors import PolicyError
from ce_gym.policies.robot_data import observation_in_words

ACTIVATIONS = {
    "Tanh": "tanhf(x)",
    "ReLU": "fmaxf(x, 0.0f)",
    "ELU": "x > 0.0f ? x : expm1f(x)",
    "SELU": "1.05070098f * (x > 0.0f ? x : 1.67326324f * expm1f(x))",
    "Sigmoid": "1.0f / (1.0f + expf(-x))",
    "Softplus": "fmaxf(x, 0.0f) + log1pf(expf(-fabsf(x)))",
}
"""Expressions of the activation functions of `actor.ACTIVATIONS`."""

SOURCES = ("q", "v", "command", "action", "gravity", "gait")
"""Sources of the entries of an observation, in the order of the constants `POLICY_Q`, ..."""

NETWORK = """
/* y = weight x + bias; weight is stored row by row. */
static void policy_linear(const float *weight, const float *bias, const float *x, int n_in, int n_out, float *y) {
  for (int i = 0; i < n_out; ++i) {
    y[i] = bias[i];
    for (int j = 0; j < n_in; ++j) y[i] += weight[i * n_in + j] * x[j];
  }
}

/* Action in -1..1, shape (POLICY_ACTIONS,), for an observation, shape (POLICY_HISTORY * POLICY_FRAME,). */
static void policy_act(const float *observation, float *action) {"""


def to_c(actor: Actor, record: dict[str, Any]) -> str:
    """Return the text of a header with constants `POLICY_*`, arrays `policy_*` and the function `policy_act`.

    Raises:
        PolicyError: If an observation block has no source, or actions are not joint targets.
    """
    spec = record["policy_spec"]
    blocks, action = spec["observation"]["blocks"], spec["action"]
    for block in blocks:
        if block.get("of") not in SOURCES:
            raise PolicyError(f"observation block {block['name']}: has no formula; expected a policy without, for C")
    if action["kind"] != "joint_pd":
        raise PolicyError(f"actions={action['kind']!r}; expected 'joint_pd', for C")
    low, high = np.transpose(spec["command"]["range"])
    commanded = [spec["joints"].index(name) for name in action["joints"]]
    lines = [
        f"/* {record['env']}, made by `python -m ce_gym export`. Units: SI, rad. Link with -lm.",
        *(f" * {line}" for line in ("Observation:", *observation_in_words(spec), "Action: " + action["meaning"])),
        " */",
        "#ifndef POLICY_H",
        "#define POLICY_H",
        "#include <math.h>",
        f"#define POLICY_JOINTS {len(spec['joints'])}",
        f"#define POLICY_ACTIONS {len(commanded)}",
        f"#define POLICY_FRAME {sum(block['size'] for block in blocks)}  /* numbers of one observation */",
        f"#define POLICY_HISTORY {spec['observation']['history']}  /* observations that the network takes */",
        f"#define POLICY_CONTROL_DT {_number(spec['control_dt'])}",
        f"#define POLICY_GAIT_PERIOD {_number(spec['gait_period'])}",
        f"#define POLICY_LATENCY {_number(spec['latency'][1])}  /* largest in training */",
        f"#define POLICY_OBSERVATION_BOUND {_number(spec['normalisation']['clip'])}",
        f"enum {{ {', '.join(f'POLICY_{name.upper()}' for name in SOURCES)} }};",
        _texts("policy_joint_names", spec["joints"]),
        _numbers("policy_default_joint_pos", spec["default_pose"]),
        _numbers("policy_joint_stiffness", spec["kp"]),
        _numbers("policy_joint_damping", spec["kd"]),
        _numbers("policy_torque_limits", [np.inf if limit is None else limit for limit in spec["torque_limits"]]),
        _numbers("policy_command_low", low),
        _numbers("policy_command_high", high),
        _integers("policy_action_joint", commanded),
        _numbers("policy_action_scale", action["scale"]),
        "/* Entry i of an observation is offset[i] + scale[i] * s[row[i]], where s is the source of[i]. */",
        _integers("policy_of", (SOURCES.index(block["of"]) for block in blocks for _ in block["rows"])),
        _integers("policy_row", (row for block in blocks for row in block["rows"])),
        *(_numbers(f"policy_{key}", (x for block in blocks for x in block[key])) for key in ("scale", "offset")),
        *_network(actor),
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _network(actor: Actor) -> list[str]:
    """Return weights and `policy_act`."""
    constants, body, x = [], [], "observation"
    if actor.normalisation is not None:
        mean, std, bound = actor.normalisation
        constants += [_numbers("policy_mean", mean), _numbers("policy_std", std), _numbers("policy_bound", bound)]
        bounded = "fmaxf(-policy_bound[i], fminf(policy_bound[i], (observation[i] - policy_mean[i]) / policy_std[i]))"
        n = len(mean)
        body += [f"  float x[{n}];", f"  for (int i = 0; i < {n}; ++i) x[i] = {bounded};"]
        x = "x"
    for i, (weight, bias) in enumerate(actor.layers):
        n_out, n_in = weight.shape
        constants += [_numbers(f"policy_weight_{i}", weight.ravel()), _numbers(f"policy_bias_{i}", bias)]
        last = i == len(actor.layers) - 1
        y = "action" if last else f"x{i}"
        body += [] if last else [f"  float {y}[{n_out}];"]
        body.append(f"  policy_linear(policy_weight_{i}, policy_bias_{i}, {x}, {n_in}, {n_out}, {y});")
        if not last:
            body.append(f"  for (int i = 0; i < {n_out}; ++i) {y}[i] = policy_activation({y}[i]);")
        x = y
    clip = "  for (int i = 0; i < POLICY_ACTIONS; ++i) action[i] = fmaxf(-1.0f, fminf(1.0f, action[i]));"
    activation = f"static float policy_activation(float x) {{ return {ACTIVATIONS[actor.activation]}; }}"
    return [*constants, activation, NETWORK.strip(), *body, clip, "}"]


def _number(x: float) -> str:
    return "INFINITY" if np.isinf(x) else f"{np.float32(x)}f"


def _array(kind: str, name: str, entries: list[str]) -> str:
    rows = [", ".join(entries[i : i + 10]) for i in range(0, len(entries), 10)]
    return f"static const {kind} {name}[{len(entries)}] = {{\n  " + ",\n  ".join(rows) + "};"


def _numbers(name: str, values: Iterable[float] | NDArray) -> str:
    return _array("float", name, [_number(x) for x in values])


def _integers(name: str, values: Iterable[int]) -> str:
    return _array("int", name, [str(x) for x in values])


def _texts(name: str, values: Iterable[str]) -> str:
    return _array("char *const", name, [f'"{x}"' for x in values])
