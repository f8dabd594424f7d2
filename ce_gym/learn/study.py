"""Train one task with several seeds at several transmission levels, with what is trained already left alone."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ce_gym.learn.runs.job import Job
from ce_gym.learn.training import make_job, run_job
from ce_gym.policies import PolicyError, load_policy

POLICY = "policy.npz"


@dataclass(frozen=True)
class Study:
    """Training runs of one task, in the subfolders `LEVEL/seed_N` of a folder.

    Attributes:
        env_id: Registered environment id.
        levels: Transmission levels.
        seeds: Seeds of each level.
        settings: Settings that replace those of the settings file, by name.
        env_kwargs: Arguments of the environment.
        folder: The folder; by default `runs/transfer/`, then the name of the settings file.
    """

    env_id: str
    levels: Sequence[str]
    seeds: Sequence[int]
    settings: Mapping[str, Any] = field(default_factory=dict)
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | None = None

    def jobs(self, threads: int | None = None) -> list[Job]:
        """Return the training runs, level by level; `threads` as in `make_job`."""
        jobs = []
        for level in self.levels:
            for seed in self.seeds:
                kwargs = {**self.env_kwargs, "transmission": level}
                job = make_job(self.env_id, settings=self.settings, env_kwargs=kwargs, seed=seed, threads=threads)
                folder = self.folder or Path("runs") / "transfer" / job.out.name.removesuffix(f"-{level}")
                jobs.append(job.replace(out=folder / level / f"seed_{seed}"))
        return jobs


def train_missing(study: Study, threads: int | None = None) -> list[Path]:
    """Make all runs of a study whose policies are missing or unfinished, and return all policies.

    Raises:
        ValueError: If the folder has a policy with other settings, or settings are wrong.
        KeyboardInterrupt: After Ctrl-C. Finished and interrupted runs are kept, and the next call continues.
    """
    policies = []
    for job in study.jobs(threads):
        policy = job.out / POLICY
        finished = policy.exists() and checked_record(policy, job)["finished"]
        if not finished:
            print(f"training seed {job.seed}, {job.settings.steps:,} steps -> {job.out}", file=sys.stderr)
            if run_job(job.replace(resume=policy if policy.exists() else None)).interrupted:
                raise KeyboardInterrupt
        policies.append(policy)
    return policies


def checked_record(policy: Path, job: Job) -> dict[str, Any]:
    """Return the record of an existing policy after checking that a training run would repeat it.

    Raises:
        PolicyError: If the policy was trained with another environment, seed or settings.
    """
    record = load_policy(policy).record
    requested = {"env": job.env_id, "seed": job.seed, "env_kwargs": job.env_kwargs}
    requested["settings"] = json.loads(json.dumps(job.settings.as_dict()))
    for key, value in requested.items():
        trained = record[key]
        if trained != value:
            if isinstance(value, dict):
                key = next(name for name in {**value, **trained} if trained.get(name, ...) != value.get(name, ...))
                trained, value = trained.get(key), value.get(key)
            raise PolicyError(
                f"{policy}: trained with {key} = {trained!r}, requested {value!r}; give another --runs folder"
            )
    return record
