"""Train a policy with PPO of Stable-Baselines3: any registered environment, any transmission level.

Writes to the output folder: `policy.zip` (Stable-Baselines3), `policy.json` (the record), `progress.csv`, and
`checkpoints/`.

    python train/ppo.py --env ce_gym/MiniCheetahVelocity-v0
    python train/ppo.py --env ce_gym/MiniCheetahVelocity-v0 --transmission armature --seeds 0 1 2
    python train/ppo.py --env ce_gym/MiniCheetahVelocity-v0 --critic contact_forces feet_in_contact
    python train/ppo.py --resume runs/mini_cheetah_velocity/policy.zip --steps 20e6
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env
from ce_gym.adapters.sb3_asymmetric import AsymmetricPolicy
from ce_gym.learn.learners.sb3_callbacks import (
    AdaptiveLearningRate,
    Checkpoints,
    EntropySchedule,
    EpisodeLog,
    FallCost,
    KeepPresent,
    NoiseSchedule,
    ShowProgress,
    SpreadEpisodes,
    Stop,
    WriteLog,
)
from ce_gym.learn.runs.folder import continue_if_full, make_folder, save_somewhere, write_whole
from ce_gym.learn.runs.job import CHECKPOINTS, Clock, Job, Trained, acting_environment, make_record, resumed_record
from ce_gym.learn.runs.logs import open_writers
from ce_gym.learn.runs.page import Present
from ce_gym.learn.runs.progress import Log, StopInOrder
from ce_gym.learn.runs.settings import Settings as Settings  # of this learner
from ce_gym.policies import PolicyError, read_weights

TRANSIENT = ["_last_obs", "_last_episode_starts", "_last_original_obs", "ep_info_buffer", "ep_success_buffer"]
"""Attributes of the learner that a saved policy does not need."""


def train(job: Job) -> Trained:
    """Train, and save the policy even if Ctrl-C or SIGTERM ends training early.

    Raises:
        PolicyError: If the policy to resume does not fit the environment or the settings.
    """
    torch.set_num_threads(job.threads)
    make_folder(job.out)
    options = {"num_threads": job.threads, **job.env_kwargs, **job.settings.training}
    envs = make_sb3_vec_env(job.env_id, job.settings.num_envs, job.seed, **options)
    try:
        model = make_learner(envs, job)
        return _learn(model, envs, job)
    finally:
        envs.close()


def _learn(model: PPO, envs: SB3VecEnv, job: Job) -> Trained:
    """Run the learner to the end, to the deadline or to Ctrl-C, and save."""
    settings, steps_before = job.settings, model.num_timesteps
    log = Log(job.out, job.resume, steps_before, open_writers(job.logs, job.out, settings.as_dict()))
    model.set_logger(Logger(str(job.out), [WriteLog(log)]))
    progress = ShowProgress(settings.steps)
    native, clock = acting_environment(job, envs.envs.unwrapped), Clock()

    def record(finished: bool = False) -> dict[str, Any]:
        written = make_record(job, native, model.num_timesteps, clock, ("stable_baselines3", "torch"))
        activation = model.policy.activation_fn.__name__  # type: ignore[union-attr]
        return written | {"activation": activation, "finished": finished, "shares": progress.shares}

    def checkpoint() -> None:
        with continue_if_full():
            save(model, record(), job.out / "checkpoints" / f"policy_{model.num_timesteps}")

    present = Present(lambda path: save(model, record(), path), job.out, job.page)

    with StopInOrder(job.seconds) as stop:
        callbacks = [Stop(stop), Checkpoints(checkpoint, settings.steps // CHECKPOINTS), EpisodeLog(), SpreadEpisodes()]
        callbacks += [progress, KeepPresent(present)]
        callbacks.append(EntropySchedule(settings.entropy, settings.final_entropy, settings.steps))
        if settings.fall_cost:
            callbacks.append(FallCost(settings.fall_cost, settings.steps))
        if settings.final_std:
            callbacks.append(NoiseSchedule(settings.initial_std, settings.final_std, settings.steps))
        if settings.target_kl:
            callbacks.append(AdaptiveLearningRate(settings.target_kl))
        if steps_before < settings.steps:
            model.learn(settings.steps - steps_before, callbacks, reset_num_timesteps=False)  # type: ignore[arg-type]
    log.close()
    written = record(finished=not stop.interrupted)
    policy = save_somewhere(lambda folder: save(model, written, folder / "policy"), job.out)
    return Trained(model, written, policy, stop.interrupted)


def make_learner(envs: SB3VecEnv, job: Job) -> PPO:
    """Return a new learner, or the learner saved in `job.resume` with the settings of this job.

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
    options: dict[str, Any] = ppo_arguments(s) | {"stats_window_size": s.num_envs, "device": "cpu"}
    if s.target_kl:  # initial rate, which is adapted later
        options["learning_rate"] = s.learning_rate
    policy = AsymmetricPolicy if isinstance(envs.observation_space, gymnasium.spaces.Dict) else "MlpPolicy"
    model = PPO(policy, envs, policy_kwargs=network, seed=job.seed, **options)
    if job.resume:
        restore(model, job)
    return model


def ppo_arguments(s: Settings) -> dict[str, Any]:
    """Return settings as arguments of PPO in Stable-Baselines3 and SBX; the learning rate falls linearly."""
    return {
        "learning_rate": LinearSchedule(s.learning_rate, 0.0, 1.0),
        "n_steps": s.rollout,
        "batch_size": -(-s.num_envs * s.rollout // s.minibatches),
        "n_epochs": s.epochs,
        "gamma": s.gamma,
        "gae_lambda": s.gae_lambda,
        "clip_range": s.clip,
        "ent_coef": s.entropy,
        "vf_coef": s.value,
        "max_grad_norm": s.max_grad_norm,
    }


def restore(model: PPO, job: Job) -> None:
    """Restore a new learner from `job.resume`: weights, state of the optimiser, and number of steps.

    Only arrays are read, because `PPO.load` of Stable-Baselines3 unpickles objects, which can run any code.
    Environments and random numbers start again.

    Raises:
        PolicyError: If the saved policy does not fit the environment or the settings.
    """
    file, record = Path(job.resume), resumed_record(job)  # type: ignore[arg-type]
    if file.suffix != ".zip":
        raise PolicyError(f"{file}: expected a policy.zip of train/ppo.py, which contains the state of the optimiser")
    try:
        weights, optimizer = (tensors(read_weights(file, f"{name}.pth")) for name in ("policy", "policy.optimizer"))
        model.policy.load_state_dict(weights)
        model.policy.optimizer.load_state_dict(optimizer)
    except Exception as error:  # damaged files raise errors of many classes
        raise PolicyError(f"{file}: does not fit {job.env_id}: {' '.join(str(error).split())[:300]}") from None
    if not all(torch.isfinite(parameter).all() for parameter in model.policy.parameters()):
        raise PolicyError(f"{file}: a weight is NaN or infinite; expected finite numbers")
    model.num_timesteps = record["steps"]
    if job.settings.target_kl:  # continue with the adapted rate
        model.lr_schedule = FloatSchedule(model.policy.optimizer.param_groups[0]["lr"])


def tensors(arrays: Any) -> Any:
    """Return nested dictionaries and lists with tensors in place of arrays."""
    if isinstance(arrays, dict):
        return {key: tensors(value) for key, value in arrays.items()}
    if isinstance(arrays, list | tuple):
        return type(arrays)(tensors(value) for value in arrays)
    return torch.tensor(arrays) if isinstance(arrays, np.ndarray) else arrays


def save(model: PPO, record: dict[str, Any], path: Path) -> Path:
    """Write `path`.zip and `path`.json, both or no file, and return the path of the policy.

    Raises:
        OSError: If they cannot be written.
    """
    packed = io.BytesIO()
    model.save(packed, exclude=TRANSIENT)
    text = json.dumps(record, indent=2) + "\n"
    policy = path.with_name(f"{path.name}.zip")
    write_whole({policy: packed.getvalue(), path.with_name(f"{path.name}.json"): text.encode()})
    return policy
