"""A process that learns with another one; module of its own, so that it can be imported in a new process."""

import socket
from datetime import timedelta

import point_mass  # noqa: F401  (registers the toy environment)
from averaged_ppo import AveragedPPO, share
from run_learner import environments
from torch import distributed


class Watched(AveragedPPO):
    """Keeps gradients before and after averaging."""

    def average(self, values):
        before = values.copy()
        after = super().average(values)
        self.averages = [*getattr(self, "averages", []), (before, after.copy())]
        return after


def free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def learn(job, port, rank, count, iterations):
    """Learn for some iterations, restore the result into another learner; return both for a test."""
    point, patience = f"tcp://127.0.0.1:{port}", timedelta(seconds=120)
    distributed.init_process_group("gloo", init_method=point, rank=rank, world_size=count, timeout=patience)
    mine = share(job, rank, count)
    learner = Watched(environments(mine), mine)
    rewards, figures = [], {}
    for _ in range(iterations):
        figures = learner.iterate()
        rewards.append(learner.episodes.means().get("r", float("nan")))
    found = {"theta": learner.theta.copy(), "averages": learner.averages, "actions": learner.actions.copy()}
    found |= {"rewards": rewards, "figures": figures, "learned": learner.learned()}
    again = Watched(environments(mine), mine)
    again.restore(found["learned"])
    found |= {"restored": (again.steps, again.theta.copy()), "noise": again.rng.standard_normal(4)}
    distributed.destroy_process_group()
    return found
