"""Short training runs on the toy environment."""

from pathlib import Path

import numpy as np
from point_mass import ID

from ce_gym.__main__ import _parser
from ce_gym.learn.commands.train import make_jobs
from ce_gym.learn.runs.job import Job
from ce_gym.learn.runs.settings import config_file, load_settings
from ce_gym.learn.training import learner

SMALL = ["num_envs=64", "rollout=16", "hidden=[16]", "epochs=4", "minibatches=2", "learning_rate=1e-2", "target_kl=0"]
SMALL += ["gamma=0.9", "training={}"]
FAST = ["--logs", "--episodes", "8", "--threads", "1", "--set", *SMALL]


def job(out: Path, steps: int, env: str = ID, settings=(), **changes) -> Job:
    """A training run without logs, in the environment without arguments unless `changes` says otherwise."""
    algo = changes.setdefault("algo", "ppo")
    kind = learner(algo).Settings
    chosen = load_settings(config_file(env, kind.folder), [*SMALL, f"steps={steps}", *settings], kind)
    return Job(env_id=env, settings=chosen, out=out, **({"env_kwargs": {}} | changes))


def jobs(*words: str) -> list[Job]:
    """The training runs of a command line behind `python -m ce_gym train`."""
    return make_jobs(_parser().parse_args(["train", *words]))


def parameters(policy):
    """All parameters that a learner over plain arrays has saved beside a policy."""
    with np.load(policy.with_suffix(".learner.npz"), allow_pickle=False) as arrays:
        return arrays["theta"]
