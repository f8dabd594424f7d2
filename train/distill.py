"""Train a student that sees what a real robot senses to do what a teacher does that sees more.

DAgger (Ross et al. 2011, arXiv:1011.0686) without memory: the student acts, the teacher says in each of the student's
states what it would have done, and the student is fitted to that by least squares. The environment is the student's;
the teacher sees its blocks among those of the critic, which have neither noise, nor delay, nor history. Same command
line, files and settings machinery as train/fast_ppo.py; settings are in train/config/distill. Uses public names of
ce_gym only, and no name of a robot or task.

    python train/distill.py --env ce_gym/MiniCheetahVelocity-v0
    python train/distill.py --env ce_gym/MiniCheetahVelocity-v0 --set teacher=runs/mini_cheetah_velocity-fast
"""

from __future__ import annotations

import interruption  # noqa: F401
import single_blas  # noqa: F401

# isort: split

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from console import report_missing
from gymnasium.vector import VectorEnv
from job import Job, Trained
from job import main as run_jobs
from numpy.typing import NDArray
from progress import RecentEpisodes, geometric, linear, spread_episodes
from run_learner import run_learner
from settings import CONFIG_FOLDER, Activation

try:
    from loops import adam
    from networks import KINDS, layers_of, make_work, outputs, parameter_count, start_layers
    from regression import squared_error_gradient
except ModuleNotFoundError as error:
    raise SystemExit(report_missing("distill.py", error)) from None

from ce_gym.policies import Actor, Policy, PolicyError, load_policy

F = np.float32


@dataclass(frozen=True)
class Settings:
    """Everything that shapes a student, apart from the environment's id and the seed.

    Attributes:
        teacher: A policy: a file, the folder of a run, or the name of one that comes along.
        initial_std: Standard deviation of what is added to the student's actions while it collects, at the start.
        final_std: At the end, geometric in between.
        learning_rate: Of Adam, at the start; it falls linearly to 0.
    """

    folder: ClassVar[Path] = CONFIG_FOLDER / "distill"

    teacher: str
    steps: int
    num_envs: int
    rollout: int
    minibatches: int
    epochs: int
    hidden: tuple[int, ...]
    activation: Activation
    initial_std: float
    final_std: float
    learning_rate: float
    max_grad_norm: float
    training: Mapping[str, Any]


SENSOR_ERRORS = ("drift", "shift", "dropout", "delay")
"""Parameters of observation blocks that the critic does not see."""


def teacher_columns(teacher: Policy, name: str, native: Any, kwargs: Mapping[str, Any]) -> NDArray[np.intp]:
    """Return where the teacher finds its observation in the critic's, shape (n_obs,).

    Args:
        teacher: With its record.
        name: What the user calls it.
        native: The student's environments, unwrapped.
        kwargs: What they were made with.

    Raises:
        PolicyError: If the teacher has a history, or a block is not shown to the critic, or is another one there.
    """
    seen, known = teacher.record["policy_spec"]["observation"], native.critic_structure
    if seen["history"] != 1:
        raise PolicyError(f"{name}: history={seen['history']}; expected a teacher that sees the present alone")
    starts = dict(zip(known, np.cumsum([0, *known.values()]).tolist(), strict=False))
    here, there, found = _parameters(kwargs), _parameters(teacher.record["env_kwargs"]), []
    for key, size in ((block["name"], block["size"]) for block in seen["blocks"]):
        if key not in known:
            raise PolicyError(f"{name}: sees {key}; expected it among what the critic sees: {', '.join(known)}")
        wanted, given = there.get(key, {}), here.get(key, {})
        named = {*wanted, *given} - {*SENSOR_ERRORS}
        if known[key] != size or any(given.get(one) != wanted.get(one) for one in named):
            raise PolicyError(
                f"{name}: sees {key} of {wanted}, {size} numbers; here it has {given}, {known[key]} numbers"
            )
        found.append(np.arange(starts[key], starts[key] + size))
    return np.concatenate(found)


def _parameters(kwargs: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Parameters of observation blocks, by name, as arguments of an environment have them."""
    given = (kwargs.get(key, {}) for key in ("critic", "observations"))
    return {name: parameters for group in given if isinstance(group, Mapping) for name, parameters in group.items()}


class Distiller:
    """A student that learns from a teacher.

    Args:
        envs: A vector environment of ours in SAME_STEP autoreset mode, whose critic sees what the teacher sees.
        job: The training run.

    Attributes:
        theta: Parameters of the student.
        steps: Environment steps done.
        step_seconds, collect_seconds: Time spent inside the environment, and in collection as a whole [s].

    Raises:
        PolicyError: If the teacher cannot be read, or cannot see or do here what it was trained with.
    """

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        self.envs, self.settings, s = envs, job.settings, job.settings
        native: Any = envs.unwrapped
        spaces: Any = envs.single_observation_space, envs.single_action_space
        if not isinstance(spaces[0], gymnasium.spaces.Dict):
            raise PolicyError(f"{job.env_id}: obs_mode: expected dict, so that the teacher sees what the critic does")
        self.teacher, size, self.n_actions = load_policy(s.teacher), spaces[0]["policy"].shape[0], spaces[1].shape[0]
        self.columns = teacher_columns(self.teacher, s.teacher, native, {**job.env_kwargs, **s.training})
        if self.teacher.record["action_size"] != self.n_actions:
            found = self.teacher.record["action_size"]
            raise PolicyError(f"{s.teacher}: has {found} actions; expected {self.n_actions}, as the student")
        self.sizes = np.array([size, *s.hidden, self.n_actions])
        self.kind, self.rng = KINDS.index(s.activation), np.random.default_rng(job.seed)
        self.theta = np.zeros(parameter_count(self.sizes), F)
        start_layers(self.theta, self.sizes, 0.01, self.rng)
        self.moments, self.steps, self.updates = np.zeros((2, self.theta.size), F), 0, 0
        self.episodes, self.work = RecentEpisodes(s.num_envs), make_work(self.sizes)
        self.step_seconds = self.collect_seconds = 0.0
        shape = (s.rollout, s.num_envs)
        self.seen, self.labels = np.zeros((*shape, size), F), np.zeros((*shape, self.n_actions), F)
        self.observed = {name: np.ascontiguousarray(x, F) for name, x in envs.reset(seed=job.seed)[0].items()}
        spread_episodes(native, self.rng)

    def iterate(self) -> dict[str, float]:
        """Act for a rollout and learn what the teacher would have done; return what the log shows."""
        s, done, start = self.settings, min(self.steps / self.settings.steps, 1.0), time.perf_counter()
        self.collect(F(geometric(s.initial_std, s.final_std, done)))
        self.collect_seconds += time.perf_counter() - start
        rate = linear(s.learning_rate, 0.0, done)
        error = self.learn(rate)
        self.steps += s.rollout * s.num_envs
        return {"train/error": error**0.5, "train/learning_rate": rate}

    def collect(self, std: np.float32) -> None:
        """Act for a rollout by the student, with noise, and ask the teacher."""
        actions = np.empty((self.settings.num_envs, self.n_actions), F)
        for t in range(self.settings.rollout):
            self.seen[t] = self.observed["policy"]
            self.labels[t] = self.teacher.predict(self.observed["critic"][:, self.columns])[0]
            outputs(self.theta, self.sizes, self.kind, self.seen[t], actions, self.work)
            noisy = np.clip(actions + std * self.rng.standard_normal(actions.shape, F), F(-1), F(1))
            start = time.perf_counter()
            observed, _, terminated, truncated, infos = self.envs.step(noisy)
            self.step_seconds += time.perf_counter() - start
            self.observed = {name: np.ascontiguousarray(x, F) for name, x in observed.items()}
            if (ended := terminated | truncated).any():
                self.episodes.add(ended, infos)

    def learn(self, rate: float) -> float:
        """Go over the rollout in minibatches drawn anew; return the mean squared error the last time."""
        s, n = self.settings, self.settings.rollout * self.settings.num_envs
        seen, labels, size = self.seen.reshape(n, -1), self.labels.reshape(n, -1), -(-n // s.minibatches)
        errors: list[float] = []
        for _ in range(s.epochs):
            order, errors = self.rng.permutation(n), []
            for i in range(0, n, size):
                gradient, rows = np.zeros_like(self.theta), order[i : i + size]
                samples = (self.theta, self.sizes, self.kind, seen, labels, rows, gradient, self.work)
                errors.append(float(squared_error_gradient(*samples)))
                self.updates += 1
                adam(self.theta, gradient, self.moments[0], self.moments[1], self.updates, rate, s.max_grad_norm)
        return float(np.mean(errors))

    def actor(self) -> Actor:
        """The layers that turn observations into mean actions, copies."""
        layers = layers_of(self.theta, self.sizes)
        return Actor(tuple((weight.T.copy(), bias.copy()) for weight, bias in layers), self.settings.activation)

    def state(self) -> dict[str, NDArray]:
        """All that going on needs, as arrays: see `restore`."""
        native: Any = self.envs.unwrapped
        facts = {
            "steps": self.steps, "updates": self.updates, "rng": self.rng.bit_generator.state,
            "sizes": self.sizes.tolist(), "activation": self.settings.activation, "episodes": self.episodes.names,
        }  # fmt: skip
        found = {"facts": np.array(json.dumps(facts)), "theta": self.theta, "moments": self.moments}
        found |= {f"observed_{name}": rows for name, rows in self.observed.items()} | {"episodes": self.episodes.rows()}
        return found | {f"env/{name}": array for name, array in native.snapshot().items()}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from a state; environments begin anew if they are more or fewer.

        Raises:
            ValueError: If it is of another network.
        """
        facts = json.loads(str(state["facts"]))
        mine = [self.sizes.tolist(), self.settings.activation]
        if [facts["sizes"], facts["activation"]] != mine:
            raise ValueError(f"has layers {facts['sizes']}, {facts['activation']}; expected {mine[0]}, {mine[1]}")
        self.theta[:], self.moments[:] = state["theta"], state["moments"]
        self.steps, self.updates = facts["steps"], facts["updates"]
        self.rng.bit_generator.state = facts["rng"]
        if len(state["observed_policy"]) == self.settings.num_envs:
            native: Any = self.envs.unwrapped
            native.restore({name.removeprefix("env/"): x for name, x in state.items() if name.startswith("env/")})
            self.observed = {name: state[f"observed_{name}"] for name in self.observed}
            self.episodes.restore(facts["episodes"], state["episodes"])


def train(job: Job) -> Trained:
    """Train, and save the student even if Ctrl-C ends training early; see `run_learner`."""
    return run_learner(Distiller, job, "distill")


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    return run_jobs("distill.py", train, argv, folder="-distill", settings=Settings)


if __name__ == "__main__":
    raise SystemExit(main())
