"""Train a learner on plain arrays, such as `learners.ppo.FastPPO`, and write its files.

A learner has the methods `iterate`, `actor`, `state` and `restore`, and the attributes `steps`, `episodes`, `envs`,
`step_seconds` and `collect_seconds`.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from ce_gym.learn.runs.folder import continue_if_full, make_folder, save_somewhere, write_whole
from ce_gym.learn.runs.job import CHECKPOINTS, Clock, Job, Trained, acting_environment, make_record
from ce_gym.learn.runs.logs import open_writers
from ce_gym.learn.runs.page import Present
from ce_gym.learn.runs.progress import Log, ProgressBar, StopInOrder, log_row
from ce_gym.policies import Policy, PolicyError, locate_policy, write_npz


def run_learner(kind: Callable[[VectorEnv, Job], Any], job: Job) -> Trained:
    """Train with a learner, and save the policy even if Ctrl-C ends training early.

    Args:
        kind: Function that returns the learner.
        job: The training run.

    Raises:
        PolicyError: If the policy to resume does not fit the environment or the settings.
    """
    make_folder(job.out)
    envs = _environments(job)
    try:
        learner = kind(envs, job)
        if job.resume:
            resume(learner, job.resume)
        return _learn(learner, job)
    finally:
        envs.close()


def _environments(job: Job) -> VectorEnv:
    """Return the environments of a training run."""
    options = {"dtype": "float32", "num_threads": job.threads, "autoreset_mode": AutoresetMode.SAME_STEP}
    mode, num_envs = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT, job.settings.num_envs
    options |= {**job.env_kwargs, **job.settings.training}
    return gymnasium.make_vec(job.env_id, num_envs=num_envs, vectorization_mode=mode, **options)


def _learn(learner: Any, job: Job) -> Trained:
    """Run the learner to the end, to the deadline or to Ctrl-C, and save."""
    s, native, clock = job.settings, acting_environment(job, learner.envs.unwrapped), Clock()
    log = Log(job.out, job.resume, learner.steps, open_writers(job.logs, job.out, s.as_dict()))
    bar = ProgressBar(s.steps, learner.steps)

    def record(finished: bool = False) -> dict[str, Any]:
        written = make_record(job, native, learner.steps, clock, ("numba",))
        return written | {"finished": finished, "shares": bar.shares}

    every = max(s.steps // CHECKPOINTS, 1)
    present = Present(lambda path: save_policy(learner, record(), path), job.out, job.page)
    with StopInOrder(job.seconds) as stop:
        while learner.steps < s.steps and not stop.due:
            checkpoints = learner.steps // every
            figures, means = learner.iterate(), learner.episodes.means()
            if means:
                log.add(log_row(learner.steps, means, figures))
            bar.advance(learner.steps)
            bar.describe(means, learner.step_seconds, learner.collect_seconds)
            present.keep()
            if learner.steps // every > checkpoints and learner.steps < s.steps:
                with continue_if_full():
                    save(learner, record(), job.out / "checkpoints" / f"policy_{learner.steps}")
        bar.close()
        log.close()
    written = record(finished=not stop.interrupted)
    policy = save_somewhere(lambda folder: save(learner, written, folder / "policy"), job.out)
    return Trained(Policy(learner.actor(), written), written, policy, stop.interrupted)


def save(learner: Any, record: dict[str, Any], path: Path) -> Path:
    """Write `path`.npz, .json and .learner.npz, all or no file, and return the path of the policy.

    Raises:
        OSError: If they cannot be written.
    """
    state, policy = io.BytesIO(), io.BytesIO()
    np.savez(state, allow_pickle=False, **learner.state())
    write_npz(learner.actor(), record, policy)
    text = json.dumps(record, indent=2) + "\n"
    files = {".learner.npz": state.getvalue(), ".json": text.encode(), ".npz": policy.getvalue()}
    write_whole({path.with_name(path.name + kind): data for kind, data in files.items()})
    return path.with_name(f"{path.name}.npz")


def save_policy(learner: Any, record: dict[str, Any], path: Path) -> None:
    """Write `path`.npz, the policy without the state of its learner.

    Raises:
        OSError: If the file cannot be written.
    """
    policy = io.BytesIO()
    write_npz(learner.actor(), record, policy)
    write_whole({path.with_name(f"{path.name}.npz"): policy.getvalue()})


def resume(learner: Any, policy: Path) -> None:
    """Let a learner continue from a policy.

    Raises:
        PolicyError: If the state of the policy's learner is missing, damaged or of another network.
    """
    file = locate_policy(policy).with_suffix(".learner.npz")
    try:
        with np.load(file, allow_pickle=False) as arrays:
            learner.restore({name: arrays[name] for name in arrays.files})
    except FileNotFoundError:
        raise PolicyError(f"{file}: no such file; expected the file that its learner writes beside a policy") from None
    except (OSError, LookupError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise PolicyError(f"{file}: training cannot continue: {' '.join(str(error).split())[:200]}") from None
