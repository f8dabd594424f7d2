"""Train a policy with PPO: any registered environment, any transmission level, from one settings file.

Writes into the output folder: `policy.zip` (Stable-Baselines3), `policy.json` (what it was trained on), `progress.csv`,
`curve.csv` (how learning went, from the very beginning), TensorBoard logs and `checkpoints/`. Uses public names of
ce_gym only, and no name of a robot or task.

    python train/ppo.py --env ce_gym/MiniCheetahVelocity-v0
    python train/ppo.py --env ce_gym/MiniCheetahVelocity-v0 --transmission armature --seeds 0 1 2
    python train/ppo.py --env ce_gym/MiniCheetahVelocity-v0 --critic contact_forces feet_in_contact
    python train/ppo.py --resume runs/mini_cheetah_velocity/policy.zip --steps 20e6
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import gymnasium
import torch
from callbacks import (
    AdaptiveLearningRate,
    Checkpoints,
    EntropySchedule,
    EpisodeLog,
    NoiseSchedule,
    ShowProgress,
    Stop,
    WriteCurve,
)
from evaluate import PolicyError
from job import CHECKPOINTS, Job, Trained, make_record
from job import main as run_jobs
from learner import ThreadedPPO
from progress import StopInOrder, read_curve
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import FloatSchedule

from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env
from ce_gym.adapters.sb3_asymmetric import AsymmetricPolicy

TRANSIENT = ["_last_obs", "_last_episode_starts", "_last_original_obs", "ep_info_buffer", "ep_success_buffer"]
"""What the learner holds that is of no use in a saved policy."""


def train(job: Job) -> Trained:
    """Train, and save the policy even if Ctrl-C ends training early.

    Raises:
        PolicyError: If the policy to resume does not fit the environment or the settings.
    """
    torch.set_num_threads(1)  # threads belong to the learner and to the kernel, see learner.py
    job.out.mkdir(parents=True, exist_ok=True)
    envs = make_sb3_vec_env(
        job.env_id, job.settings.num_envs, job.seed, num_threads=job.threads, **job.env_kwargs
    )  # fmt: skip
    try:
        model = make_learner(envs, job)
        return _learn(model, envs, job)
    finally:
        envs.close()


def _learn(model: PPO, envs: SB3VecEnv, job: Job) -> Trained:
    """Run the learner to the end, to the deadline or to Ctrl-C, and save."""
    model.set_logger(configure(str(job.out), ["csv", "tensorboard"] if job.tensorboard else ["csv"]))
    settings, before = job.settings, model.num_timesteps
    earlier = read_curve(job.resume.parent / "curve.csv") if job.resume else []
    start = time.perf_counter()

    def record(finished: bool = False) -> dict[str, Any]:
        seconds = time.perf_counter() - start
        written = make_record(job, envs.envs.unwrapped, model.num_timesteps, seconds, ("stable_baselines3", "torch"))
        return written | {"activation": model.policy.activation_fn.__name__, "finished": finished}  # type: ignore[union-attr]

    def checkpoint() -> None:
        save(model, record(), job.out / "checkpoints" / f"policy_{model.num_timesteps}")

    with StopInOrder(job.seconds) as stop:
        callbacks = [Stop(stop), Checkpoints(checkpoint, settings.steps // CHECKPOINTS), EpisodeLog()]
        callbacks += [WriteCurve(job.out / "curve.csv", earlier), ShowProgress(settings.steps)]
        callbacks.append(EntropySchedule(settings.entropy, settings.final_entropy, settings.steps))
        if settings.final_std:
            callbacks.append(NoiseSchedule(settings.initial_std, settings.final_std, settings.steps))
        if settings.target_kl:
            callbacks.append(AdaptiveLearningRate(settings.target_kl))
        if before < settings.steps:
            model.learn(settings.steps - before, callbacks, reset_num_timesteps=False)  # type: ignore[arg-type]
    model.logger.close()
    written = record(finished=not stop.interrupted)
    return Trained(model, written, save(model, written, job.out / "policy"), stop.interrupted)


def make_learner(envs: SB3VecEnv, job: Job) -> PPO:
    """A fresh learner, or the one saved in `job.resume` with the settings of this job.

    Raises:
        PolicyError: If the saved policy does not fit the environment or the settings.
    """
    s = job.settings
    network = {
        "net_arch": list(s.hidden),
        "activation_fn": getattr(torch.nn, s.activation),
        "log_std_init": float(torch.tensor(s.initial_std).log()),
        "ortho_init": True,
    }
    options: dict[str, Any] = {
        "learning_rate": s.learning_rate,
        "n_steps": s.rollout,
        "batch_size": -(-s.num_envs * s.rollout // s.minibatches),
        "n_epochs": s.epochs,
        "gamma": s.gamma,
        "gae_lambda": s.gae_lambda,
        "clip_range": s.clip,
        "ent_coef": s.entropy,
        "vf_coef": s.value,
        "max_grad_norm": s.max_grad_norm,
        "stats_window_size": s.num_envs,
        "device": "cpu",
    }
    if job.resume is None:
        policy = AsymmetricPolicy if isinstance(envs.observation_space, gymnasium.spaces.Dict) else "MlpPolicy"
        model = ThreadedPPO(policy, envs, policy_kwargs=network, seed=job.seed, **options)
        model.threads = job.threads
        return model
    try:
        model = ThreadedPPO.load(job.resume, envs, **options)
    except ValueError as error:
        raise PolicyError(f"{job.resume}: does not fit {job.env_id}: {error}") from None
    model.threads = job.threads
    if s.target_kl:  # go on with the rate it had been adapted to
        model.lr_schedule = FloatSchedule(model.policy.optimizer.param_groups[0]["lr"])
    return model


def save(model: PPO, record: dict[str, Any], path: Path) -> Path:
    """Write `path`.zip and `path`.json, each whole or not at all, and return the path of the policy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(f".{path.name}.zip")
    model.save(fresh, exclude=TRANSIENT)
    text = path.with_name(f".{path.name}.json")
    text.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    os.replace(text, path.with_name(f"{path.name}.json"))
    return fresh.replace(path.with_name(f"{path.name}.zip"))


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    return run_jobs("ppo.py", train, argv)


if __name__ == "__main__":
    raise SystemExit(main())
