"""Read the actor in an archive of Stable-Baselines3, without unpickling."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

from ce_gym.model.formats.archive import read_member
from ce_gym.policies.actor import ACTIVATIONS, Array
from ce_gym.policies.weights import read_weights


def read_sb3_layers(file: Path) -> tuple[tuple[Array, Array], ...]:
    """Return weight and bias of each layer of the actor of PPO or A2C with `MlpPolicy`.

    Raises:
        Exception: Errors of many classes, if the archive is damaged or has another policy.
    """
    weights = read_weights(file)
    hidden = [name.removesuffix(".weight") for name in weights if name.startswith("mlp_extractor.policy_net")]
    names = [*(name for name in hidden if f"{name}.bias" in weights), "action_net"]
    if "action_net.weight" not in weights or any("features_extractor" in name for name in weights):
        raise ValueError("expected PPO or A2C with MlpPolicy; for others give the loaded model to ce_gym.policies.save")
    return tuple((weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names)


def read_sb3_activation(file: Path) -> str:
    """Return the activation in the `policy_kwargs` of an archive; by default `Tanh`, as in `MlpPolicy`.

    Raises:
        Exception: Errors of many classes, if the archive is damaged or its policy has another activation.
    """
    with zipfile.ZipFile(file) as archive:
        data = json.loads(read_member(archive, "data"))
    text = str(data["policy_kwargs"].get("activation_fn", "<class 'Tanh'>"))
    name = re.fullmatch(r"<class '(?:\w+\.)*(\w+)'>", text)
    if not name or name[1] not in ACTIVATIONS:
        raise ValueError(f"activation_fn {text}; expected one of {', '.join(ACTIVATIONS)}")
    return name[1]
