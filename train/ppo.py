"""Train a legged robot with PPO of Stable-Baselines3 (SB3), in one file to read from top to bottom.

    pip install "ce_gym[sb3]"
    python train/ppo.py
    python train/ppo.py --transmission armature --hidden 128 64 --rewards '{"torques": -4e-4, "feet_air_time": 0}'
    python train/ppo.py --env ce_gym/Go2Velocity-v0 --out runs/go2

Change the defaults in `Settings`, or give another value on the command line. To change

- the robot or the task: `env`. `python -m ce_gym list` prints all ids. `my_module:my/Robot-v0` imports `my_module`.
- a reward: `rewards`. docs/reference/terms.md lists the terms, docs/how-to/own_task.md shows how to write a new one.
- terrain, pushes, random masses: `env_kwargs` in `train`, see docs/reference/task_arguments.md.
- the network: `hidden` for its size, and `policy_kwargs` in `train` for its activation and other networks of SB3.
- the algorithm: `PPO(...)` in `train`, with the arguments of SB3.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from ce_gym.__main__ import run
from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.console import Parser
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.learn.evaluation.evaluation import evaluate, report
from ce_gym.policies import load_policy, save


def option(default: Any, text: str) -> Any:
    """Return a field of `Settings` with its text for `--help`."""
    return field(default=default, metadata={"help": f"{text} (default {default})"})


@dataclass
class Settings:
    """Settings of a training run, with values for Mini Cheetah."""

    env: str = option("ce_gym/MiniCheetahVelocity-v0", "environment id")
    transmission: str = option("exact", "exact, coupled, armature, none or elastic")
    rewards: dict[str, Any] = field(default_factory=dict, metadata={"help": "weights of reward terms to change, JSON"})
    out: str = option("runs/ppo", "folder to write to")
    seed: int = option(0, "seed of weights, noise and environments")
    threads: int = option(1, "processor threads; small networks are fastest with one")

    steps: int = option(4_000_000, "control steps of all robots together")
    num_envs: int = option(512, "robots in parallel")
    n_steps: int = option(24, "control steps of each robot between two updates")
    batch_size: int = option(3072, "samples of a minibatch")
    n_epochs: int = option(3, "passes over the samples in each update")
    learning_rate: float = option(3e-3, "learning rate at the start; falls linearly to 0")
    gamma: float = option(0.98, "discount per control step")
    ent_coef: float = option(0.001, "weight of the entropy bonus")

    hidden: tuple[int, ...] = option((64, 64), "sizes of the hidden layers of policy and value")
    initial_std: float = option(0.6, "standard deviation of the actions at the start; actions lie in -1..1")


def parse_settings(argv: list[str] | None = None) -> Settings:
    """Read the settings from the command line."""
    parser = Parser(description="Train a legged robot with PPO of Stable-Baselines3.")
    readers = {tuple: int, dict: json.loads}
    for setting, default in zip(fields(Settings), vars(Settings()).values(), strict=True):
        kind, name = type(default), f"--{setting.name.replace('_', '-')}"
        options: dict[str, Any] = {"nargs": "+"} if kind is tuple else {}
        help_text = setting.metadata["help"]
        parser.add_argument(name, type=readers.get(kind, kind), default=default, metavar="X", help=help_text, **options)
    return Settings(**vars(parser.parse_args(argv)))


class Report(BaseCallback):
    """Logs means of recent episodes for TensorBoard, and prints rewards and metrics after every tenth rollout."""

    def _on_training_start(self) -> None:
        # The first episodes end at different times, so that robots do not all get new commands in the same step.
        robots = self.training_env.unwrapped.envs.unwrapped  # type: ignore[attr-defined]
        rng = np.random.default_rng(self.model.seed)
        robots.elapsed_steps = rng.integers(0, robots.max_episode_steps, robots.num_envs)
        self.rollouts = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        episodes = self.model.ep_info_buffer  # return `r`, length `l`, time `t`, `reward/...`, `metrics/...` of each
        self.rollouts += 1
        if not episodes:
            return
        means = {name: float(np.mean([episode[name] for episode in episodes])) for name in episodes[-1]}
        for name in means.keys() - {"r", "l", "t"}:  # SB3 logs these itself
            self.logger.record(name, means[name])
        if self.rollouts % 10 == 0:
            metrics = [
                f"{name.split('/')[1]} {mean:.3f}" for name, mean in means.items() if name.startswith("metrics/")
            ]
            print(f"{self.num_timesteps:>11,} steps  reward {means['r']:6.2f} ", *metrics, flush=True)


def train(s: Settings) -> Path:
    """Train a policy, and return its path."""
    torch.set_num_threads(s.threads)
    env_kwargs: dict[str, Any] = {"transmission": s.transmission, "rewards": s.rewards}
    envs = make_sb3_vec_env(s.env, s.num_envs, s.seed, num_threads=s.threads, **env_kwargs)
    model = PPO(
        "MlpPolicy",
        envs,
        learning_rate=LinearSchedule(s.learning_rate, 0.0, 1.0),
        n_steps=s.n_steps,
        batch_size=s.batch_size,
        n_epochs=s.n_epochs,
        gamma=s.gamma,
        ent_coef=s.ent_coef,
        max_grad_norm=1.0,
        policy_kwargs={
            "net_arch": list(s.hidden),
            "activation_fn": torch.nn.Tanh,
            "log_std_init": float(np.log(s.initial_std)),
        },
        stats_window_size=s.num_envs,
        tensorboard_log=s.out,
        seed=s.seed,
        device="cpu",
    )
    model.learn(s.steps, Report())
    model.save(Path(s.out) / "model.zip")  # for PPO.load of SB3
    return save(model, envs, Path(s.out) / "policy.npz")  # for `python -m ce_gym evaluate`, `play`, `export` and others


def main(argv: list[str] | None = None) -> int:
    """Train, and evaluate the policy on exact transmissions and on armatures, their usual simplification."""
    path = train(parse_settings(argv))
    policy = load_policy(path)
    for level in ("exact", "armature"):
        result = evaluate(policy, policy.record["env"], **policy.record["env_kwargs"] | {"transmission": level})
        print(f"\non {level} transmissions\n{report(result)}")
    print(f"\npython -m ce_gym play {path}")
    return 0


if __name__ == "__main__":
    sys.exit(run(in_one_line(main)))
