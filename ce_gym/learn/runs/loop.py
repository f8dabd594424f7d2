"""Train a learner, and write the files of its run.

A learner has the methods `iterate`, `actor`, `state` and `restore`, and the attributes `steps`, `episodes`, `envs`,
`step_seconds` and `collect_seconds`. The learner of Stable-Baselines3 has `archive`, the content of its policy file,
and `packages`, recorded with their versions.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from ce_gym.console import file_error
from ce_gym.files import write_whole
from ce_gym.learn.runs.folder import continue_if_full, remove, run_folder
from ce_gym.learn.runs.job import Job, Trained, acting_environment, make_record
from ce_gym.learn.runs.logs import open_trackers
from ce_gym.learn.runs.progress import Log, ProgressBar, StopInOrder
from ce_gym.policies import Policy, PolicyError, keep_map, locate_policy, write_npz

CHECKPOINTS = 10
"""Checkpoints per training run."""

PERIOD = 5.0
"""Time between two writings of the current policy [s], for a page that shows it, and for runs that are killed."""


def run_learner(kind: Callable[[VectorEnv, Job], Any], job: Job) -> Trained:
    """Train with a learner, and save the policy even if Ctrl-C ends training early.

    Args:
        kind: Function that returns the learner.
        job: The training run.

    Raises:
        OSError: If the folder has another run or another owner, or cannot be written.
        PolicyError: If the policy to resume does not fit the environment or the settings.
    """
    state = locate_policy(job.resume).with_suffix(".learner.npz") if job.resume else None
    if state and not state.exists():
        raise PolicyError(f"{state}: no such file; expected the file that its learner writes beside a policy")
    options = {"dtype": "float32", "num_threads": job.threads, "autoreset_mode": AutoresetMode.SAME_STEP}
    mode, num_envs = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT, job.settings.num_envs
    options |= {**job.env_kwargs, **job.settings.training}
    with run_folder(job.out, job.resume) as replaced:
        envs = gymnasium.make_vec(job.env_id, num_envs=num_envs, vectorization_mode=mode, **options)
        with contextlib.closing(envs):
            learner = kind(envs, job)
            if state:
                restore(learner, state)
            return _learn(learner, job, replaced)


def _learn(learner: Any, job: Job, replaced: list[Path]) -> Trained:
    """Run the learner to the end, to the deadline or to Ctrl-C, and save.

    The first update removes the files `replaced` of an earlier run.
    """
    s, native = job.settings, acting_environment(job, learner.envs.unwrapped)
    log = Log(job.out, job.resume, learner.steps, open_trackers(job.logs, job.out, s.as_dict()))
    bar = ProgressBar(s.steps, learner.steps)
    started, packages = (time.perf_counter(), time.process_time()), getattr(learner, "packages", ("numba",))
    checkpoint, due = max(s.steps // CHECKPOINTS, 1), 0.0

    def record(finished: bool = False) -> dict[str, Any]:
        spent = {"training_seconds": time.perf_counter(), "processor_seconds": time.process_time()}
        spent = {name: round(now - start, 1) for (name, now), start in zip(spent.items(), started, strict=True)}
        return make_record(job, native, learner.steps, packages) | spent | {"finished": finished}

    with StopInOrder(job.seconds) as stop, contextlib.closing(bar.bar):
        while learner.steps < s.steps and not stop.due:
            checkpoints = learner.steps // checkpoint
            figures, means = learner.iterate(), learner.episodes.means()
            if not stop.has_progress:
                remove(replaced)
                keep_map(job.env_kwargs, job.out)
                stop.has_progress = True
            if means:
                log.add(learner.steps, means, figures)
            bar.show(learner)
            with continue_if_full():
                if learner.steps // checkpoint > checkpoints and learner.steps < s.steps:
                    save(learner, record(), job.out / "checkpoints" / f"policy_{learner.steps}")
                if time.monotonic() >= due:
                    due = time.monotonic() + PERIOD
                    save(learner, record(), job.out / "policy")
    log.close()
    written = record(finished=not stop.interrupted) | {"ended": True}
    try:
        policy = save(learner, written, job.out / "policy")
    except OSError as error:
        elsewhere = Path(tempfile.mkdtemp(prefix="ce_gym-"))
        print(f"warning: {file_error(error)}; saving to {elsewhere}", file=sys.stderr, flush=True)
        policy = save(learner, written, elsewhere / "policy")
    return Trained(Policy(learner.actor(), written), written, policy, stop.interrupted)


def save(learner: Any, record: dict[str, Any], path: Path) -> Path:
    """Write `path`.npz or .zip, .json and .learner.npz, all or no file, and return the path of the policy.

    Raises:
        OSError: If they cannot be written.
    """
    state, policy = io.BytesIO(), io.BytesIO()
    np.savez(state, allow_pickle=False, **learner.state())
    suffix = ".zip" if hasattr(learner, "archive") else ".npz"
    if suffix == ".zip":
        policy.write(learner.archive())
    else:
        write_npz(learner.actor(), record, policy)
    text = json.dumps(record, indent=2) + "\n"
    files = {".learner.npz": state.getvalue(), ".json": text.encode(), suffix: policy.getvalue()}
    write_whole({path.with_name(path.name + kind): data for kind, data in files.items()})
    return path.with_name(path.name + suffix)


def restore(learner: Any, file: Path) -> None:
    """Let a learner continue from a state in a file, see `save`.

    Raises:
        PolicyError: If the state is damaged or of another network.
    """
    try:
        with np.load(file, allow_pickle=False) as arrays:
            learner.restore({name: arrays[name] for name in arrays.files})
    except (OSError, LookupError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise PolicyError(f"{file}: training cannot continue: {' '.join(str(error).split())[:200]}") from None
