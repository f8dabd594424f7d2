"""A Stable-Baselines3 policy whose critic sees more than its actor.

    envs = make_sb3_vec_env(env_id, 512, obs_mode="dict", critic=("contact_forces", "parameters"))
    model = PPO(AsymmetricPolicy, envs)

The critic is needed during training only, so it may use quantities that no sensor of the robot measures (Pinto et al.
2017, arXiv:1710.06542).
"""

from __future__ import annotations

import torch
from gymnasium.spaces import Dict, Space, flatdim
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import Schedule

ACTOR, CRITIC = "policy", "critic"
"""Keys of the observations of actor and critic."""


class ObservationPart(BaseFeaturesExtractor):
    """Selects one vector from a dictionary of observations.

    Args:
        observation_space: Space of the dictionary.
        key: Key of the vector.
    """

    def __init__(self, observation_space: Dict, key: str = ACTOR) -> None:
        super().__init__(observation_space, flatdim(observation_space[key]))
        self.key = key

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the selected vectors, shape (n, n_features)."""
        return observations[self.key]


class AsymmetricPolicy(ActorCriticPolicy):
    """Actor and critic without shared layers; their inputs are `observations["policy"]` and `observations["critic"]`.

    Parameters have the same names as in the policies of Stable-Baselines3.

    Args:
        observation_space: A dictionary with vectors "policy" and "critic".
        action_space: Same as for `ActorCriticPolicy`.
        lr_schedule: Same as for `ActorCriticPolicy`.
        **kwargs: Other arguments of `ActorCriticPolicy`, except arguments of feature extractors.

    Raises:
        ValueError: If the observation space is not such a dictionary.
    """

    def __init__(self, observation_space: Space, action_space: Space, lr_schedule: Schedule, **kwargs) -> None:
        if not isinstance(observation_space, Dict) or not {ACTOR, CRITIC} <= set(observation_space):
            raise ValueError(
                f"AsymmetricPolicy: observation space is {observation_space}; expected a dictionary with {ACTOR!r} and "
                f"{CRITIC!r}, as obs_mode='dict' gives it"
            )
        kwargs |= {"features_extractor_class": ObservationPart, "share_features_extractor": False}
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)

    def _build_mlp_extractor(self) -> None:
        """Build layers of both; Stable-Baselines3 itself would give the critic the input size of the actor."""
        self.vf_features_extractor = ObservationPart(self.observation_space, CRITIC)  # type: ignore[arg-type]
        actor, critic = (
            MlpExtractor(part.features_dim, self.net_arch, self.activation_fn, self.device)
            for part in (self.pi_features_extractor, self.vf_features_extractor)
        )
        actor.value_net = critic.value_net
        self.mlp_extractor = actor
