"""Networks of torch and models of Stable-Baselines3, as layers or as ONNX; needs torch."""

from __future__ import annotations

import io
import warnings
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from ce_gym.policies.actor import ACTIVATIONS, Actor, Array
from ce_gym.policies.errors import PolicyError
from ce_gym.policies.records import one_line

SCALES = np.repeat(np.array([0.1, 1.0, 10.0, 100.0], np.float32), 50)[:, None]
"""Standard deviation of each observation on which networks are compared, shape (n, 1)."""


class MeanAction(torch.nn.Module):
    """The mean action of a policy of Stable-Baselines3.

    Args:
        policy: Attribute `policy` of a learner.
    """

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy
        self.has_dict = isinstance(policy.observation_space, gymnasium.spaces.Dict)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return actions (n, n_actions) for observations (n, n_obs)."""
        observed = {"policy": observations} if self.has_dict else observations
        return self.policy._predict(observed, deterministic=True)


def network_of(module: torch.nn.Module, n_obs: int) -> Actor | Any:
    """Return a network of torch as an actor if it is linear layers with an activation, else as an ONNX model.

    Both are compared with the network on random observations.

    Args:
        module: Network from observations (n, n_obs) to actions (n, n_actions).
        n_obs: Size of an observation.

    Raises:
        PolicyError: If the network cannot be run or exported.
    """
    modes = [(part, part.training) for part in module.modules()]
    module.eval()
    try:
        return _compared_network(module, n_obs)
    finally:
        for part, mode in modes:
            part.train(mode)


def _compared_network(module: torch.nn.Module, n_obs: int) -> Actor | Any:
    """Do the work of `network_of` on a network in evaluation mode."""
    device = next((weight.device for weight in module.parameters()), None)
    observations = SCALES * np.random.default_rng(0).standard_normal((len(SCALES), n_obs), np.float32)
    inputs = torch.tensor(observations, device=device)
    try:
        with torch.no_grad():
            actions = module(inputs).cpu().numpy()
    except Exception as error:  # the network is code of the user
        raise PolicyError(
            f"{type(module).__name__}: {one_line(error)}; expected a network from observations (n, {n_obs}) to a "
            "tensor of actions (n, n_actions)"
        ) from error
    layers = _linear_layers(module)
    sizes = [n_obs, *(len(bias) for _, bias in layers)]
    plain = not any(True for _ in module.buffers())  # normalisation has buffers
    if plain and layers and [weight.shape[1] for weight, _ in layers] == sizes[:-1] and actions.shape[-1] == sizes[-1]:
        for activation in ACTIVATIONS:
            actor = Actor(layers, activation)
            if _agree(actor(observations), actions):
                return actor
    return _exported(module, inputs, actions)


def _linear_layers(module: torch.nn.Module) -> tuple[tuple[Array, Array], ...]:
    """Return weight and bias of all linear layers in the order of their definition, without value networks of SB3."""
    layers = []
    for name, layer in module.named_modules():
        kind = getattr(layer, "original_name", type(layer).__name__)  # of TorchScript
        if kind == "Linear" and "value_net" not in name:
            weight: Any = layer.weight
            bias: Any = weight.new_zeros(len(weight)) if layer.bias is None else layer.bias
            layers.append((weight.detach().cpu().numpy(), bias.detach().cpu().numpy()))
    return tuple(layers)


def _agree(actions: NDArray, expected: NDArray) -> bool:
    """Return whether clipped actions are equal up to the rounding of single precision."""
    tolerance = 1e-5 * np.maximum(1.0, np.abs(expected).max(axis=1, keepdims=True))
    return bool((np.abs(np.clip(actions, -1, 1) - np.clip(expected, -1, 1)) <= tolerance).all())


def _exported(module: torch.nn.Module, inputs: torch.Tensor, actions: NDArray) -> Any:
    """Return the ONNX model of a network after comparing their actions.

    Raises:
        PolicyError: If the network cannot be exported, or the model acts differently.
    """
    import onnx
    import onnxruntime

    from ce_gym.policies.onnx_writer import OPSET

    content: Any = io.BytesIO()
    options: dict[str, Any] = {"input_names": ["obs"], "dynamic_axes": {"obs": {0: "n"}}, "opset_version": OPSET}
    try:
        with warnings.catch_warnings():  # the newer exporter needs onnxscript and refuses TorchScript
            warnings.simplefilter("ignore")
            torch.onnx.export(module, (inputs[:2],), content, dynamo=False, **options)
        session = onnxruntime.InferenceSession(content.getvalue(), providers=["CPUExecutionProvider"])
        exported: Any = session.run(None, {"obs": inputs.cpu().numpy()})[0]
    except Exception as error:  # exporter and runtime raise errors of many classes
        raise PolicyError(f"{type(module).__name__}: cannot be exported as ONNX: {one_line(error)}") from error
    if not _agree(exported, actions):
        raise PolicyError(f"{type(module).__name__}: its ONNX export acts differently; expected a pure function")
    return onnx.load_model_from_string(content.getvalue())
