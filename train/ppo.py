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

import argparse
import json
import os
import platform
import sys
import time
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium
import torch
from callbacks import (
    AdaptiveLearningRate,
    Checkpoints,
    Curve,
    EntropySchedule,
    EpisodeLog,
    NoiseSchedule,
    ProgressBar,
    StopInOrder,
    read_curve,
)
from evaluate import PolicyError, evaluate, load_learner, report
from learner import ThreadedPPO
from settings import Settings, config_file, load_settings
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import FloatSchedule

from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env
from ce_gym.adapters.sb3_asymmetric import AsymmetricPolicy

CHECKPOINTS = 10
"""Checkpoints per training run."""

TRANSIENT = ["_last_obs", "_last_episode_starts", "_last_original_obs", "ep_info_buffer", "ep_success_buffer"]
"""What the learner holds that is of no use in a saved policy."""


@dataclass(frozen=True)
class Job:
    """One training run.

    Attributes:
        env_id: Registered environment id.
        settings: What shapes learning.
        out: Folder to write to.
        env_kwargs: Given to the environment.
        seed: Of the policy's initial weights, the exploration and the environments.
        threads: Processor threads for physics and for learning, which take turns.
        resume: A policy.zip to go on from.
        seconds: Longest time to train [s]; the steps done by then are kept.
        tensorboard: Whether to write TensorBoard logs.
    """

    env_id: str
    settings: Settings
    out: Path
    env_kwargs: dict[str, Any]
    seed: int = 0
    threads: int = 1
    resume: Path | None = None
    seconds: float = float("inf")
    tensorboard: bool = True


@dataclass(frozen=True)
class Trained:
    """What a training run leaves.

    Attributes:
        model: The policy.
        record: What is written beside it.
        policy: Path of the policy.
        interrupted: Whether Ctrl-C ended training early.
    """

    model: PPO
    record: dict[str, Any]
    policy: Path
    interrupted: bool


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
        return _record(model, envs, job, time.perf_counter() - start) | {"finished": finished}

    def checkpoint() -> None:
        save(model, record(), job.out / "checkpoints" / f"policy_{model.num_timesteps}")

    with StopInOrder(job.seconds) as stop:
        callbacks = [stop, Checkpoints(checkpoint, settings.steps // CHECKPOINTS), EpisodeLog()]
        callbacks += [Curve(job.out / "curve.csv", earlier), ProgressBar(settings.steps)]
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


def _record(model: PPO, envs: SB3VecEnv, job: Job, seconds: float) -> dict[str, Any]:
    """What somebody needs to know to use or repeat this policy."""
    seen, action = envs.observation_space, envs.action_space.shape
    observation = seen["policy"].shape if isinstance(seen, gymnasium.spaces.Dict) else seen.shape
    native: Any = envs.envs.unwrapped
    return {
        "env": job.env_id,
        "transmission": native.model.transmission,
        "env_kwargs": job.env_kwargs,
        "observation_size": observation[0] if observation else 0,
        "action_size": action[0] if action else 0,
        "activation": model.policy.activation_fn.__name__,  # type: ignore[union-attr]
        "contract": native.contract(),
        "steps": model.num_timesteps,
        "seed": job.seed,
        "resumed_from": str(job.resume) if job.resume else None,
        "training_seconds": round(seconds, 1),
        "settings": job.settings.as_dict(),
        "date": time.strftime("%Y-%m-%d"),
        "versions": {name: _version(name) for name in ("ce_gym", "gymnasium", "stable_baselines3", "torch", "numpy")}
        | {"python": platform.python_version()},
    }


def _version(package: str) -> str:
    """Version of an installed package; a source tree that is only on the path has none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def save(model: PPO, record: dict[str, Any], path: Path) -> Path:
    """Write `path`.zip and `path`.json, each whole or not at all, and return the path of the policy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(f".{path.name}.zip")
    model.save(fresh, exclude=TRANSIENT)
    text = path.with_name(f".{path.name}.json")
    text.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    os.replace(text, path.with_name(f"{path.name}.json"))
    return fresh.replace(path.with_name(f"{path.name}.zip"))


def available_threads() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def jobs(args: argparse.Namespace) -> list[Job]:
    """The training runs a command line asks for.

    Raises:
        ValueError: If the command line, a settings file or a policy cannot be used.
    """
    record = load_learner(args.resume)[1] if args.resume else {}
    env_id = args.env or record.get("env")
    if not env_id:
        raise ValueError("--env: missing; expected an environment id, or --resume with a policy")
    overrides = list(args.set)
    overrides += [f"steps={args.steps}"] if args.steps else []
    overrides += [f"num_envs={args.num_envs}"] if args.num_envs else []
    path = args.config or config_file(env_id)
    settings = load_settings(path, overrides)
    kwargs = dict(record.get("env_kwargs", {}))
    kwargs |= {"transmission": args.transmission} if args.transmission else {}
    kwargs |= {"obs_mode": "dict", "critic": args.critic} if args.critic else {}
    out = args.out or Path("runs") / "-".join([path.stem, *([args.transmission] if args.transmission else [])])
    seeds = args.seeds or [args.seed]
    return [
        Job(
            env_id=env_id,
            settings=settings,
            out=out / f"seed_{seed}" if len(seeds) > 1 else out,
            env_kwargs=kwargs,
            seed=seed,
            threads=args.threads,
            resume=args.resume,
            seconds=60.0 * args.minutes,
            tensorboard=args.tensorboard,
        )
        for seed in seeds
    ]


def parser() -> argparse.ArgumentParser:
    """The command line of this file."""
    result = argparse.ArgumentParser(
        description="Train a policy with PPO. Ctrl-C stops in good order and saves; --resume goes on.",
        epilog="Settings not named here are in the settings file; --set KEY=VALUE changes any of them.",
    )
    what = result.add_argument_group("what to train")
    what.add_argument("--env", metavar="ID", help="environment id, such as ce_gym/MiniCheetahVelocity-v0")
    what.add_argument("--transmission", metavar="LEVEL", help="exact, coupled, armature or none")
    what.add_argument(
        "--critic", nargs="+", metavar="BLOCK", help="observation blocks that only the critic sees, such as base_height"
    )
    what.add_argument(
        "--resume", type=Path, metavar="FILE", help="policy.zip to go on from; --steps counts its steps too"
    )
    what.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default 0)")
    what.add_argument("--seeds", type=int, nargs="+", metavar="N", help="several seeds, one run after the other")
    how = result.add_argument_group("how")
    how.add_argument("--config", type=Path, metavar="FILE", help="settings file (default: the one in train/config)")
    how.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings to change, such as gamma=0.98")
    how.add_argument("--steps", metavar="N", help="environment steps in all, such as 6e6")
    how.add_argument("--num-envs", metavar="N", help="environments stepped at once")
    how.add_argument(
        "--minutes", type=float, default=float("inf"), metavar="M", help="stop after so long at the latest"
    )
    how.add_argument("--threads", type=int, default=available_threads(), metavar="N", help="default: all processors")
    where = result.add_argument_group("where to")
    where.add_argument("--out", type=Path, metavar="FOLDER", help="default: runs/<name of the settings file>")
    where.add_argument("--no-tensorboard", dest="tensorboard", action="store_false", help="write no TensorBoard logs")
    where.add_argument("--episodes", type=int, default=256, metavar="N", help="episodes of the evaluation at the end")
    return result


def main(argv: list[str] | None = None) -> int:
    """Train every seed asked for, evaluate each policy, and say where it lies."""
    args = parser().parse_args(argv)
    try:
        for job in jobs(args):
            print(f"training {job.env_id}, seed {job.seed}, {job.settings.steps:,} steps -> {job.out}", flush=True)
            trained = train(job)
            print(f"saved {trained.policy} after {trained.model.num_timesteps:,} steps")
            if trained.interrupted:
                print(f"interrupted; go on with: python train/ppo.py --resume {trained.policy}")
                return 130
            result = evaluate(trained.model, job.env_id, episodes=args.episodes, **job.env_kwargs)
            print(report(result), flush=True)
    except (ValueError, gymnasium.error.Error) as error:
        print(f"ppo.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
