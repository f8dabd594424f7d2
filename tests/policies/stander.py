"""A policy that stands, as both files that hold one; nothing but its last bias acts."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ce_gym.policies import Actor, write_npz

ENV = "ce_gym/MiniCheetahVelocity-v0"
BIAS = 0.05


def record(**changes: Any) -> dict[str, Any]:
    usual = {"env": ENV, "env_kwargs": {"transmission": "exact"}, "transmission": "exact", "policy_spec": {}}
    return usual | {"observation_size": 48, "action_size": 12, "activation": "ELU"} | changes


def stander() -> Actor:
    rng = np.random.default_rng(0)
    first = (rng.standard_normal((8, 48)), rng.standard_normal(8))
    layers = (first, (np.zeros((12, 8)), np.full(12, BIAS)))
    return Actor(tuple((np.float32(weight), np.float32(bias)) for weight, bias in layers), "ELU")


def write_small(file: Path, **changes: Any) -> Path:
    """Write a policy.npz."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_npz(stander(), record(**changes), file)
    return file


def write_zip(folder: Path, actor: Actor | None = None, weights: bytes | None = None, **changes: Any) -> Path:
    """Write a policy.zip as Stable-Baselines3 would, with other bytes as weights if there are any."""
    torch = pytest.importorskip("torch")
    actor = stander() if actor is None else actor
    names = [*(f"mlp_extractor.policy_net.{2 * i}" for i in range(len(actor.layers) - 1)), "action_net"]
    tensors = {"log_std": torch.zeros(12), "mlp_extractor.value_net.0.weight": torch.ones(8, 48)}
    for name, (weight, bias) in zip(names, actor.layers, strict=True):
        tensors |= {f"{name}.weight": torch.tensor(weight), f"{name}.bias": torch.tensor(bias)}
    buffer = io.BytesIO()
    torch.save(tensors, buffer)
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / "policy.zip", "w") as archive:
        archive.writestr("policy.pth", buffer.getvalue() if weights is None else weights)
    (folder / "policy.json").write_text(json.dumps(record(**changes)), encoding="utf-8")
    return folder / "policy.zip"
