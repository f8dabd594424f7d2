"""rsl_rl's `VecEnv` over a native Gymnasium `VectorEnv`: arrays shown as tensors, without copies; a GPU's stay there.

rsl_rl (5.x, https://github.com/leggedrobotics/rsl_rl) never resets environments; it wants observations as groups in a
`TensorDict`, time-outs apart from failures, and the end of an episode to be followed at once by the next.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from rsl_rl.env import VecEnv
from tensordict import TensorDict

POLICY = "policy"
"""Group of observations that come as one vector."""


class RslRlVecEnv(VecEnv):
    """A batch of environments as rsl_rl expects it.

    Observations that come as a dictionary are groups by their keys, others the one group "policy"; so `obs_groups` of a
    runner is `{"actor": ["policy"], "critic": ["critic"]}` or `{"actor": ["policy"], "critic": ["policy"]}`.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode that returns fresh arrays from every call.
        seed: Of the first reset, see `gymnasium.vector.VectorEnv.reset`.
        device: Where tensors go; physics is where `envs` has it.

    Attributes:
        envs: The wrapped environment.
        num_envs: Number of environments.
        num_actions: Length of an action.
        max_episode_length: Control steps until time is up.
        device: Where tensors go.
        cfg: What the logger records of the environment.

    Raises:
        ValueError: If `envs` resets in another mode.
    """

    def __init__(self, envs: VectorEnv, seed: int | None = 0, device: str | torch.device = "cpu") -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"RslRlVecEnv: autoreset_mode is {mode}, expected {AutoresetMode.SAME_STEP}")
        native: Any = envs.unwrapped
        self.envs, self._native = envs, native
        self._on_gpu = isinstance(getattr(native, "device", None), torch.device)
        self.num_envs, self.device = envs.num_envs, device
        self.num_actions = int(np.prod(envs.single_action_space.shape or (0,)))
        self.max_episode_length = int(native.max_episode_steps)
        self.cfg = {"env": envs.spec.id if envs.spec else type(native).__name__, "num_envs": envs.num_envs}
        obs, _ = envs.reset(seed=seed)
        self._observations = self._groups(obs)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps since each episode began, shape (num_envs,); set to spread the first ends of episodes."""
        return self._tensor(self._native.elapsed_steps)

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._native.elapsed_steps = steps if self._on_gpu else steps.cpu().numpy()

    def get_observations(self) -> TensorDict:
        """Return the current observations, each group of shape (num_envs, n)."""
        return self._observations

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Step all environments; those that are done show the first observation of their next episode.

        Args:
            actions: Shape (num_envs, num_actions).

        Returns:
            Observations, rewards (num_envs,), dones (num_envs,), and extras: `time_outs` (num_envs,), episodes that
            ended without a failure; `log`, means over the episodes that have just ended.
        """
        given: Any = actions.detach() if self._on_gpu else actions.detach().cpu().numpy()
        obs, rewards, terminated, truncated, infos = self.envs.step(given)
        self._observations = self._groups(obs)
        dones = terminated | truncated
        extras: dict[str, Any] = {"time_outs": self._tensor(truncated & ~terminated), "log": {}}
        if dones.any():
            terms = infos.get("episode_terms", {})
            extras["log"] = {f"/episode/{key}": float(rows[dones].mean()) for key, rows in terms.items()}
        return self._observations, self._tensor(rewards).float(), self._tensor(dones), extras

    def close(self) -> None:
        """Close the wrapped environment."""
        self.envs.close()

    def _groups(self, obs: Any) -> TensorDict:
        groups = obs if isinstance(obs, Mapping) else {POLICY: obs}
        tensors = {key: self._tensor(rows) for key, rows in groups.items()}
        return TensorDict(tensors, batch_size=[self.num_envs], device=self.device)  # type: ignore[arg-type]

    def _tensor(self, rows: np.ndarray | torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(rows).to(self.device)


def make_rsl_rl_vec_env(
    env_id: str, num_envs: int = 1, seed: int | None = 0, device: str | torch.device = "cpu", **kwargs: Any
) -> RslRlVecEnv:
    """Make `num_envs` environments of a registered id, ready for rsl_rl.

    Args:
        env_id: Such as `"ce_gym/MiniCheetahVelocity-v0"`.
        num_envs: Size of the batch.
        seed: Environment i gets `seed + i`. None seeds from the operating system.
        device: Where tensors go; with "cuda" or "cuda:N", physics is there too.
        **kwargs: Given to the environment, such as `transmission="armature"` or `obs_mode="dict"`.

    Raises:
        gymnasium.error.Error: If the id is unknown or has no native vector environment.
    """
    mode = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    place = {"device": str(device)} if torch.device(device).type == "cuda" else {}
    options = {"autoreset_mode": AutoresetMode.SAME_STEP, **place, **kwargs}
    return RslRlVecEnv(gymnasium.make_vec(env_id, num_envs=num_envs, vectorization_mode=mode, **options), seed, device)
