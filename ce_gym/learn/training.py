"""Make a training run from an environment, a settings file, a policy and arguments, and run its learner."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from ce_gym.compile.system import usable_cores
from ce_gym.learn.runs.folder import run_of, unused_folder
from ce_gym.learn.runs.job import Job, Trained
from ce_gym.learn.runs.settings import GIVEN, by_name, config_file, make_settings, read_file, with_named
from ce_gym.policies import environment_of, load_policy, locate_policy, shelf

ALGORITHMS = ("ppo", "shac", "distill", "sb3")
"""Names of the learners, which are modules of `ce_gym.learn.learners` with `train(job)` and `Settings`."""


def make_job(
    env_id: str = "",
    algo: str = "",
    *,
    settings: Mapping[str, Any] | Iterable[str] = (),
    out: str | Path | None = None,
    seed: int = 0,
    config: str | Path | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    resume: str | Path | None = None,
    threads: int | None = None,
    seconds: float = float("inf"),
    logs: Sequence[str] = (),
    several: bool = False,
) -> Job:
    """Return a training run.

    Args:
        env_id: Registered environment id; may be empty with `resume`.
        algo: One of `ALGORITHMS`; if empty, the learner of the resumed policy, or "ppo".
        settings: Settings that replace values of the file, by name or each as text `KEY=VALUE`.
        out: Folder to write to; by default the folder of the policy to resume, if its environment stays the same.
            Otherwise `runs/`, then the names of settings file, level and learner, with a number if there is a run.
        seed: Seed of initial weights, exploration and environments.
        config: Settings file, or name of one in the folder of the learner, such as "mini_cheetah_stairs"; by default
            the file of the environment.
        env_kwargs: Arguments of the environment.
        resume: Policy from which training continues, with its settings unless `config` is given.
        threads: Processor threads; all usable cores if None.
        seconds: Longest training time [s].
        logs: Packages to which curves are also written: "tensorboard", "wandb", "trackio".
        several: Whether the folder is for several runs, in subfolders.

    Raises:
        ValueError: If a setting, an argument or the policy cannot be used; one line.
    """
    policy = locate_policy(resume) if resume else None
    record = load_policy(policy).record if policy else {}
    if not (env_id or record):
        raise ValueError("ENV: missing; expected an environment id, or --resume with a policy")
    env_id, algo = environment_of(record, env_id), algo or learner_of(record)
    kind = learner(algo).Settings
    path = _named_file(config, kind.folder) if config else config_file(env_id, kind.folder)
    continued = {} if config else {str(policy): record.get("settings", {})}
    in_file, env_args = read_file(path)
    sources = {str(path): in_file, **continued, GIVEN: by_name(settings)}
    given, trained = dict(env_kwargs or {}), record.get("env_kwargs", {})
    level, suffix = given.get("transmission"), "" if algo == ALGORITHMS[0] else algo
    if out is None and policy and not (several or config) and _goes_on(policy, record, env_id, given):
        out = run_of(policy)
    elif out is None:
        out = unused_folder(Path("runs") / "-".join(filter(None, (path.stem, level, suffix))), several)
    return Job(
        algo=algo,
        env_id=env_id,
        settings=with_named(make_settings(kind, sources), given),
        out=Path(out),
        env_kwargs={**(trained if record and not config else {**trained, **env_args}), **given},
        seed=seed,
        threads=threads or usable_cores(),
        resume=policy,
        seconds=seconds,
        logs=tuple(logs),
    )


def _goes_on(policy: Path, record: Mapping[str, Any], env_id: str, given: Mapping[str, Any]) -> bool:
    """Return whether training continues the last policy of a run in the same environment."""
    same = env_id == record["env"] and {**record["env_kwargs"], **given} == record["env_kwargs"]
    return same and policy.stem == "policy" and not policy.is_relative_to(shelf())


def _named_file(config: str | Path, folder: Path) -> Path:
    """Return a settings file by its path, or by its name in a folder."""
    named = folder / f"{config}.yaml"
    return named if named.exists() else Path(config)


def run_job(job: Job) -> Trained:
    """Make a training run, and return its policy; Ctrl-C saves the policy and stops."""
    return learner(job.algo).train(job)


def learner(algo: str) -> ModuleType:
    """Return the module of a learner.

    Raises:
        ValueError: If there is no learner of this name.
    """
    if algo not in ALGORITHMS:
        raise ValueError(f"algo={algo!r}; expected one of {', '.join(ALGORITHMS)}")
    return importlib.import_module(f"ce_gym.learn.learners.{algo}")


def learner_of(record: Mapping[str, Any]) -> str:
    """Return the name of the learner that wrote a record, or the default learner for an empty record."""
    name = record.get("learner", "sb3" if record else ALGORITHMS[0])
    return "ppo" if name == "fast_ppo" else name  # the name in records of version 0.1
