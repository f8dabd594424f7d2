"""Short training runs on the toy environment."""

import numpy as np
from point_mass import ID

from ce_gym.learn.runs.job import Job
from ce_gym.learn.runs.settings import config_file, load_settings

SMALL = ["num_envs=64", "rollout=16", "hidden=[16]", "epochs=4", "minibatches=2", "learning_rate=1e-2", "target_kl=0"]
SMALL += ["gamma=0.9", "training={}"]
FAST = ["--no-tensorboard", "--episodes", "8", "--threads", "1", "--set", *SMALL]


def job(out, steps, env=ID, settings=(), **changes):
    """A training run without TensorBoard, in the environment without arguments unless `changes` says otherwise."""
    chosen = load_settings(config_file(env), [*SMALL, f"steps={steps}", *settings])
    return Job(env, chosen, out, **({"env_kwargs": {}, "tensorboard": False} | changes))


def parameters(policy):
    """All parameters that a learner over plain arrays has saved beside a policy."""
    with np.load(policy.with_suffix(".learner.npz"), allow_pickle=False) as arrays:
        return arrays["theta"]
