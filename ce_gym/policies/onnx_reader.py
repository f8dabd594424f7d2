"""Run ONNX files that contain the record of a policy; needs onnxruntime."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.policies.actor import Policy
from ce_gym.policies.errors import PolicyError
from ce_gym.policies.records import RECORD_KEY, checked_record, one_line


def policy_of_onnx(content: bytes, file: Path) -> Policy:
    """Return the policy in the content of an ONNX file.

    Args:
        content: The bytes of the file. Weights in other files are not read.
        file: Path in errors.

    Raises:
        PolicyError: If onnxruntime is missing, or the content cannot be run or does not fit its record.
    """
    try:
        import onnxruntime
    except ImportError:
        raise PolicyError(f'{file}: needs onnxruntime, which is not installed: pip install "ce_gym[export]"') from None
    try:
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        record = json.loads(session.get_modelmeta().custom_metadata_map.get(RECORD_KEY, "null"))
        name = session.get_inputs()[0].name
    except Exception as error:  # onnxruntime raises a different class for each kind of damage
        raise PolicyError(f"{file}: not an ONNX file that can be run: {one_line(error)}") from None
    record = checked_record(record, file)

    def act(observations: Any) -> np.ndarray:
        rows = np.asarray(observations, np.float32)
        actions = np.asarray(session.run(None, {name: np.atleast_2d(rows)})[0])
        return actions.reshape(*rows.shape[:-1], -1)

    try:
        actions = act(np.zeros((2, record["observation_size"]), np.float32))
    except Exception as error:
        raise PolicyError(f"{file}: not an ONNX file that can be run: {one_line(error)}") from None
    if actions.shape != (2, record["action_size"]) or not np.isfinite(actions).all():
        raise PolicyError(f"{file}: gives {actions.shape[-1]} numbers; expected {record['action_size']}, finite ones")
    return Policy(act, record)
