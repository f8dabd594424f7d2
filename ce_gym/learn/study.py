"""Training runs of one task at several transmission levels and with several seeds; finished runs are kept."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ce_gym.files import is_forced
from ce_gym.learn.runs.job import Job
from ce_gym.learn.training import make_job
from ce_gym.policies import PolicyError, find_policy, load_policy, locate_policy


def study_jobs(
    env_id: str = "",
    algo: str = "",
    *,
    levels: Sequence[str] = (),
    seeds: Sequence[int] = (0,),
    env_kwargs: Mapping[str, Any] | None = None,
    **options: Any,
) -> list[Job]:
    """Return training runs, level by level, in the subfolders `LEVEL/seed_N` of one folder.

    The folder has no subfolders for levels or seeds if there is at most one.

    Args:
        env_id: Registered environment id; may be empty with `resume`.
        algo: Name of the learner, see `make_job`.
        levels: Transmission levels; if empty, the environment's level.
        seeds: Seeds of each level.
        env_kwargs: Arguments of the environment.
        **options: See `make_job`.
    """
    kwargs = dict(env_kwargs or {})
    of_level = [kwargs | {"transmission": level} for level in levels] or [kwargs]
    options["several"] = len(levels) > 1 or len(seeds) > 1
    folder = make_job(env_id, algo, env_kwargs=of_level[0] if len(levels) < 2 else kwargs, **options).out
    jobs = []
    for arguments, seed in itertools.product(of_level, seeds):
        parts = [arguments["transmission"]] if len(levels) > 1 else []
        parts += [f"seed_{seed}"] if len(seeds) > 1 else []
        job = make_job(env_id, algo, seed=seed, env_kwargs=arguments, **options)
        jobs.append(job.replace(out=folder.joinpath(*parts)))
    return jobs


def unfinished(job: Job) -> Job | None:
    """Return a run that continues the policy in its folder if there is one, or None if that is finished.

    With `--force` all runs start again.

    Raises:
        PolicyError: If the policy was trained with another environment, seed or settings.
    """
    policy = find_policy(job.out)
    if policy is None or is_forced():
        return job
    record = load_policy(policy).record
    trained = {"env": record["env"], "seed": record["seed"], **record["env_kwargs"], **record["settings"]}
    settings = json.loads(json.dumps(job.settings.as_dict()))
    requested = {"env": job.env_id, "seed": job.seed, **job.env_kwargs, **settings}
    for key in {**requested, **trained}:
        if trained.get(key, ...) != requested.get(key, ...):
            both = f"trained with {key} = {trained.get(key)!r}, requested {requested.get(key)!r}"
            raise PolicyError(f"{policy}: {both}; give another --out folder, or --force")
    return None if record["finished"] else job.replace(resume=policy)


def policies_in(path: str | Path) -> list[Path]:
    """Return the policy at a path, see `ce_gym.policies.locate_policy`, or the policies of all runs in a folder.

    Raises:
        PolicyError: If there is no policy.
    """
    runs = sorted(file.parent for file in Path(path).rglob("policy.json"))
    return [locate_policy(run) for run in runs if find_policy(path) is None] or [locate_policy(path)]
