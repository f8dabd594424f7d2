"""The policy network: linear layers with an activation in between, run by numpy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.policies.errors import PolicyError

Array = NDArray[np.float32]

ACTIVATIONS: Mapping[str, Callable[[Any], Any]] = {
    "Tanh": np.tanh,
    "ReLU": lambda x: np.maximum(x, 0),
    "ELU": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "SELU": lambda x: 1.0507009873554805 * np.where(x > 0, x, 1.6732632423543772 * np.expm1(np.minimum(x, 0))),
    "Sigmoid": lambda x: 0.5 * (1 + np.tanh(0.5 * x)),
    "Softplus": lambda x: np.logaddexp(x, np.float32(0)),
}  # fmt: skip
"""Activation functions by their names in `torch.nn`, with the default parameters of `torch.nn`."""


@dataclass(frozen=True)
class Actor:
    """The layers that turn observations into mean actions.

    Attributes:
        layers: Weight (n_out, n_in) and bias (n_out,) of each linear layer.
        activation: One of `ACTIVATIONS`, applied between layers.
        normalisation: Mean, standard deviation and bound of each observation, shape (3, n_obs), or None. The first
            layer takes `clip((observation - mean) / std, -bound, bound)`.
    """

    layers: tuple[tuple[Array, Array], ...]
    activation: str
    normalisation: NDArray[np.float64] | None = None

    def __call__(self, observations: NDArray) -> Array:
        """Return actions in [-1, 1], shape (n, n_actions), for observations (n, n_obs); `n` may be missing."""
        activate = ACTIVATIONS[self.activation]
        x = np.asarray(observations, np.float32)
        if self.normalisation is not None:
            mean, std, bound = self.normalisation
            x = np.clip((x - mean) / std, -bound, bound).astype(np.float32)
        for i, (weight, bias) in enumerate(self.layers):
            x = (activate(x) if i else x) @ weight.T + bias
        return np.clip(x, -1.0, 1.0).astype(np.float32, copy=False)


@dataclass(frozen=True)
class Policy:
    """A policy with the method `predict` of Stable-Baselines3.

    Attributes:
        act: Function from observations (n, n_obs) to actions (n, n_actions), float32; `n` may be missing.
        record: Data of the training run: `env`, `env_kwargs`, `transmission`, `policy_spec`, seed, settings and others.
    """

    act: Callable[[NDArray], Array]
    record: dict[str, Any]

    def predict(
        self, observation: Any, state: None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Array, None]:
        """Return the mean action, shape (n, n_actions) or (n_actions,), and no state.

        Args:
            observation: An array (n, n_obs) or (n_obs,), or a dictionary with this array under "policy".
            state: Not used; recurrent policies of Stable-Baselines3 have one.
            episode_start: Not used.
            deterministic: Must be True: a policy file has mean actions only.

        Raises:
            PolicyError: If the observation has another size than in training, or `deterministic` is False.
        """
        if not deterministic:
            raise PolicyError("deterministic=False; expected True: a policy file has mean actions only")
        rows = observation["policy"] if isinstance(observation, Mapping) else observation
        size = self.record["observation_size"]
        if np.shape(rows)[-1:] != (size,):
            raise PolicyError(f"observation of shape {np.shape(rows)}; expected {size} numbers, as in training")
        return self.act(rows), None
