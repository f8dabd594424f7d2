"""Ids of environments: `ce_gym/<Robot><Task>[-<Level>]-v0`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import gymnasium

from ce_gym.envs.task.skills import SKILLED, SKILLS
from ce_gym.envs.task.tasks import TASKS
from ce_gym.model.errors import invalid_value
from ce_gym.model.mechanism import ELASTIC, LEVELS

ROBOTS = (
    *("mini_cheetah", "mit_humanoid", "tello", "jvrc1"),
    *("go1", "go2", "anymal_c", "spot", "g1", "h1", "t1", "berkeley_humanoid", "cassie", "dr_legs"),
)
"""Robots of the package that have environments."""
STRETCHING = ("mini_cheetah",)
"""Robots with elastic transmissions in their files, which also have the level "elastic"."""


def camel_case(name: str) -> str:
    """Return `mini_cheetah` as `MiniCheetah`."""
    return "".join(part.capitalize() for part in name.split("_"))


def environment_ids() -> dict[str, dict[str, str]]:
    """Return the arguments of each id. An id without a level has the exact level.

    Examples:
        >>> ce_gym.environment_ids()["ce_gym/TelloVelocity-None-v0"]
        {'robot': 'tello', 'task': 'velocity', 'transmission': 'none'}
    """
    ids = {}
    for robot in ROBOTS:
        ids |= ids_of(f"ce_gym/{camel_case(robot)}", robot, robot in STRETCHING, tasks_of(robot))
    return ids


def tasks_of(robot: str) -> tuple[str, ...]:
    """Return the tasks for which a robot of the package has ids."""
    return (*TASKS, *(skill for skill, robots in SKILLED.items() if robot in robots))


def ids_of(stem: str, robot: str, stretches: bool, tasks: Iterable[str] = tuple(TASKS)) -> dict[str, dict[str, str]]:
    """Return the arguments of every id of a robot: `<stem><Task>[-<Level>]-v0`.

    Args:
        stem: Start of the ids.
        robot: A name or a path.
        stretches: Whether the robot has elastic transmissions.
        tasks: Names of tasks.
    """
    levels = (None, *LEVELS, ELASTIC) if stretches else (None, *LEVELS)
    ids = {}
    for task in tasks:
        for level in levels:
            name = f"{stem}{camel_case(task)}{f'-{camel_case(level)}' if level else ''}-v0"
            ids[name] = {"robot": robot, "task": task, "transmission": level or "exact"}
    return ids


def register_environments() -> None:
    """Register every id of the package. Repeated calls have no effect."""
    register(environment_ids())


def register(ids: Mapping[str, Mapping[str, str]]) -> None:
    """Register ids with Gymnasium. Repeated calls have no effect.

    Raises:
        RobotError: An id is registered with other arguments.
    """
    for name, arguments in ids.items():
        if name in gymnasium.registry:
            if dict(gymnasium.registry[name].kwargs) != arguments:
                expected = "an id that no other robot has; give it a `name`"
                raise invalid_value(arguments["robot"], "environment id", name, expected)
            continue
        gymnasium.register(
            name,
            entry_point="ce_gym.envs.single:LeggedEnv",
            vector_entry_point="ce_gym.envs.vector:LeggedVectorEnv",
            max_episode_steps={**TASKS, **SKILLS}[arguments["task"]].episode_length,
            kwargs=dict(arguments),
        )
