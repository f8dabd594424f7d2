"""Train a legged robot with PPO of Stable-Baselines3 (SB3), in one file to read from top to bottom.

    pip install "ce_gym[sb3]"
    python train/ppo.py
    python train/ppo.py --transmission armature --hidden 128 64 --rewards '{"torques": -4e-4, "feet_air_time": 0}'
    python train/ppo.py --env ce_gym/Go2Velocity-v0 --steps 6_000_000 --out runs/go2

Change the defaults in `Settings`, or give another value on the command line. To change

- the robot or the task: `env`. `python -m ce_gym list` prints all ids. `my_module:my/Robot-v0` imports `my_module`.
  Other quadrupeds: 6 to 8 million `steps`; bipeds: 18 to 24 million, `num_envs` 1024, `hidden` 128 128. These values
  are from train/config for `python -m ce_gym train`, which also has `fall_cost` and pushes.
- a reward: `rewards`. docs/reference/terms.md lists the terms; an example of a new term is below.
- terrain, pushes, random masses: `env_kwargs` in the function `train()`, see docs/reference/task_arguments.md.
- the network or the algorithm: `hidden`, and `network` and the arguments of `PPO` of SB3 in the function `train()`.
"""

import json
import sys
from argparse import ArgumentTypeError
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
from ce_gym.console import Parser, add_force_argument
from ce_gym.files import set_force
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.learn.evaluation.evaluation import evaluate, report
from ce_gym.learn.runs.folder import run_folder
from ce_gym.policies import load_policy, save

# A new reward term: remove the `#`. Other commands import this file, by `ppo:` before the id, and find the term.
# import ce_gym
# @ce_gym.reward
# def forward_speed(s):  # s: docs/reference/terms.md
#     return s.base_linear_velocity[0]
# python train/ppo.py --rewards '{"forward_speed": 0.5}'
# PYTHONPATH=train python -m ce_gym evaluate runs/ppo --env ppo:ce_gym/MiniCheetahVelocity-v0


def option(default: Any, text: str) -> Any:
    """Return a field of `Settings` with its text for `--help`."""
    return field(default=default, metadata={"help": f"{text} (default {default})"})


@dataclass
class Settings:
    """Settings of a training run, with values for Mini Cheetah."""

    env: str = option("ce_gym/MiniCheetahVelocity-v0", "environment id")
    transmission: str | None = option(None, "exact, coupled, armature, none or elastic; None takes the id's")
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


def read_rewards(text: str) -> dict[str, Any]:
    """Return the default weights after a JSON object has added or replaced some."""
    try:
        return Settings().rewards | json.loads(text)
    except (ValueError, TypeError):
        raise ArgumentTypeError(f'{text!r}; expected JSON such as {{"torques": -4e-4}}') from None


def parse_settings(argv: list[str] | None = None) -> Settings:
    """Read the settings from the command line."""
    parser = Parser(description="Train a legged robot with PPO of Stable-Baselines3.")
    readers = {tuple: int, dict: read_rewards, type(None): str}
    for setting, default in zip(fields(Settings), vars(Settings()).values(), strict=True):
        kind, name = type(default), f"--{setting.name.replace('_', '-')}"
        options = {**setting.metadata, "nargs": "+"} if kind is tuple else setting.metadata
        parser.add_argument(name, type=readers.get(kind, kind), default=default, metavar="X", **options)
    add_force_argument(parser)
    settings = vars(parser.parse_args(argv))
    set_force(settings.pop("force"))
    return Settings(**settings)


class Report(BaseCallback):
    """Logs reward terms and metrics of recent episodes for TensorBoard; prints their mean reward and metrics."""

    def _on_training_start(self) -> None:
        # The first episodes end at different times, so that robots do not all get new commands in the same step.
        robots = self.training_env.unwrapped.envs.unwrapped  # type: ignore[attr-defined]
        rng = np.random.default_rng(self.model.seed)
        robots.elapsed_steps = rng.integers(0, robots.max_episode_steps, robots.num_envs)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        episodes = self.model.ep_info_buffer  # return `r`, length `l`, time `t`, `reward/...`, `metrics/...` of each
        rollouts = self.n_calls // self.model.n_steps  # type: ignore[attr-defined]
        if rollouts == 1:
            print(f"{self.num_timesteps:>11,} steps; rewards follow after every tenth rollout", flush=True)
        if not episodes:
            return
        means = {name: float(np.mean([episode[name] for episode in episodes])) for name in episodes[-1]}
        for name in means.keys() - {"r", "l", "t"}:  # SB3 logs these itself
            self.logger.record(name, means[name])
        if rollouts % 10 == 0:
            metrics = [f"{key.split('/')[1]} {mean:.3f}" for key, mean in means.items() if key.startswith("metrics/")]
            print(f"{self.num_timesteps:>11,} steps  reward {means['r']:6.2f} ", *metrics, flush=True)


def train(s: Settings) -> Path:
    """Train a policy, and return its path."""
    torch.set_num_threads(s.threads)
    env_kwargs: dict[str, Any] = {"rewards": s.rewards} | ({"transmission": s.transmission} if s.transmission else {})
    envs = make_sb3_vec_env(s.env, s.num_envs, s.seed, num_threads=s.threads, **env_kwargs)
    network = {"net_arch": list(s.hidden), "activation_fn": torch.nn.Tanh, "log_std_init": float(np.log(s.initial_std))}
    model = PPO(
        "MlpPolicy", envs, policy_kwargs=network, seed=s.seed, device="cpu",
        learning_rate=LinearSchedule(s.learning_rate, 0.0, 1.0), max_grad_norm=1.0,
        n_steps=s.n_steps, batch_size=s.batch_size, n_epochs=s.n_epochs, gamma=s.gamma, ent_coef=s.ent_coef,
        stats_window_size=s.num_envs, tensorboard_log=s.out,
    )  # fmt: skip
    model.learn(s.steps, Report())
    model.save(Path(s.out) / "model.zip")  # for PPO.load of SB3
    return save(model, envs, Path(s.out) / "policy.npz")  # for `python -m ce_gym evaluate`, `play`, `export` and others


def main(argv: list[str] | None = None) -> int:
    """Train, and evaluate the policy on exact transmissions and on armatures, their usual simplification."""
    s = parse_settings(argv)
    if ":" not in s.env and any(name in globals() for name in s.rewards):
        s.env = f"ppo:{s.env}"  # so that other commands find the terms of this file
    with run_folder(Path(s.out)):
        path = train(s)
    policy = load_policy(path)
    for level in ("exact", "armature"):
        result = evaluate(policy, s.env, **policy.record["env_kwargs"] | {"transmission": level})
        print(f"\non {level} transmissions\n{report(result)}")
    place = "PYTHONPATH=train " if s.env.startswith("ppo:") else ""
    print(f"\n{place}python -m ce_gym play {path}" + (f" --env {s.env}" if ":" in s.env else ""))
    return 0


if __name__ == "__main__":
    sys.exit(run(in_one_line(main)))
