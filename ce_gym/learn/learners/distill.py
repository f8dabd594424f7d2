"""Train a student, whose observations a real robot can measure, to imitate a teacher with more observations.

DAgger (Ross et al. 2011, arXiv:1011.0686) without memory: the student acts, the teacher labels each state with its own
action, and least squares fit the student to the labels. The environment belongs to the student. The teacher uses
observation blocks of the critic, which have no noise, delay or history. Command line and files are the same as in
train/fast_ppo.py; settings are in train/config/distill.

    python train/distill.py --env ce_gym/MiniCheetahVelocity-v0
    python train/distill.py --env ce_gym/MiniCheetahVelocity-v0 --set teacher=runs/mini_cheetah_velocity-fast
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from ce_gym.learn.networks.perceptron import KINDS, layers_of, make_work, outputs, parameter_count, start_layers
from ce_gym.learn.networks.regression import squared_error_gradient
from ce_gym.learn.networks.updates import adam
from ce_gym.learn.runs.job import Job, Trained
from ce_gym.learn.runs.progress import RecentEpisodes, geometric, linear, spread_episodes
from ce_gym.learn.runs.settings import CONFIG_FOLDER, CommonSettings
from ce_gym.learn.runs.training import run_learner
from ce_gym.model.arguments import check
from ce_gym.model.options import option
from ce_gym.policies import Actor, Policy, PolicyError, load_policy

F = np.float32


def _text(name: str, value: Any) -> str:
    """Check a name or a path."""
    check(name, value, isinstance(value, str) and value, "a name or a path")
    return value


@dataclass(frozen=True)
class Settings(CommonSettings):
    """Settings of distillation.

    Attributes:
        teacher: A policy: a file, the folder of a run, or the name of a shipped policy.
        initial_std: Standard deviation of the noise on the student's actions during collection, at the start.
        final_std: Standard deviation at the end, geometric in between.
        learning_rate: Learning rate of Adam at the start; it falls linearly to 0.
    """

    folder: ClassVar[Path] = CONFIG_FOLDER / "distill"

    teacher: str = option(_text)


SENSOR_ERRORS = ("drift", "shift", "dropout", "delay")
"""Parameters of observation blocks that have no effect on the critic's observation."""


def teacher_columns(teacher: Policy, name: str, native: Any, kwargs: Mapping[str, Any]) -> NDArray[np.intp]:
    """Return the columns of the teacher's observation in the critic's observation, shape (n_obs,).

    Args:
        teacher: Teacher with its record.
        name: Name of the teacher in errors.
        native: The student's environments, unwrapped.
        kwargs: Arguments of these environments.

    Raises:
        PolicyError: If the teacher has a history, or the critic lacks a block or has it with other parameters.
    """
    observation, blocks = teacher.record["policy_spec"]["observation"], native.critic_structure
    if observation["history"] != 1:
        raise PolicyError(f"{name}: history={observation['history']}; expected a teacher without history")
    starts = dict(zip(blocks, np.cumsum([0, *blocks.values()]).tolist(), strict=False))
    of_critic, of_teacher = _parameters(kwargs), _parameters(teacher.record["env_kwargs"])
    columns = []
    for key, size in ((block["name"], block["size"]) for block in observation["blocks"]):
        if key not in blocks:
            raise PolicyError(f"{name}: observes {key}; expected one of the critic's blocks: {', '.join(blocks)}")
        trained, present = of_teacher.get(key, {}), of_critic.get(key, {})
        parameters = {*trained, *present} - {*SENSOR_ERRORS}
        if blocks[key] != size or any(present.get(p) != trained.get(p) for p in parameters):
            raise PolicyError(
                f"{name}: observes {key} with {trained}, size {size}; here it has {present}, size {blocks[key]}"
            )
        columns.append(np.arange(starts[key], starts[key] + size))
    return np.concatenate(columns)


def _parameters(kwargs: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the parameters of observation blocks in the arguments of an environment, by name of the block."""
    groups = (kwargs.get(key, {}) for key in ("critic", "observations"))
    return {name: parameters for group in groups if isinstance(group, Mapping) for name, parameters in group.items()}


class Distiller:
    """Learner of a student that imitates a teacher.

    Args:
        envs: A vector environment of ce_gym in SAME_STEP autoreset mode, with the teacher's blocks in the critic.
        job: The training run.

    Attributes:
        theta: Parameters of the student.
        steps: Environment steps done.
        step_seconds, collect_seconds: Time inside the environment, and in collection including it [s].

    Raises:
        PolicyError: If the teacher cannot be read, or its observations or actions do not fit the environment.
    """

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        self.envs, self.settings, s = envs, job.settings, job.settings
        native: Any = envs.unwrapped
        spaces: Any = envs.single_observation_space, envs.single_action_space
        if not isinstance(spaces[0], gymnasium.spaces.Dict):
            raise PolicyError(f"{job.env_id}: obs_mode: expected dict, for the observation of the teacher")
        self.teacher, size, self.n_actions = load_policy(s.teacher), spaces[0]["policy"].shape[0], spaces[1].shape[0]
        self.columns = teacher_columns(self.teacher, s.teacher, native, {**job.env_kwargs, **s.training})
        if self.teacher.record["action_size"] != self.n_actions:
            n_teacher = self.teacher.record["action_size"]
            raise PolicyError(f"{s.teacher}: has {n_teacher} actions; expected {self.n_actions}, as the student")
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
        """Collect a rollout and fit the student to the teacher's actions; return statistics for the log."""
        s, done, start = self.settings, min(self.steps / self.settings.steps, 1.0), time.perf_counter()
        self.collect(F(geometric(s.initial_std, s.final_std, done)))
        self.collect_seconds += time.perf_counter() - start
        rate = linear(s.learning_rate, 0.0, done)
        error = self.learn(rate)
        self.steps += s.rollout * s.num_envs
        return {"train/error": error**0.5, "train/learning_rate": rate}

    def collect(self, std: np.float32) -> None:
        """Collect a rollout with the student's actions plus noise, and store the teacher's actions as labels."""
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
        """Update the student with random minibatches of the rollout; return the last epoch's squared error."""
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
        """Return copies of the layers from observations to mean actions."""
        layers = layers_of(self.theta, self.sizes)
        return Actor(tuple((weight.T.copy(), bias.copy()) for weight, bias in layers), self.settings.activation)

    def state(self) -> dict[str, NDArray]:
        """Return the state of learner and environments as arrays; see `restore`."""
        native: Any = self.envs.unwrapped
        facts = {
            "steps": self.steps, "updates": self.updates, "rng": self.rng.bit_generator.state,
            "sizes": self.sizes.tolist(), "activation": self.settings.activation, "episodes": self.episodes.names,
        }  # fmt: skip
        state = {"facts": np.array(json.dumps(facts)), "theta": self.theta, "moments": self.moments}
        state |= {f"observed_{name}": rows for name, rows in self.observed.items()} | {"episodes": self.episodes.rows()}
        return state | {f"env/{name}": array for name, array in native.snapshot().items()}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Continue from a state; environments are reset if their number differs.

        Raises:
            ValueError: If the state has another network.
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
    return run_learner(Distiller, job)
