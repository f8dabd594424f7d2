"""From the arguments of `gymnasium.make` to a batch of environments.

All arguments are JSON-able, so that a spec survives `to_json`. May know programs and batches; no Gymnasium.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, get_args

from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.model import Model
from ce_gym.envs.runtime.batch import Batch
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.task.checks import checked_value, number
from ce_gym.envs.task.tasks import TASKS, Task
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, bad, unknown
from ce_gym.model.mechanism import Level


def make_batch(
    robot: str,
    task: str,
    *,
    num_envs: int,
    dtype: str = "float64",
    num_threads: int | None = None,
    **arguments: Any,
) -> Batch:
    """Build a batch of environments.

    Args:
        robot: Name of a robot that ships with the package, or a path to a robot file.
        task: Name of a task.
        num_envs: Number of environments.
        dtype: "float64" or "float32" for physics.
        num_threads: Threads; the number of usable cores if None.
        **arguments: What `make_program` takes besides.

    Raises:
        ValueError: If an argument is not one of the choices.
        RobotError: If the robot file is not valid.
    """
    checked_dtype(dtype)
    for name, value in (("num_envs", num_envs), ("num_threads", num_threads)):
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
            raise ValueError(f"{name}={value!r}; expected a whole number, at least 1")
    program = make_program(robot, task, **arguments)
    return Batch(program, num_envs, dtype, num_threads or usable_cores())


def checked_dtype(dtype: str) -> str:
    """Return the argument `dtype`.

    Raises:
        ValueError: If it is not one of the choices.
    """
    if dtype not in ("float64", "float32"):
        raise ValueError(f"dtype={dtype!r}; expected 'float64' or 'float32'")
    return dtype


def make_program(
    robot: str,
    task: str,
    *,
    transmission: str = "exact",
    contact_forces: bool = False,
    reward_weights: Mapping[str, float] | None = None,
    **changes: Any,
) -> TaskProgram:
    """Put a task on a robot.

    Args:
        robot: Name of a robot that ships with the package, or a path to a robot file.
        task: Name of a task.
        transmission: "exact", "coupled", "armature" or "none".
        contact_forces: Whether contact forces are computed, for recording.
        reward_weights: Weights that replace or add to those of the task, by the name of the term; 0 removes a term.
        **changes: Attributes of `Task` that replace those of the task, such as command_range, contacts, actions,
            noise, history, latency, randomise, push_period or episode_length.

    Raises:
        ValueError: If an argument is not one of the choices.
        RobotError: If the robot file is not valid.
    """
    if not isinstance(robot, str | os.PathLike):
        raise ValueError(f"robot={robot!r}; expected the name of a robot or a path to a file")
    if not isinstance(contact_forces, bool):
        raise ValueError(f"contact_forces={contact_forces!r}; expected true or false")
    if reward_weights is not None and not isinstance(reward_weights, Mapping):
        raise ValueError(f"reward_weights={reward_weights!r}; expected numbers by the name of a reward term")
    if not isinstance(task, str) or task not in TASKS:
        raise ValueError(f"task={task!r}; expected one of {', '.join(TASKS)}")
    if transmission not in get_args(Level):
        raise ValueError(f"transmission={transmission!r}; expected one of {', '.join(get_args(Level))}")
    model = Model(robot, transmission)
    figures = changed_task(own_task(model.robot, task), reward_weights or {}, changes)
    if figures.actions.endswith("_pd") and not model.robot.gains.kp:
        file, expected = model.robot.source or model.robot.name, f"gains, because actions={figures.actions!r} need them"
        raise bad(file, "gains.kp", None, expected)
    return TaskProgram(model, figures, contact_forces)


def own_task(robot: Robot, task: str) -> Task:
    """Return a task with the figures that a robot's file has for it.

    Raises:
        RobotError: A figure cannot be, or a task in the file does not exist.
    """
    file = robot.source or robot.name
    for name, _ in robot.tasks:
        if name not in TASKS:
            raise unknown(file, "tasks", name, TASKS, "the name of a task")
    own = {key: value for name, group in robot.tasks if name == task for key, value in group}
    wanted, groups = TASKS[task].contacts, {contact.group for contact in robot.contacts}
    if not isinstance(wanted, str):  # tasks ask for knees, too, but not every robot has some
        own.setdefault("contacts", tuple(group for group in wanted if group in groups))
    try:
        return changed_task(TASKS[task], dict(own.pop("reward_weights", ())), own)
    except (ValueError, TypeError) as error:
        raise RobotError(f"{file}: tasks.{task}: {error}") from None


def changed_task(task: Task, reward_weights: Mapping[str, float], changes: Mapping[str, Any]) -> Task:
    """Return a task with some of its figures replaced, checked.

    Args:
        task: A task.
        reward_weights: Weights that replace or add to its own; 0 removes a term.
        changes: Other attributes of `Task`; lists, as JSON has them, count as tuples, and None as no change.

    Raises:
        ValueError: One line that names the argument, its value and what was expected.
    """
    weights = {**task.rewards, **{str(k): number("reward_weights", v) for k, v in reward_weights.items()}}
    given = {"rewards": {name: weight for name, weight in weights.items() if weight != 0}}
    known = [f.name for f in fields(Task) if f.name not in ("rewards",)]
    for name, value in changes.items():
        if name not in known:
            raise ValueError(f"unknown argument {name!r}; expected one of {', '.join(known)}")
        if value is not None:
            given[name] = checked_value(name, value, getattr(task, name))
    return replace(task, **given)
