"""Stable-Baselines3's `VecEnv` for a native Gymnasium `VectorEnv`, without processes and without copies.

Stable-Baselines3 expects one information dictionary per environment and step. Building thousands of dictionaries takes
longer than the physics. So all running environments share one empty dictionary, and only environments whose episode
has just ended get a new one.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from ce_gym.policies import import_module_of

_RUNNING: dict[str, Any] = {}
"""Information dictionary of every environment whose episode continues; shared, so it must not be changed."""


class SB3VecEnv(VecEnv):
    """A batch of environments with the interface of Stable-Baselines3.

    Arrays are passed on without copies; tensors on a GPU are copied to the host, because Stable-Baselines3 needs numpy
    arrays. Stable-Baselines3 keeps observations for later and changes rewards in place, so the wrapped environment must
    return new arrays from every call, as environments of ce_gym do.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode.

    Attributes:
        envs: The wrapped environment.
        step_seconds: Wall time spent inside `envs.step` so far [s].

    Raises:
        ValueError: If `envs` has another autoreset mode.
    """

    def __init__(self, envs: VectorEnv) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"SB3VecEnv: autoreset_mode is {mode}, expected {AutoresetMode.SAME_STEP}")
        self.envs = envs
        self.step_seconds = 0.0
        self._actions = np.zeros(0, np.float32)
        self._start = time.monotonic()
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Reset all environments with the seed and options that were set since the last reset.

        Returns:
            Observations, shape (num_envs, n_obs), or a dictionary of such arrays.
        """
        obs = _on_host(self.envs.reset(seed=self._seeds[0], options=self._options[0] or None)[0])
        self._reset_seeds()
        self._reset_options()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Remember `actions`, shape (num_envs, n_act), for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments.

        Returns:
            Observations as in `reset`, rewards (num_envs,), dones (num_envs,) and one dictionary per environment.
            An environment that is done returns the first observation of its next episode. Its dictionary has the last
            observation of the old episode as `terminal_observation`, `TimeLimit.truncated`, and `episode`.
        """
        start = time.perf_counter()
        obs, rewards, terminated, truncated, infos = map(_on_host, self.envs.step(self._actions))
        self.step_seconds += time.perf_counter() - start
        dones = terminated | truncated
        return obs, rewards.astype(np.float32, copy=False), dones, self._dicts(dones, truncated & ~terminated, infos)

    def _dicts(self, dones: np.ndarray, timed_out: np.ndarray, infos: dict[str, Any]) -> list[dict[str, Any]]:
        """Return one dictionary per environment; the shared empty one where the episode continues."""
        dicts = [_RUNNING] * self.num_envs
        ended = np.flatnonzero(dones)
        if not len(ended):
            return dicts
        diverged = infos.get("diverged", np.zeros(self.num_envs, bool))
        episodes = self._episodes(ended, infos)
        for i, episode in zip(ended.tolist(), episodes, strict=True):
            dicts[i] = {
                "terminal_observation": _row(infos["final_obs"], i),
                "TimeLimit.truncated": bool(timed_out[i]),
                "diverged": bool(diverged[i]),
                "episode": episode,
            }
        return dicts

    def _episodes(self, ended: np.ndarray, infos: dict[str, Any]) -> list[dict[str, float]]:
        """Return return `r`, length `l`, time `t`, reward terms and metrics of each episode that has just ended."""
        columns = {key: np.asarray(values)[ended] for key, values in _episode_entries(infos).items()}
        columns["t"] = np.full(len(ended), time.monotonic() - self._start)
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return [dict(zip(columns, row, strict=True)) for row in rows]

    def close(self) -> None:
        """Close the wrapped environment."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the batch, once for each environment in `indices`.

        Raises:
            AttributeError: If the wrapped environment has no such attribute.
        """
        owner = self.envs if hasattr(self.envs, attr_name) else self.envs.unwrapped
        return [getattr(owner, attr_name)] * self._count(indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the whole batch.

        Raises:
            ValueError: If `indices` names only some of the environments.
        """
        self._require_all(attr_name, indices)
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list:
        """Call a method of the batch once and return its result, once for each environment.

        Raises:
            ValueError: If `indices` names only some of the environments.
        """
        self._require_all(method_name, indices)
        owner = self.envs if hasattr(self.envs, method_name) else self.envs.unwrapped
        return [getattr(owner, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return True for `Monitor` only, whose `episode` entry this class supplies and SB3's evaluation needs."""
        return [issubclass(wrapper_class, Monitor)] * self._count(indices)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return one rendered image per environment."""
        frames: Any = self.envs.render()
        return list(frames or ())

    def _count(self, indices: VecEnvIndices) -> int:
        """Return the number of environments in `indices`."""
        return len(list(self._get_indices(indices)))

    def _require_all(self, name: str, indices: VecEnvIndices) -> None:
        """Refuse to change only some of the environments: the batch is one object.

        Raises:
            ValueError: If `indices` does not contain all environments.
        """
        named: Iterable[int] = self._get_indices(indices)
        if set(named) != set(range(self.num_envs)):
            raise ValueError(f"{name}: indices is {indices}, expected None: the batch is one environment object")


def _on_host(value: Any) -> Any:
    """Return arrays unchanged and tensors as copies on the host; also inside dictionaries."""
    if isinstance(value, Mapping):
        return {key: _on_host(part) for key, part in value.items()}
    return value.cpu().numpy() if hasattr(value, "cpu") else value


def _row(observations: Any, i: int) -> Any:
    """Return the observation of environment `i` from an array, or a dictionary of arrays, with one row for each."""
    if isinstance(observations, Mapping):
        return {key: rows[i] for key, rows in observations.items()}
    return observations[i]


def _episode_entries(infos: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return statistics of ended episodes, shape (num_envs,) each, with the names of Stable-Baselines3.

    Environments of ce_gym report `episode_terms`; others report `episode`, by Gymnasium's `RecordEpisodeStatistics`.
    """
    if "episode_terms" not in infos:
        return infos["episode"]
    terms = dict(infos["episode_terms"])
    return {"r": terms.pop("return"), "l": terms.pop("length"), **terms}


def make_sb3_vec_env(env_id: str, num_envs: int = 1, seed: int | None = 0, **kwargs: Any) -> SB3VecEnv:
    """Return a batch of environments with the interface of Stable-Baselines3.

    Args:
        env_id: Registered id, such as `"ce_gym/MiniCheetahVelocity-v0"`; `"my_module:id"` imports `my_module` first.
        num_envs: Number of environments.
        seed: Seed of the first reset; environment i gets `seed + i`. None seeds from the operating system.
        **kwargs: Arguments of the environment, such as `transmission="armature"`, `num_threads=2` or `obs_mode="dict"`
            for "MultiInputPolicy" and `AsymmetricPolicy`.

    Returns:
        The batch, not yet reset.

    Raises:
        gymnasium.error.Error: If the id is unknown or has no native vector environment.
        ValueError: If an argument is wrong.

    Examples:
        >>> envs = make_sb3_vec_env("ce_gym/MiniCheetahVelocity-v0", num_envs=64)
        >>> envs.reset().shape
        (64, 48)
        >>> observations, rewards, dones, infos = envs.step(np.zeros((64, 12), np.float32))
        >>> print(rewards.shape, dones.any())
        (64,) False
    """
    mode = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    options = {"autoreset_mode": AutoresetMode.SAME_STEP, **kwargs}
    try:
        name = import_module_of(env_id)
        envs = gymnasium.make_vec(name, num_envs=num_envs, vectorization_mode=mode, **options)
    except (TypeError, ImportError) as error:  # an unknown argument or module
        raise ValueError(f"environment {env_id!r}: {error}") from error
    if spec := envs.unwrapped.spec:
        spec.id = env_id.removesuffix(name) + spec.id  # `ce_gym.policies.save` records the module too
    adapted = SB3VecEnv(envs)
    if seed is not None:
        adapted.seed(seed)
    return adapted
