"""Train a student, whose observations a real robot can measure, to imitate a teacher with more observations.

DAgger (Ross et al. 2011, arXiv:1011.0686) without memory: the student acts, the teacher labels each state with its own
action, and least squares fit the student to the labels. The environment belongs to the student. The teacher uses
observation blocks of the critic, which have no noise, delay or history. Settings files are in train/config/distill.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from ce_gym.learn.learners.learner import Learner, space_sizes
from ce_gym.learn.networks.perceptron import squared_error_gradient
from ce_gym.learn.networks.updates import adam
from ce_gym.learn.runs.job import Job, Trained
from ce_gym.learn.runs.loop import run_learner
from ce_gym.learn.runs.progress import geometric, linear
from ce_gym.learn.runs.settings import CONFIG_FOLDER, CommonSettings
from ce_gym.model.arguments import check
from ce_gym.model.options import option
from ce_gym.policies import Policy, PolicyError, load_policy, locate_policy, warn_of_other_robot

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


class Distiller(Learner):
    """Learner of a student that imitates a teacher.

    Args:
        envs: A vector environment of ce_gym in SAME_STEP autoreset mode, with the teacher's blocks in the critic.
        job: The training run.

    Raises:
        PolicyError: If the teacher cannot be read, or its observations or actions do not fit the environment.
    """

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        s, (size, _, n_actions) = job.settings, space_sizes(envs)
        if not isinstance(envs.single_observation_space, gymnasium.spaces.Dict):
            raise PolicyError(f"{job.env_id}: obs_mode: expected dict, for the observation of the teacher")
        self.teacher = load_policy(s.teacher)
        warn_of_other_robot(self.teacher.record, envs.unwrapped.model.robot.name)  # type: ignore[attr-defined]
        kwargs = {**job.env_kwargs, **s.training}
        self.columns = teacher_columns(self.teacher, s.teacher, envs.unwrapped, kwargs)
        taught = self.teacher.record["action_size"]
        if taught != n_actions:
            raise PolicyError(f"{s.teacher}: has {taught} actions; expected {n_actions}, as the student")
        super().__init__(envs, job, [size, *s.hidden, n_actions])
        self.seen, self.labels = (np.zeros((*self.dones.shape, n), F) for n in (size, n_actions))

    def collect(self, done: float) -> None:
        """Collect a rollout with the student's actions plus noise, and store the teacher's actions as labels."""
        s = self.settings
        std = F(geometric(s.initial_std, s.final_std, done))
        for t in range(s.rollout):
            self.seen[t], known = self.observed
            self.labels[t] = self.teacher.predict(known[:, self.columns])[0]
            actions = self.run(self.policy, self.seen[t])
            noise = self.rng.standard_normal(actions.shape, F)
            self.step(self.envs, t, np.clip(actions + std * noise, F(-1), F(1)))

    def learn(self, done: float) -> dict[str, float]:
        """Fit the student to the teacher's actions; return statistics for the log."""
        s, rate, errors = self.settings, linear(self.settings.learning_rate, 0.0, done), []
        seen, labels = (x.reshape(self.dones.size, -1) for x in (self.seen, self.labels))
        for minibatches in self.epochs():
            errors = []
            for rows in minibatches:
                gradient, weight = np.zeros_like(self.theta), F(1 / (len(rows) * labels.shape[1]))
                error = squared_error_gradient(self.policy, seen, labels, rows, weight, gradient, self.work[0])
                errors.append(weight * error)
                self.updates += 1
                adam(self.theta, gradient, self.moments, self.updates, rate, s.max_grad_norm)
        return {"train/error": float(np.mean(errors)) ** 0.5, "train/learning_rate": rate}


def train(job: Job) -> Trained:
    """Train, and save the student even if Ctrl-C ends training early; see `run_learner`.

    Raises:
        PolicyError: If there is no such teacher, or the student cannot be trained with it.
    """
    if job.settings.teacher == "none":
        raise PolicyError("teacher: missing; expected --set teacher=POLICY")
    locate_policy(job.settings.teacher)
    return run_learner(Distiller, job)
