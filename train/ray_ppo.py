# pyright: reportMissingImports=false
"""PPO of train/fast_ppo.py on several cores or machines, with workers that Ray starts.

Each worker has its own environments, and torch's all-reduce averages the gradients, see averaged_ppo.py. If a worker or
its machine fails, all workers restart from the last iteration. Settings, files and arguments are the same as in
train/fast_ppo.py, and both scripts can resume each other's policies; `num_envs` and `steps` count all workers together.
Needs the extra `ray` in a separate virtual environment, see docs/how-to/learners.md. Uses public names of ce_gym only,
and no name of a robot or task.

    python train/ray_ppo.py --env ce_gym/MiniCheetahVelocity-v0 --workers 2
    python train/ray_ppo.py --env ce_gym/MiniCheetahVelocity-v0 --workers 8 --address auto --threads 16
"""

from __future__ import annotations

import interruption  # noqa: F401

# isort: split

import json
import socket
import time
from argparse import ArgumentParser
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from typing import Any

import numpy as np
import ray
from averaged_ppo import AveragedPPO, share
from console import whole
from gymnasium.vector import VectorEnv
from job import Job, Trained
from job import main as run_jobs
from numpy.typing import NDArray
from run_learner import environments, run_learner
from torch import distributed

from ce_gym.policies import Actor

PATIENCE = timedelta(seconds=60)
"""Time after which a worker regards the others as lost."""

ATTEMPTS = 3
"""Attempts at an iteration before training ends with an error."""


@dataclass(frozen=True)
class Iteration:
    """Report of a worker after an iteration.

    Attributes:
        figures: Statistics for the log.
        means: Means of recent episodes.
        times: Time in the environment, time in collection, and processor time since the start [s].
        learned: State of the learner.
        actor: The policy.
    """

    figures: dict[str, float]
    means: dict[str, float]
    times: tuple[float, float, float]
    learned: dict[str, NDArray]
    actor: Actor


class Worker:
    """A process started by Ray."""

    def __init__(self, job: Job) -> None:
        self.job = job

    def meeting_point(self) -> str:
        """Return an address for the process group."""
        with socket.socket() as free:
            free.bind(("", 0))
            return f"tcp://{ray.util.get_node_ip_address()}:{free.getsockname()[1]}"

    def join(self, point: str, rank: int, count: int, learned: dict[str, NDArray]) -> Iteration:
        """Join the process group, and continue from `learned` if it is not empty."""
        distributed.init_process_group("gloo", init_method=point, rank=rank, world_size=count, timeout=PATIENCE)
        self.learner = AveragedPPO(environments(self.job), self.job)
        if learned:
            self.learner.restore(learned)
        return self._report({})

    def iterate(self) -> Iteration:
        """Collect a rollout and learn from it."""
        return self._report(self.learner.iterate())

    def _report(self, figures: dict[str, float]) -> Iteration:
        learner = self.learner
        times = (learner.step_seconds, learner.collect_seconds, time.process_time())
        return Iteration(figures, learner.episodes.means(), times, learner.learned(), learner.actor())


class Episodes:
    """Means of the workers' recent episodes."""

    def __init__(self) -> None:
        self.each: list[dict[str, float]] = []

    def means(self) -> dict[str, float]:
        """Return the mean of every entry; empty before the first episode ends."""
        reported = [means for means in self.each if means]
        if not reported:
            return {}
        return {name: float(np.mean([means[name] for means in reported])) for name in reported[0]}


class RayPPO:
    """Learner of `run_learner` whose workers train one policy.

    Args:
        envs: Environments of the same kind as the workers' ones; they are not stepped.
        job: The training run.
        workers: Number of workers.
        threads: Threads of each worker.

    Raises:
        SettingsError: If the environments cannot be divided among the workers.
    """

    def __init__(self, envs: VectorEnv, job: Job, workers: int, threads: int) -> None:
        self.envs, self.steps, self.episodes, self.threads = envs, 0, Episodes(), threads
        self.step_seconds = self.collect_seconds = self.processor_seconds = 0.0
        self.shares = [share(replace(job, threads=threads), rank, workers) for rank in range(workers)]
        self.learned: dict[str, NDArray] = {}
        self.workers: list[Any] = []
        self._attempt(lambda: None)

    def iterate(self) -> dict[str, float]:
        """Let all workers collect and learn; return statistics for the log."""
        reports = self._attempt(lambda: ray.get([worker.iterate.remote() for worker in self.workers]))
        self._store(reports)
        self.steps += sum(s.settings.num_envs * s.settings.rollout for s in self.shares)
        return reports[0].figures

    def actor(self) -> Actor:
        """Return the layers from observations to mean actions."""
        return self._actor

    def state(self) -> dict[str, NDArray]:
        """Return the state of the learner as arrays."""
        return self.learned

    def restore(self, state: dict[str, NDArray]) -> None:
        """Continue from a state; environments are reset."""
        self.learned = {name: state[name] for name in ("facts", "theta", "moments")}
        self.steps = json.loads(str(state["facts"]))["steps"]
        self._stop()
        self._attempt(lambda: None)

    def _attempt(self, work: Any) -> Any:
        """Return the result of a function that uses the workers; start the workers first if they are not running."""
        for _ in range(ATTEMPTS):
            try:
                if not self.workers:
                    self._start()
                return work()
            except ray.exceptions.RayError as error:
                fault = error
                self._stop()
        raise ValueError(f"workers failed {ATTEMPTS} times in a row: {str(fault).splitlines()[-1]}")

    def _start(self) -> None:
        make, count = ray.remote(Worker).options(num_cpus=self.threads), len(self.shares)
        self.workers = [make.remote(job) for job in self.shares]
        point = ray.get(self.workers[0].meeting_point.remote())
        joined = [worker.join.remote(point, rank, count, self.learned) for rank, worker in enumerate(self.workers)]
        self._store(ray.get(joined))

    def _stop(self) -> None:
        for worker in self.workers:
            with suppress(ray.exceptions.RayError):
                ray.kill(worker)
        self.workers = []

    def _store(self, reports: list[Iteration]) -> None:
        """Store the reports of the workers."""
        times = np.array([report.times for report in reports])
        self.step_seconds, self.collect_seconds = times[:, :2].mean(axis=0).tolist()
        self.processor_seconds = float(times[:, 2].sum())
        self.episodes.each = [report.means for report in reports]
        self.learned, self._actor = reports[0].learned, reports[0].actor


def train(job: Job, workers: int, address: str | None) -> Trained:
    """Train, and save the policy even if Ctrl-C ends training early.

    Raises:
        PolicyError: If the policy to resume does not fit the environment or the settings.
        SettingsError: If the environments cannot be divided among the workers.
        ValueError: If workers fail in `ATTEMPTS` attempts.
    """
    threads = job.threads if address else max(job.threads // workers, 1)
    cores = None if address else workers * threads
    ray.init(address=address, num_cpus=cores, log_to_driver=False, logging_level="error")
    try:
        return run_learner(partial(RayPPO, workers=workers, threads=threads), job, "ray_ppo", num_envs=1)
    finally:
        ray.shutdown()


def add_options(parser: ArgumentParser) -> None:
    """Add the options of this learner."""
    clusters = "Ray cluster, such as auto; --threads are then each worker's, otherwise they are shared among workers"
    parser.add_argument(
        "--workers", type=whole(1, 10_000), default=2, metavar="N", help="processes that learn (default 2)"
    )
    parser.add_argument("--address", metavar="HOST:PORT", help=clusters)


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    return run_jobs("ray_ppo.py", train, argv, folder="-ray", add_options=add_options)


if __name__ == "__main__":
    raise SystemExit(main())
