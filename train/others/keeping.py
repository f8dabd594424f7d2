"""Times another library's learner and keeps its policies as ours, so that `train/table.py` judges all alike.

A learner that collects and updates by turns is watched from outside: by what its environments' `step` and its own
update take, and after each update by the steps done.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from job import CHECKPOINTS, Clock, Job, Trained, acting_environment, make_record
from run_folder import make_folder

from ce_gym.policies import Actor, Policy, write_npz


class Keeper:
    """Watches one training run.

    Args:
        job: The training run.
        native: Its environments, unwrapped.
        actor: Gives the present one, deterministic.
        packages: Whose versions matter.
    """

    def __init__(self, job: Job, native: Any, actor: Callable[[], Actor], packages: tuple[str, ...]) -> None:
        make_folder(job.out / "checkpoints")
        self.job, self.actor, self.packages = job, actor, packages
        self.acting = acting_environment(job, native)
        self.steps, self.batch = 0, job.settings.num_envs * job.settings.rollout
        self.seconds = {"physics": 0.0, "learning": 0.0}
        self.clock, self.start = Clock(), time.perf_counter()

    def watch(self, holder: Any, environments: str, learner: Any, update: str) -> None:
        """Time a method of the environments and the learner's update; after each of those steps are counted."""
        setattr(holder, environments, self._timed(getattr(holder, environments), "physics"))
        whole = self._timed(getattr(learner, update), "learning")

        def counted(*args: Any, **kwargs: Any) -> Any:
            result = whole(*args, **kwargs)
            self._updated()
            return result

        setattr(learner, update, counted)

    @property
    def remaining(self) -> float:
        """Share of the steps that are still to be done, 1 to 0."""
        return max(1.0 - self.steps / self.job.settings.steps, 0.0)

    def end(self) -> Trained:
        """Write the policy, and return what training leaves."""
        record = self._record()
        path = self._write(self.job.out / "policy.npz", record)
        return Trained(Policy(self.actor(), record), record, path, interrupted=False)

    def _timed(self, function: Callable[..., Any], kind: str) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[kind] += time.perf_counter() - start

        return timed

    def _updated(self) -> None:
        every, before = self.job.settings.steps // CHECKPOINTS, self.steps
        self.steps += self.batch
        if self.steps // every > before // every and self.steps < self.job.settings.steps:
            self._write(self.job.out / "checkpoints" / f"policy_{self.steps}.npz", self._record())

    def _write(self, file: Any, record: dict[str, Any]) -> Any:
        write_npz(self.actor(), record, file)
        file.with_suffix(".json").write_text("{}\n", encoding="utf-8")  # by which checkpoints are found
        return file

    def _record(self) -> dict[str, Any]:
        whole = time.perf_counter() - self.start
        shares = {kind: round(seconds / whole, 3) for kind, seconds in self.seconds.items()}
        shares["policy"] = round(1.0 - sum(shares.values()), 3)
        return make_record(self.job, self.acting, self.steps, self.clock, self.packages) | {"shares": shares}
