"""A training run of any learner: its command line, the record of the policy, its messages.

A learner is a program that has `train(job) -> Trained`; `main` here does all else.
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
        settings: What shapes learning.
        out: Folder to write to.
        env_kwargs: Given to the environment.
        seed: Of the policy's initial weights, the exploration and the environments.
        threads: Processor threads for physics and for learning, which take turns.
        resume: A policy to go on from.
        seconds: Longest time to train [s]; the steps done by then are kept.
        tensorboard: Whether to write TensorBoard logs.
        page: Whether a page shows the present policy.
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
    """What a training run leaves.

    Attributes:
        model: The policy; its `predict` is that of Stable-Baselines3.
        record: What is written beside it.
        policy: Path of the policy.
        interrupted: Whether Ctrl-C ended training early.
    """

    model: Any
    record: dict[str, Any]
    policy: Path
    interrupted: bool


class Clock:
    """Time since it was made [s]."""

    def __init__(self) -> None:
        self._start = self._now()

    def spent(self) -> dict[str, float]:
        """Return the time on the wall, and that of processors in all threads."""
        wall, processor = (now - start for now, start in zip(self._now(), self._start, strict=True))
        return {"training_seconds": round(wall, 1), "processor_seconds": round(processor, 1)}

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()


def acting_environment(job: Job, native: Any) -> Any:
    """Return the environment that a policy will act in, which is the one it is trained in but for `training`.

    Args:
        job: The training run.
        native: The environment of training, unwrapped.

    Raises:
        SettingsError: If policies see or do something else there.
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


def make_record(job: Job, native: Any, steps: int, clock: Clock, packages: tuple[str, ...]) -> dict[str, Any]:
    """Return the record of a policy: what is needed to use it and to repeat its training.

    Args:
        job: The training run.
        native: The environment that the policy acts in, unwrapped.
        steps: Environment steps done.
        clock: Made when they began.
        packages: Whose versions matter, beside those of ce_gym, gymnasium, numpy and Python.
    """
    seen, action = native.single_observation_space, native.single_action_space.shape
    observation = seen["policy"].shape if isinstance(seen, gymnasium.spaces.Dict) else seen.shape
    return {
        "env": job.env_id,
        "transmission": native.model.transmission,
        "env_kwargs": job.env_kwargs,
        "observation_size": observation[0] if observation else 0,
        "action_size": action[0] if action else 0,
        "activation": job.settings.activation,
        "policy_spec": native.policy_spec(),
        "steps": steps,
        "seed": job.seed,
        "resumed_from": str(job.resume) if job.resume else None,
        **clock.spent(),
        "settings": asdict(job.settings),
        "date": time.strftime("%Y-%m-%d"),
        "versions": {name: _version(name) for name in ("ce_gym", "gymnasium", *packages, "numpy")}
        | {"python": platform.python_version()},
    }


def _version(package: str) -> str:
    """Version of an installed package; a source tree that is only on the path has none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def resumed_record(job: Job) -> dict[str, Any]:
    """Return the record of the policy that a training run goes on from.

    Raises:
        PolicyError: If that has another network than the settings ask for, or does not say how long it was trained.
    """
    file: Any = job.resume
    record = load_policy(file).record
    wanted, found = json.loads(json.dumps(asdict(job.settings))), _settings_of(record)
    for key in NETWORK:
        if found.get(key) != wanted[key]:
            both = f"trained with {found.get(key)}, asked for {wanted[key]}"
            raise PolicyError(f"{file}: {key}: {both}; expected the same to go on")
    if type(record.get("steps")) is not int or record["steps"] < 0:
        raise PolicyError(f"{file}: steps: {record.get('steps')!r}; expected the steps that it was trained for")
    return record


def _settings_of(record: dict[str, Any]) -> dict[str, Any]:
    """The settings in the record of a policy, as plain data; none if there are none."""
    found = record.get("settings")
    return found if isinstance(found, dict) else {}


def jobs(args: argparse.Namespace, folder: str = "", settings: type = Settings) -> list[Job]:
    """The training runs a command line asks for; `folder` ends the names of folders that it does not give.

    `settings` is the learner's dataclass; its attribute `folder` is the folder of its files.

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
        before = {**asdict(load_settings(path, kind=settings)), **_settings_of(record), **parsed(overrides)}
        chosen = make_settings(before, str(resume), settings)
    else:
        chosen = load_settings(path, overrides, settings)
    own = {} if record and not args.config else load_env_args(path)  # a policy keeps those that it was trained with
    kwargs = {**record.get("env_kwargs", {}), **own, **env_kwargs_of(args)}
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
    """The arguments of the environment that a command line names."""
    kwargs = {"transmission": args.transmission} if args.transmission else {}
    kwargs |= {"obs_mode": "dict", "critic": args.critic} if args.critic else {}
    return kwargs | dict(args.env_args)


def parser() -> argparse.ArgumentParser:
    """The command line of every learner."""
    result = Parser(
        description="Train a policy. Ctrl-C and SIGTERM stop in good order and save; --resume goes on.",
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
        help="policy to go on from, with its settings unless --config says otherwise; --steps counts its steps too; "
        "nothing in it is run",
    )
    what.add_argument("--seed", type=SEED, default=0, metavar="N", help="random seed (default 0)")
    what.add_argument("--seeds", type=SEED, nargs="+", metavar="N", help="several seeds, one run after the other")
    how = result.add_argument_group("how")
    how.add_argument("--config", type=Path, metavar="FILE", help="settings file (default: the one in train/config)")
    how.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings to change, such as gamma=0.98")
    how.add_argument("--steps", metavar="N", help="environment steps in all, such as 6e6")
    how.add_argument("--num-envs", metavar="N", help="environments stepped at once")
    how.add_argument(
        "--minutes", type=above_zero, default=float("inf"), metavar="M", help="stop after so long at the latest"
    )
    how.add_argument("--threads", type=THREADS, default=usable_cores(), metavar="N", help="default: all CPUs")
    where = result.add_argument_group("where to")
    where.add_argument("--out", type=Path, metavar="FOLDER", help="default: runs/<name of the settings file>")
    where.add_argument("--no-tensorboard", dest="tensorboard", action="store_false", help="write no TensorBoard logs")
    where.add_argument(
        "--page", action="store_true", help="show learning curves and the present policy in a browser while it trains"
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
        train: What learns.
        argv: Arguments of the command line.
        folder: Ends the names of folders, so that policies of different learners do not mix.
        settings: The learner's dataclass of settings.
        add_options: Adds the learner's own options to the command line; `train` gets their values by name.
    """
    line = parser()
    common = vars(line.parse_args([]))
    if add_options:
        add_options(line)
    args = line.parse_args(argv)
    own = partial(train, **{name: value for name, value in vars(args).items() if name not in common})
    return run(program, lambda: _train_all(program, own, args, folder, settings))


def _train_all(
    program: str, train: Callable[[Job], Trained], args: argparse.Namespace, folder: str, settings: type
) -> int:
    """Do what a command line asks for; return the exit code."""
    wanted = jobs(args, folder, settings)
    with TrainingPage([job.out for job in wanted], wanted[0].env_id) if args.page else contextlib.nullcontext():
        return _train_each(program, train, wanted, args.episodes)


def _train_each(program: str, train: Callable[[Job], Trained], wanted: list[Job], episodes: int) -> int:
    """Do some training runs, one after the other; return the exit code."""
    from evaluate import evaluate, report  # what judges is not needed before

    for job in wanted:
        make_folder(job.out)
        keep_map(job.env_kwargs, job.out)
        print(f"training {job.env_id}, seed {job.seed}, {job.settings.steps:,} steps -> {job.out}", flush=True)
        trained = train(job)
        print(f"saved {trained.policy} after {trained.record['steps']:,} steps", flush=True)
        if trained.interrupted:
            print(f"interrupted; go on with: python train/{program} --resume {trained.policy}")
            return 130
        result = evaluate(load_policy(trained.policy), job.env_id, episodes=episodes, **job.env_kwargs)
        print(report(result), flush=True)
    return 0
