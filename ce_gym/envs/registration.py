"""Ids of environments: `ce_gym/<Robot><Task>-v0` with exact transmissions, and `ce_gym/<Robot><Task>-Armature-v0`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import gymnasium

from ce_gym.envs.task.skills import SKILLED, SKILLS
from ce_gym.envs.task.tasks import TASKS, Task
from ce_gym.model.errors import invalid_value

QUADRUPEDS = ("mini_cheetah", "go1", "go2", "anymal_c", "spot")
BIPEDS = ("mit_humanoid", "tello", "jvrc1", "g1", "h1", "t1", "berkeley_humanoid", "cassie", "dr_legs")
"""Bipeds of the package. Their files add rewards of a gait to the task "velocity", which double its return."""
ROBOTS = (*QUADRUPEDS, *BIPEDS)
"""Robots of the package that have environments."""
LEVELS_WITH_IDS = {"exact": "", "armature": "-Armature"}
"""Transmission levels with ids, and their part of the id. Other levels are an argument of `gymnasium.make`."""
REWARD_THRESHOLDS = {
    "velocity": 36.0,
    "run": 60.0,
    "stand": 18.0,
    "jump": 50.0,
    "high_jump": 18.0,
    "long_jump": 20.0,
    "land": 5.0,
    "hop": 15.0,
    "recover": 10.0,
    "backflip": 20.0,
}
"""Return of an episode at which a task counts as solved: 70 to 90 % of that of a trained policy, where one exists."""
GAIT_FACTOR = 2.0
"""Threshold of "velocity" with rewards of a gait, over that without."""


def camel_case(name: str) -> str:
    """Return `mini_cheetah` as `MiniCheetah`."""
    return "".join(part.capitalize() for part in name.split("_"))


def environment_ids() -> dict[str, dict[str, str]]:
    """Return the arguments of each id of the package.

    Examples:
        >>> ce_gym.environment_ids()["ce_gym/TelloVelocity-Armature-v0"]
        {'robot': 'tello', 'task': 'velocity', 'transmission': 'armature'}
    """
    ids = {}
    for robot in ROBOTS:
        ids |= ids_of(f"ce_gym/{camel_case(robot)}", robot, tasks_of(robot))
    return ids


def tasks_of(robot: str) -> tuple[str, ...]:
    """Return the tasks for which a robot of the package has ids."""
    return (*TASKS, *(skill for skill, robots in SKILLED.items() if robot in robots))


def ids_of(stem: str, robot: str, tasks: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the arguments of every id of a robot.

    Args:
        stem: Start of the ids.
        robot: A name or a path.
        tasks: Names of tasks.
    """
    return {
        f"{stem}{camel_case(task)}{suffix}-v0": {"robot": robot, "task": task, "transmission": level}
        for task in tasks
        for level, suffix in LEVELS_WITH_IDS.items()
    }


def register_environments() -> None:
    """Register every id of the package. Repeated calls have no effect."""
    tasks = {**TASKS, **SKILLS}
    for name, arguments in environment_ids().items():
        robot, task = arguments["robot"], arguments["task"]
        register(name, arguments, tasks[task], reward_threshold(task, robot in BIPEDS))


def reward_threshold(task: str, has_gait: bool) -> float:
    """Return the return of an episode at which a task of the package counts as solved."""
    return REWARD_THRESHOLDS[task] * (GAIT_FACTOR if has_gait and task == "velocity" else 1.0)


def register(name: str, arguments: Mapping[str, str], task: Task, threshold: float | None) -> None:
    """Register an id with Gymnasium. Repeated calls have no effect.

    Args:
        name: The id.
        arguments: Arguments of the environment.
        task: The task, for its time limit.
        threshold: Return of an episode at which the task counts as solved.

    Raises:
        RobotError: The id is registered with other arguments.
    """
    if name in gymnasium.registry:
        if dict(gymnasium.registry[name].kwargs) != arguments:
            expected = "an id that no other robot has; give it a `name`"
            raise invalid_value(arguments["robot"], "environment id", name, expected)
        return
    gymnasium.register(
        name,
        entry_point="ce_gym.envs.single:LeggedEnv",
        vector_entry_point="ce_gym.envs.vector:LeggedVectorEnv",
        reward_threshold=threshold,
        max_episode_steps=task.episode_length,
        kwargs=dict(arguments),
    )
