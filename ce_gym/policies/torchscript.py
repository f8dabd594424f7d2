"""Write policies as TorchScript; needs torch."""

from __future__ import annotations

import io
import warnings
from typing import Any

import torch

from ce_gym.policies.actor import Actor
from ce_gym.policies.robot_data import metadata


class _Clip(torch.nn.Module):
    """Clip to -bound..bound."""

    bound: torch.Tensor

    def __init__(self, bound: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("bound", bound)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.minimum(torch.maximum(x, -self.bound), self.bound)


class _Normalise(_Clip):
    """Subtract the mean, divide by the standard deviation, and clip."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, mean: torch.Tensor, std: torch.Tensor, bound: torch.Tensor) -> None:
        super().__init__(bound)
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return super().forward((x - self.mean) / self.std)


def to_torchscript(actor: Actor, record: dict[str, Any]) -> bytes:
    """Return an actor as TorchScript, with the metadata of an ONNX file as extra files."""
    parts: list[torch.nn.Module] = []
    if actor.normalisation is not None:
        parts.append(_Normalise(*torch.tensor(actor.normalisation, dtype=torch.float32)))
    for i, (weight, bias) in enumerate(actor.layers):
        linear = torch.nn.Linear(*weight.shape[::-1])
        linear.load_state_dict({"weight": torch.tensor(weight), "bias": torch.tensor(bias)})
        parts += [getattr(torch.nn, actor.activation)()] if i else []
        parts.append(linear)
    network = torch.nn.Sequential(*parts, _Clip(torch.ones(())))
    content = io.BytesIO()
    with warnings.catch_warnings():  # torch advises another format, which needs torch's compiler on the robot
        warnings.simplefilter("ignore")
        traced = torch.jit.trace(network.eval().requires_grad_(False), torch.zeros(2, record["observation_size"]))
        torch.jit.save(traced, content, _extra_files=metadata(record))
    return content.getvalue()
