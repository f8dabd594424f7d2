"""Train a policy with PPO of Stable-Baselines3, with the settings and files of the compiled learner.

`PPO.load` of Stable-Baselines3 reads the policy, `policy.zip`. On one machine, interrupted and resumed training
gives the same bits as uninterrupted training.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Mapping
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import FloatSchedule

from ce_gym.adapters.sb3 import SB3VecEnv
from ce_gym.adapters.sb3_asymmetric import AsymmetricPolicy
from ce_gym.learn.runs.job import Job, Trained
from ce_gym.learn.runs.loop import run_learner
from ce_gym.learn.runs.progress import adapted_rate, fall_cost, geometric, linear, spread_episodes
from ce_gym.learn.runs.settings import Settings as Settings  # of this learner
from ce_gym.policies import Actor

TRANSIENT = ["_last_obs", "_last_episode_starts", "_last_original_obs", "ep_info_buffer", "ep_success_buffer"]
"""Attributes of the learner that a saved policy does not need."""


class Episodes(BaseCallback):
    """Subtracts `fall_cost` from the reward of each fall, and returns means of recent episodes."""

    fall_cost = 0.0

    def means(self) -> dict[str, float]:
        """Return the mean of every entry except the time `t`; empty before the first episode ends."""
        recent: Any = self.model.ep_info_buffer
        keys = [key for key in recent[-1] if key != "t"] if recent else []
        return {key: float(np.mean([episode[key] for episode in recent])) for key in keys}

    def _on_step(self) -> bool:
        infos, rewards = self.locals["infos"], self.locals["rewards"]  # of the last step; not in the buffer yet
        for i in np.flatnonzero(self.locals["dones"]):
            if not (infos[i]["TimeLimit.truncated"] or infos[i]["diverged"]):
                rewards[i] -= self.fall_cost
        return True


class SB3Learner:
    """PPO of Stable-Baselines3 as a learner of `ce_gym.learn.runs.loop`.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode.
        job: The training run.

    Attributes:
        model: The learner of Stable-Baselines3.
        episodes: Statistics of recent episodes.
        rate: Learning rate.
        collect_seconds: Time spent in collection so far [s].
    """

    packages = ("stable_baselines3", "torch")

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        s = self.settings = job.settings
        self.envs, self.adapter, self.episodes = envs, SB3VecEnv(envs), Episodes()
        self.rate, self.collect_seconds = s.learning_rate, 0.0
        torch.set_num_threads(job.threads)
        self.adapter.seed(job.seed)
        asymmetric = isinstance(envs.single_observation_space, gymnasium.spaces.Dict)
        self.model = PPO(
            AsymmetricPolicy if asymmetric else "MlpPolicy",
            self.adapter,
            learning_rate=s.learning_rate,
            n_steps=s.rollout,
            batch_size=-(-s.num_envs * s.rollout // s.minibatches),
            n_epochs=s.epochs,
            gamma=s.gamma,
            gae_lambda=s.gae_lambda,
            clip_range=s.clip,
            vf_coef=s.value,
            max_grad_norm=s.max_grad_norm,
            policy_kwargs={
                "net_arch": list(s.hidden),
                "activation_fn": getattr(torch.nn, s.activation),
                "log_std_init": float(np.log(s.initial_std)),
            },
            stats_window_size=s.num_envs,
            seed=job.seed,
            device="cpu",
        )
        self.model.learn(0, self.episodes)  # resets environments and statistics
        spread_episodes(envs.unwrapped, np.random.default_rng(job.seed))

    @property
    def steps(self) -> int:
        """Environment steps done."""
        return self.model.num_timesteps

    @property
    def step_seconds(self) -> float:
        """Time spent inside the environment so far [s]."""
        return self.adapter.step_seconds

    def iterate(self) -> dict[str, float]:
        """Collect a rollout and learn from it; return statistics for the log."""
        s, model, done = self.settings, self.model, min(self.steps / self.settings.steps, 1.0)
        if s.final_std:
            model.policy.log_std.data.fill_(np.log(geometric(s.initial_std, s.final_std, done)))
        if not s.target_kl:
            self.rate = linear(s.learning_rate, 0.0, done)
        model.lr_schedule = FloatSchedule(self.rate)
        model.ent_coef = linear(s.entropy, s.final_entropy, done)
        self.episodes.fall_cost = fall_cost(s.fall_cost, done)
        start = time.perf_counter()
        model.collect_rollouts(self.adapter, self.episodes, model.rollout_buffer, s.rollout)
        self.collect_seconds += time.perf_counter() - start
        model.train()
        figures = {name: float(figure) for name, figure in model.logger.name_to_value.items()}
        model.logger.name_to_value.clear()
        if s.target_kl:
            self.rate = adapted_rate(self.rate, figures["train/approx_kl"], s.target_kl)
        return figures

    def actor(self) -> Actor:
        """Return copies of the layers from observations to mean actions."""
        layers = [*self.model.policy.mlp_extractor.policy_net, self.model.policy.action_net]
        linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
        arrays = tuple((x.weight.detach().numpy().copy(), x.bias.detach().numpy().copy()) for x in linear)
        return Actor(arrays, self.settings.activation)

    def archive(self) -> bytes:
        """Return the content of `policy.zip`."""
        packed = io.BytesIO()
        self.model.save(packed, exclude=TRANSIENT)
        return packed.getvalue()

    def state(self) -> dict[str, NDArray]:
        """Return the state of learner, environments and random numbers as arrays; see `restore`."""
        model, native = self.model, cast(Any, self.envs.unwrapped)
        _, keys, position, *_ = np.random.get_state()  # Stable-Baselines3 shuffles minibatches with it
        facts = {
            "steps": self.steps, "updates": model._n_updates, "rate": self.rate, "position": int(position),
            "network": self._network(), "num_envs": self.envs.num_envs, "episodes": list(model.ep_info_buffer or ()),
        }  # fmt: skip
        state = {
            "facts": np.array(json.dumps(facts)),
            "numpy": np.asarray(keys),
            "torch": torch.get_rng_state().numpy(),
        }
        state |= {f"policy/{name}": tensor.numpy() for name, tensor in model.policy.state_dict().items()}
        for i, moments in model.policy.optimizer.state_dict()["state"].items():
            state |= {f"optimizer/{i}/{name}": tensor.numpy() for name, tensor in moments.items()}
        seen: Any = model._last_obs
        state |= {f"seen/{name}": x for name, x in (seen if isinstance(seen, dict) else {"": seen}).items()}
        if hasattr(native, "snapshot"):
            state |= {f"env/{name}": array for name, array in native.snapshot().items()}
        return state

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Continue from a state; environments are reset if they have no snapshots or their number differs.

        Raises:
            ValueError: If the state has another network.
        """
        model, facts = self.model, json.loads(str(state["facts"]))
        if facts["network"] != self._network():
            raise ValueError(f"has layers {facts['network']}; expected {self._network()}")
        model.policy.load_state_dict({name: torch.tensor(x) for name, x in _part(state, "policy/").items()})
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for name, array in _part(state, "optimizer/").items():
            i, moment = name.split("/")
            moments.setdefault(int(i), {})[moment] = torch.tensor(array)
        groups = model.policy.optimizer.state_dict()["param_groups"]
        model.policy.optimizer.load_state_dict({"state": moments, "param_groups": groups})
        model.num_timesteps, model._n_updates, self.rate = facts["steps"], facts["updates"], facts["rate"]
        np.random.set_state(("MT19937", state["numpy"], facts["position"], 0, 0.0))
        torch.set_rng_state(torch.tensor(state["torch"]))
        snapshot, seen = _part(state, "env/"), _part(state, "seen/")
        if snapshot and facts["num_envs"] == self.envs.num_envs:
            native: Any = self.envs.unwrapped
            native.restore(snapshot)
            model._last_obs = seen.get("", seen)
            cast(Any, model.ep_info_buffer).extend(facts["episodes"])

    def _network(self) -> list[Any]:
        """Return the sizes of the layers of actor and critic, and the activation."""
        weights = [x.shape for name, x in self.model.policy.state_dict().items() if name.endswith("weight")]
        return [*(list(shape) for shape in weights), self.settings.activation]


def _part(state: Mapping[str, NDArray], prefix: str) -> dict[str, NDArray]:
    """Return the arrays whose names have a prefix, by the rest of the name."""
    return {name.removeprefix(prefix): array for name, array in state.items() if name.startswith(prefix)}


def train(job: Job) -> Trained:
    """Train, and save the policy even if Ctrl-C ends training early.

    Raises:
        PolicyError: If the policy to resume does not fit the environment or the settings.
    """
    return run_learner(SB3Learner, job)
