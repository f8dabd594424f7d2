"""A training run of any learner, and the record of its policy.

A learner is a module with a function `train(job) -> Trained` and a dataclass `Settings`.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium

from ce_gym.learn.runs.settings import SettingsError
from ce_gym.policies import environment_record


@dataclass(frozen=True)
class Job:
    """One training run.

    Attributes:
        algo: Name of the learner.
        env_id: Registered environment id.
        settings: Settings of the learner.
        out: Folder to write to.
        env_kwargs: Arguments of the environment.
        seed: Seed of initial weights, exploration and environments.
        threads: Processor threads, used by physics and learning alternately.
        resume: Policy from which training continues.
        seconds: Longest training time [s].
        logs: Packages for which curves are also written, see `logs.py`.
    """

    algo: str
    env_id: str
    settings: Any
    out: Path
    env_kwargs: dict[str, Any]
    seed: int = 0
    threads: int = 1
    resume: Path | None = None
    seconds: float = float("inf")
    logs: tuple[str, ...] = ()

    def replace(self, **changes: Any) -> Job:
        """Return the run with other attributes."""
        return replace(self, **changes)


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
    network = {"activation": settings.activation, "settings": asdict(settings)}
    return environment_record(native, env_id, env_kwargs) | network


def make_record(job: Job, native: Any, steps: int, packages: Iterable[str]) -> dict[str, Any]:
    """Return the record of a policy: the data to use it and to repeat its training.

    Args:
        job: The training run.
        native: The environment of evaluations, unwrapped, see `acting_environment`.
        steps: Environment steps done.
        packages: Packages whose versions are recorded, in addition to ce_gym, gymnasium, numpy and Python.
    """
    return basic_record(native, job.env_id, job.env_kwargs, job.settings) | {
        "learner": job.algo,
        "steps": steps,
        "seed": job.seed,
        "resumed_from": str(job.resume) if job.resume else None,
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
