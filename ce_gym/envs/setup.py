"""From the arguments of `gymnasium.make` to a batch of environments.

All arguments are JSON-able, so that a spec survives `to_json`. May know programs and batches; no Gymnasium.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, get_args

from ce_gym.dynamics.model import Model
from ce_gym.envs.batch import Batch
from ce_gym.envs.program import TaskProgram
from ce_gym.envs.tasks import TASKS, Task
from ce_gym.model.mechanism import Level


def make_batch(
    robot: str,
    task: str,
    *,
    num_envs: int,
    transmission: str = "exact",
    reward_weights: Mapping[str, float] | None = None,
    command_range: Sequence[Sequence[float]] | None = None,
    command_period: float | None = None,
    contacts: str | Sequence[str] | None = None,
    contact_forces: bool = False,
    dtype: str = "float64",
    num_threads: int | None = None,
) -> Batch:
    """Build a batch of environments.

    Args:
        robot: Name of a robot that ships with the package, or a path to a robot file.
        task: Name of a task.
        num_envs: Number of environments.
        transmission: "exact", "coupled", "armature" or "none".
        reward_weights: Weights that replace or add to those of the task, by the name of the term; 0 removes a term.
        command_range: Bounds of forward [m/s], sideways [m/s] and yaw rate [rad/s] commands, three pairs.
        command_period: Time between new commands [s].
        contacts: Which contact spheres take part: "all", or names of groups or spheres.
        contact_forces: Whether contact forces are computed, for recording.
        dtype: "float64" or "float32" for physics.
        num_threads: Threads; the number of usable cores if None.

    Raises:
        ValueError: If an argument is not one of the choices.
        RobotError: If the robot file is not valid.
    """
    if task not in TASKS:
        raise ValueError(f"task={task!r}; expected one of {', '.join(TASKS)}")
    if transmission not in get_args(Level):
        raise ValueError(f"transmission={transmission!r}; expected one of {', '.join(get_args(Level))}")
    if dtype not in ("float64", "float32"):
        raise ValueError(f"dtype={dtype!r}; expected 'float64' or 'float32'")
    for name, value in (("num_envs", num_envs), ("num_threads", num_threads)):
        if value is not None and (not isinstance(value, int) or value < 1):
            raise ValueError(f"{name}={value!r}; expected a whole number, at least 1")
    chosen = changed_task(
        TASKS[task],
        reward_weights=reward_weights,
        command_range=command_range,
        command_period=command_period,
        contacts=contacts,
    )
    program = TaskProgram(Model(robot, transmission), chosen, contact_forces)
    return Batch(program, num_envs, dtype, num_threads or len(os.sched_getaffinity(0)))


def changed_task(
    task: Task,
    *,
    reward_weights: Mapping[str, float] | None,
    command_range: Sequence[Sequence[float]] | None,
    command_period: float | None,
    contacts: str | Sequence[str] | None,
) -> Task:
    """Return a task with some of its figures replaced; None keeps what it has."""
    changes: dict[str, Any] = {}
    if reward_weights is not None:
        weights = {**task.rewards, **{str(k): float(v) for k, v in reward_weights.items()}}
        changes["rewards"] = {name: weight for name, weight in weights.items() if weight != 0}
    if command_range is not None:
        pairs = tuple(tuple(float(x) for x in pair) for pair in command_range)
        if len(pairs) != 3 or any(len(pair) != 2 or not pair[0] <= pair[1] for pair in pairs):
            raise ValueError(f"command_range={command_range!r}; expected three pairs (low, high) with low <= high")
        changes["command_range"] = pairs
    if command_period is not None:
        if not command_period > 0:
            raise ValueError(f"command_period={command_period!r}; expected a positive time in s")
        changes["command_period"] = float(command_period)
    if contacts is not None:
        changes["contacts"] = contacts if isinstance(contacts, str) else tuple(contacts)
    return replace(task, **changes)
