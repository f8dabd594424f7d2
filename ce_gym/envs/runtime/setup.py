"""From the arguments of `gymnasium.make` to a batch of environments.

All arguments are JSON-able, so that a spec survives `to_json`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.model import Model
from ce_gym.envs.runtime.batch import TaskBatch
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.task.checks import merged_rewards
from ce_gym.envs.task.skills import SKILLS
from ce_gym.envs.task.tasks import TASKS, Task, deployable
from ce_gym.model.arguments import check, check_choice, check_whole
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, listed_names, unknown_name
from ce_gym.model.mechanism import ELASTIC, LEVELS
from ce_gym.model.options import check_fields
from ce_gym.sim.devices import Device, device_named

KNOWN = {**TASKS, **SKILLS}
"""Every task by name."""


def make_batch(
    robot: str,
    task: str,
    *,
    num_envs: int,
    dtype: str = "float64",
    num_threads: int | None = None,
    device: str | Device = "cpu",
    max_episode_steps: float = math.inf,
    **arguments: Any,
) -> TaskBatch:
    """Build a batch of environments.

    Args:
        robot: Name of a robot that ships with the package, or a path to a robot file.
        task: Name of a task.
        num_envs: Number of environments.
        dtype: "float64" or "float32" for physics.
        num_threads: Threads; the number of usable cores if None.
        device: "cpu", or "cuda" or "cuda:N" for a GPU.
        max_episode_steps: Control steps until time is up.
        **arguments: Further arguments of `make_program`.

    Raises:
        ValueError: If there is no such device, or an argument is not one of the choices.
        RobotError: If the robot file is not valid.
    """
    check_choice("dtype", dtype, ("float64", "float32"))
    check_whole("num_envs", num_envs, 1)
    if num_threads is not None:
        check_whole("num_threads", num_threads, 1)
    program, threads = make_program(robot, task, **arguments), num_threads or usable_cores()
    return TaskBatch(program, num_envs, dtype, device_named(device), threads, max_episode_steps)


def make_program(
    robot: str,
    task: str,
    *,
    transmission: str = "exact",
    contact_forces: bool = False,
    rewards: Mapping[str, Any] | None = None,
    **changes: Any,
) -> TaskProgram:
    """Put a task on a robot.

    Args:
        robot: Name of a robot that ships with the package, or a path to a robot file.
        task: Name of a task.
        transmission: "exact", "coupled", "armature", "none" or "elastic".
        contact_forces: Whether contact forces are computed, for recording.
        rewards: Rewards that replace or add to the rewards of the task, by the name of the term: a weight, 0 to remove
            the term, or a mapping of `weight` and parameters, such as `{"weight": 1.5, "width": 0.25}`.
        **changes: New values of fields of the task, such as command_range, contacts, actions, noise, history,
            latency, randomise, push_period or episode_length, see `Task`.

    Raises:
        ValueError: If an argument is not one of the choices.
        RobotError: If the robot file is not valid.
    """
    if not isinstance(robot, str | os.PathLike):
        given = f"the Robot {robot.name!r}" if isinstance(robot, Robot) else repr(robot)
        raise ValueError(f"robot={given}; expected the name of a robot or a path to a file")
    check("contact_forces", contact_forces, isinstance(contact_forces, bool), "true or false")
    check("task", task, task in tuple(KNOWN), f"one of {listed_names(task, KNOWN)}")
    levels = (*LEVELS, ELASTIC)
    check("transmission", transmission, transmission in levels, f"one of {listed_names(transmission, levels)}")
    model = Model(robot, transmission)
    figures = own_task(model.robot, task)
    figures = replace(figures, rewards=merged_rewards(figures.rewards, {} if rewards is None else rewards))
    figures = changed_task(figures, changes)
    check("observations", figures.observations, figures.observations, "at least one name")
    program = TaskProgram(model, figures, contact_forces)
    program.stages  # noqa: B018  (traces the terms, which finds wrong ones)
    return program


def own_task(robot: Robot, task: str) -> Task:
    """Return a task with the changes that a robot's file makes to it.

    Raises:
        RobotError: If a value in the file is not allowed, or a task in the file does not exist.
    """
    file = robot.source or robot.name
    for name, _ in robot.tasks:
        if name not in KNOWN:
            raise unknown_name(file, "tasks", name, KNOWN, "the name of a task")
    own = {key: _thawed(key, value) for name, group in robot.tasks if name == task for key, value in group}
    wanted, groups = KNOWN[task].contacts, {contact.group for contact in robot.contacts}
    if not isinstance(wanted, str):  # tasks ask for knees, too, but not every robot has some
        own.setdefault("contacts", tuple(group for group in wanted if group in groups))
    try:
        weights = merged_rewards(KNOWN[task].rewards, dict(own.pop("rewards", ())))
        return changed_task(replace(KNOWN[task], rewards=weights), own)
    except (ValueError, TypeError) as error:
        raise RobotError(f"{file}: tasks.{task}: {error}") from None


def _thawed(key: str, value: Any) -> Any:
    """Return a value of a robot's file with mappings instead of the pairs that make a robot hashable."""
    if not isinstance(value, tuple) or key == "self_collisions":  # a list of pairs of names
        return value
    if not value or not all(isinstance(x, tuple) and len(x) == 2 and isinstance(x[0], str) for x in value):
        return value
    return {name: _thawed(name, item) for name, item in value}


def changed_task(task: Task, changes: Mapping[str, Any]) -> Task:
    """Return a task with some fields replaced.

    Args:
        task: A task.
        changes: New values by name of the field; lists, as in JSON, count as tuples, and None as no change;
            "deployable" as `observations` for the blocks that a robot can measure.

    Raises:
        UnknownArgument: If a field does not exist.
        ValueError: One line that names the argument, its value and the allowed values.
    """
    check_fields(Task, changes, others=("rewards",))
    given = {name: value for name, value in changes.items() if value is not None}
    if given.get("observations") == "deployable":
        given["observations"] = deployable(task.observations)
    for each in fields(Task):
        if each.metadata.get("merges") and each.name in given:
            given[each.name] = {**getattr(task, each.name), **each.metadata["check"](each.name, given[each.name])}
    return replace(task, **given)
