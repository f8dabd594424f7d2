"""A training run of any learner: command line, record of the policy, and messages.

A learner is a program with a function `train(job) -> Trained`, which it passes to `main` in this file.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium
from console import EPISODES, SEED, THREADS, Parser, above_zero, run
from run_folder import make_folder
from settings import (
    NETWORK,
    Settings,
    SettingsError,
    config_file,
    load_env_args,
    load_settings,
    make_settings,
    parsed,
    with_named,
)
from training_page import TrainingPage

from ce_gym import usable_cores
from ce_gym.policies import PolicyError, add_env_arg, environment_of, keep_map, load_policy, locate_policy

CHECKPOINTS = 10
"""Checkpoints per training run."""


@dataclass(frozen=True)
class Job:
    """One training run.

    Attributes:
        env_id: Registered environment id.
        settings: Settings of the learner.
        out: Folder to write to.
        env_kwargs: Arguments of the environment.
        seed: Seed of initial weights, exploration and environments.
        threads: Processor threads, used by physics and learning alternately.
        resume: Policy from which training continues.
        seconds: Longest training time [s].
        tensorboard: Whether to write TensorBoard logs.
        page: Whether a page shows the current policy.
    """

    env_id: str
    settings: Any
    out: Path
    env_kwargs: dict[str, Any]
    seed: int = 0
    threads: int = 1
    resume: Path | None = None
    seconds: float = float("inf")
    tensorboard: bool = True
    page: bool = False


@dataclass(frozen=True)
class Trained:
    """Result of a training run.

    Attributes:
        model: The policy, with the method `predict` of Stable-Baselines3.
        record: Record of the policy.
        policy: Path of the policy.
        interrupted: Whether Ctrl-C ended training early.
    """

    model: Any
    record: dict[str, Any]
    policy: Path
    interrupted: bool


class Clock:
    """Measures time since its creation [s]."""

    def __init__(self) -> None:
        self._start = self._now()

    def spent(self) -> dict[str, float]:
        """Return wall-clock time, and processor time of all threads."""
        wall, processor = (now - start for now, start in zip(self._now(), self._start, strict=True))
        return {"training_seconds": round(wall, 1), "processor_seconds": round(processor, 1)}

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()


def acting_environment(job: Job, native: Any) -> Any:
    """Return the environment of evaluations, which lacks the arguments of the setting `training`.

    Args:
        job: The training run.
        native: The environment of training, unwrapped.

    Raises:
        SettingsError: If its observations or actions have other spaces than in training.
    """
    if not job.settings.training:
        return native
    mode = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    acting = gymnasium.make_vec(job.env_id, num_envs=1, vectorization_mode=mode, **job.env_kwargs).unwrapped
    for space in ("single_observation_space", "single_action_space"):
        there, here = getattr(acting, space), getattr(native, space)
        if there != here:
            raise SettingsError(f"training: {space} is {here}; expected {there}, that of the policy's environment")
    return acting


def basic_record(native: Any, env_id: str, env_kwargs: dict[str, Any], settings: Any) -> dict[str, Any]:
    """Return the part of a policy's record that all learners write; `native` is the environment of evaluations."""
    space, action = native.single_observation_space, native.single_action_space.shape
    observation = space["policy"].shape if isinstance(space, gymnasium.spaces.Dict) else space.shape
    return {
        "env": env_id,
        "transmission": native.model.transmission,
        "env_kwargs": env_kwargs,
        "observation_size": observation[0] if observation else 0,
        "action_size": action[0] if action else 0,
        "activation": settings.activation,
        "policy_spec": native.policy_spec(),
        "settings": asdict(settings),
    }


def make_record(job: Job, native: Any, steps: int, clock: Clock, packages: tuple[str, ...]) -> dict[str, Any]:
    """Return the record of a policy: the data to use it and to repeat its training.

    Args:
        job: The training run.
        native: The environment of evaluations, unwrapped, see `acting_environment`.
        steps: Environment steps done.
        clock: Clock created at the start of training.
        packages: Packages whose versions are recorded, in addition to ce_gym, gymnasium, numpy and Python.
    """
    return basic_record(native, job.env_id, job.env_kwargs, job.settings) | {
        "steps": steps,
        "seed": job.seed,
        "resumed_from": str(job.resume) if job.resume else None,
        **clock.spent(),
        "date": time.strftime("%Y-%m-%d"),
        "versions": {name: _version(name) for name in ("ce_gym", "gymnasium", *packages, "numpy")}
        | {"python": platform.python_version()},
    }


def _version(package: str) -> str:
    """Return the version of an installed package, or "not installed" for a source tree on the path."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def resumed_record(job: Job) -> dict[str, Any]:
    """Return the record of the policy from which a training run continues.

    Raises:
        PolicyError: If its network differs from the settings, or the record lacks the number of steps.
    """
    file: Any = job.resume
    record = load_policy(file).record
    requested, trained = json.loads(json.dumps(asdict(job.settings))), _settings_of(record)
    for key in NETWORK:
        if trained.get(key) != requested[key]:
            both = f"trained with {trained.get(key)}, requested {requested[key]}"
            raise PolicyError(f"{file}: {key}: {both}; expected the same to continue")
    if type(record.get("steps")) is not int or record["steps"] < 0:
        raise PolicyError(f"{file}: steps: {record.get('steps')!r}; expected the steps of its training")
    return record


def _settings_of(record: dict[str, Any]) -> dict[str, Any]:
    """Return the settings in the record of a policy, as plain data; empty if there are none."""
    settings = record.get("settings")
    return settings if isinstance(settings, dict) else {}


def jobs(args: argparse.Namespace, folder: str = "", settings: type = Settings) -> list[Job]:
    """Return the training runs of a command line.

    Args:
        args: Values of the command line.
        folder: Suffix of default folder names.
        settings: The learner's dataclass of settings; its attribute `folder` is the folder of settings files.

    Raises:
        ValueError: If the command line, a settings file or a policy cannot be used.
    """
    resume = locate_policy(args.resume) if args.resume else None
    record = load_policy(resume).record if resume else {}
    if not (args.env or record):
        raise ValueError("--env: missing; expected an environment id, or --resume with a policy")
    env_id = environment_of(record, args.env)
    overrides = list(args.set)
    overrides += [f"steps={args.steps}"] if args.steps else []
    overrides += [f"num_envs={args.num_envs}"] if args.num_envs else []
    path = args.config or config_file(env_id, settings.folder)
    if record and not args.config:
        merged = {**asdict(load_settings(path, kind=settings)), **_settings_of(record), **parsed(overrides)}
        chosen = make_settings(merged, str(resume), settings)
    else:
        chosen = load_settings(path, overrides, settings)
    from_file = {} if record and not args.config else load_env_args(path)  # the record has them already
    kwargs = {**record.get("env_kwargs", {}), **from_file, **env_kwargs_of(args)}
    chosen = with_named(chosen, dict(args.env_args))
    out = args.out or Path("runs") / (
        "-".join([path.stem, *([args.transmission] if args.transmission else [])]) + folder
    )
    seeds = args.seeds or [args.seed]
    return [
        Job(
            env_id=env_id,
            settings=chosen,
            out=out / f"seed_{seed}" if len(seeds) > 1 else out,
            env_kwargs=kwargs,
            seed=seed,
            threads=args.threads,
            resume=resume,
            seconds=60.0 * args.minutes,
            tensorboard=args.tensorboard,
            page=args.page,
        )
        for seed in seeds
    ]


def env_kwargs_of(args: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of the environment in a command line."""
    kwargs = {"transmission": args.transmission} if args.transmission else {}
    kwargs |= {"obs_mode": "dict", "critic": args.critic} if args.critic else {}
    return kwargs | dict(args.env_args)


def parser() -> argparse.ArgumentParser:
    """Return the command line that all learners share."""
    result = Parser(
        description="Train a policy. Ctrl-C and SIGTERM save the policy and stop; --resume continues.",
        epilog="Settings not named here are in the settings file; --set KEY=VALUE changes any of them.",
    )
    what = result.add_argument_group("what to train")
    what.add_argument("--env", metavar="ID", help="environment id, such as ce_gym/MiniCheetahVelocity-v0")
    what.add_argument("--transmission", metavar="LEVEL", help="exact, coupled, armature, none or elastic")
    what.add_argument(
        "--critic", nargs="+", metavar="BLOCK", help="observation blocks that only the critic sees, such as base_height"
    )
    add_env_arg(what)
    what.add_argument(
        "--resume",
        type=Path,
        metavar="FILE",
        help="policy from which to continue, with its settings unless --config is given; --steps includes its steps; "
        "no code in the file is run",
    )
    what.add_argument("--seed", type=SEED, default=0, metavar="N", help="random seed (default 0)")
    what.add_argument("--seeds", type=SEED, nargs="+", metavar="N", help="several seeds, one run after the other")
    how = result.add_argument_group("how")
    how.add_argument("--config", type=Path, metavar="FILE", help="settings file (default: the one in train/config)")
    how.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings to change, such as gamma=0.98")
    how.add_argument("--steps", metavar="N", help="environment steps in all, such as 6e6")
    how.add_argument("--num-envs", metavar="N", help="environments stepped in parallel")
    how.add_argument(
        "--minutes", type=above_zero, default=float("inf"), metavar="M", help="longest training time [min]"
    )
    how.add_argument("--threads", type=THREADS, default=usable_cores(), metavar="N", help="default: all CPUs")
    where = result.add_argument_group("output")
    where.add_argument("--out", type=Path, metavar="FOLDER", help="default: runs/<name of the settings file>")
    where.add_argument("--no-tensorboard", dest="tensorboard", action="store_false", help="write no TensorBoard logs")
    where.add_argument(
        "--page", action="store_true", help="show learning curves and the current policy in a browser during training"
    )
    where.add_argument(
        "--episodes", type=EPISODES, default=256, metavar="N", help="episodes of the evaluation at the end"
    )
    return result


def main(
    program: str,
    train: Callable[..., Trained],
    argv: list[str] | None = None,
    folder: str = "",
    settings: type = Settings,
    add_options: Callable[[argparse.ArgumentParser], None] | None = None,
) -> int:
    """Train every seed, evaluate each policy, and print its path.

    Args:
        program: Name of the learner's file, for messages.
        train: Function that trains.
        argv: Arguments of the command line.
        folder: Suffix of default folder names, so that policies of different learners do not mix.
        settings: The learner's dataclass of settings.
        add_options: Adds options of the learner to the command line; `train` gets their values by name.
    """
    line = parser()
    common = vars(line.parse_args([]))
    if add_options:
        add_options(line)
    args = line.parse_args(argv)
    with_options = partial(train, **{name: value for name, value in vars(args).items() if name not in common})
    return run(program, lambda: _train_all(program, with_options, args, folder, settings))


def _train_all(
    program: str, train: Callable[[Job], Trained], args: argparse.Namespace, folder: str, settings: type
) -> int:
    """Make all training runs of a command line, with a page if requested, and return the exit code."""
    runs = jobs(args, folder, settings)
    with TrainingPage([job.out for job in runs], runs[0].env_id) if args.page else contextlib.nullcontext():
        return _train_each(program, train, runs, args.episodes)


def _train_each(program: str, train: Callable[[Job], Trained], runs: list[Job], episodes: int) -> int:
    """Make training runs one after the other, evaluate each policy, and return the exit code."""
    from evaluate import evaluate, report  # not needed before training

    for job in runs:
        make_folder(job.out)
        keep_map(job.env_kwargs, job.out)
        print(f"training {job.env_id}, seed {job.seed}, {job.settings.steps:,} steps -> {job.out}", flush=True)
        trained = train(job)
        print(f"saved {trained.policy} after {trained.record['steps']:,} steps", flush=True)
        if trained.interrupted:
            print(f"interrupted; continue with: python train/{program} --resume {trained.policy}")
            return 130
        result = evaluate(load_policy(trained.policy), job.env_id, episodes=episodes, **job.env_kwargs)
        print(report(result), flush=True)
    return 0
