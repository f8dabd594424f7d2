"""rsl_rl's `VecEnv` for a native Gymnasium `VectorEnv`: arrays become tensors without copies; GPU data stays there.

rsl_rl (5.x, https://github.com/leggedrobotics/rsl_rl) never resets environments. It expects groups of observations in a
`TensorDict`, time-outs separate from failures, and the first observation of the next episode when one ends.
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
"""Name of the group if observations are one vector."""


class RslRlVecEnv(VecEnv):
    """A batch of environments with the interface of rsl_rl.

    Each key of a dictionary observation is a group; a vector observation is the group "policy". So `obs_groups` of a
    runner is `{"actor": ["policy"], "critic": ["critic"]}` or `{"actor": ["policy"], "critic": ["policy"]}`.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode that returns new arrays from every call.
        seed: Seed of the first reset, see `gymnasium.vector.VectorEnv.reset`.
        device: Device of the tensors; the device of the physics is chosen in `envs`.

    Attributes:
        envs: The wrapped environment.
        num_envs: Number of environments.
        num_actions: Length of an action.
        max_episode_length: Time limit of an episode [control steps].
        device: Device of the tensors.
        cfg: Data about the environment for the logger.

    Raises:
        ValueError: If `envs` has another autoreset mode.
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
        """Control steps since each episode began, shape (num_envs,); rsl_rl sets them to spread ends of episodes."""
        return self._tensor(self._native.elapsed_steps)

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._native.elapsed_steps = steps if self._on_gpu else steps.cpu().numpy()

    def get_observations(self) -> TensorDict:
        """Return the current observations, each group of shape (num_envs, n)."""
        return self._observations

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Step all environments; one that is done returns the first observation of its next episode.

        Args:
            actions: Shape (num_envs, num_actions).

        Returns:
            Observations, rewards (num_envs,), dones (num_envs,), and extras: `time_outs` (num_envs,), whether the
            episode ended without a failure; `log`, means over the episodes that ended in this step.
        """
        on_device: Any = actions.detach() if self._on_gpu else actions.detach().cpu().numpy()
        obs, rewards, terminated, truncated, infos = self.envs.step(on_device)
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
    """Return a batch of environments with the interface of rsl_rl.

    Args:
        env_id: Registered id, such as `"ce_gym/MiniCheetahVelocity-v0"`.
        num_envs: Number of environments.
        seed: Environment i gets `seed + i`. None seeds from the operating system.
        device: Device of the tensors; with "cuda" or "cuda:N" also of the physics.
        **kwargs: Arguments of the environment, such as `transmission="armature"` or `obs_mode="dict"`.

    Raises:
        gymnasium.error.Error: If the id is unknown or has no native vector environment.
    """
    mode = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    place = {"device": str(device)} if torch.device(device).type == "cuda" else {}
    options = {"autoreset_mode": AutoresetMode.SAME_STEP, **place, **kwargs}
    return RslRlVecEnv(gymnasium.make_vec(env_id, num_envs=num_envs, vectorization_mode=mode, **options), seed, device)
