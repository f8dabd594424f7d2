"""Registration of robots and tasks of the user.

    ids = ce_gym.register_robot("my_robot.yaml")
    env = gymnasium.make("ce_gym/MyRobotVelocity-Armature-v0")

The registry belongs to one process. Worker processes that are not forks also register robots and tasks of installed
packages, see `ce_gym.plugins`. Otherwise give them `module:id` or the `EnvSpec` in place of the id.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ce_gym.envs.registration import ids_of, register, reward_threshold
from ce_gym.envs.runtime.setup import KNOWN, changed_task, own_task
from ce_gym.envs.task.checks import merged_rewards
from ce_gym.envs.task.tasks import TASKS
from ce_gym.model.arguments import check
from ce_gym.model.assets import OTHERS
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, invalid_value, listed_names
from ce_gym.model.load import load_robot


def register_robot(path: str | os.PathLike[str], name: str | None = None) -> tuple[str, ...]:
    """Register every task of the package for a robot. Repeated calls have no effect.

    Args:
        path: A robot file that `load_robot` reads: .yaml, .urdf (a plain URDF needs its YAML file for contacts and
            gains) or .xml.
        name: Start of the ids; by default the name of the robot, `my_robot` as `MyRobot`.

    Returns:
        The ids: `ce_gym/<Name><Task>-v0` and `ce_gym/<Name><Task>-Armature-v0`.

    Raises:
        RobotError: The file is not valid, the robot does not fit the tasks, or another robot has the name or the ids.

    Examples:
        >>> ids = ce_gym.register_robot(ce_gym.load_robot("tello").source, name="my_robot")
        >>> print(ids[0], ids[1])
        ce_gym/MyRobotVelocity-v0 ce_gym/MyRobotVelocity-Armature-v0
    """
    if not isinstance(path, str | os.PathLike):
        value = repr(path.name) if isinstance(path, Robot) else repr(path)
        expected = "the path of a file, which worker processes can read, too"
        raise invalid_value("register_robot", "path", f"{type(path).__name__} {value}", expected)
    file = Path(path).resolve()
    robot = load_robot(file)
    if problems := missing(robot):
        raise problems[0]
    of_package = replace(robot, tasks=tuple(task for task in robot.tasks if task[0] in KNOWN))  # others may follow
    tasks = {task: own_task(of_package, task) for task in TASKS}
    ids = ids_of(id_stem(robot, name), str(file), tasks)
    for env_id, arguments in ids.items():
        task = arguments["task"]
        register(env_id, arguments, tasks[task], reward_threshold(task, "gait" in tasks[task].rewards))
    OTHERS[name or robot.name] = file
    return tuple(ids)


def register_task(
    name: str,
    base: str = "velocity",
    *,
    robots: Iterable[str],
    reward_threshold: float | None = None,
    rewards: Mapping[str, Any] | None = None,
    **changes: Any,
) -> tuple[str, ...]:
    """Register a task for some robots. Repeated calls have no effect.

    Args:
        name: Name of the task, `my_task` for the ids `ce_gym/<Robot>MyTask-v0` and `ce_gym/<Robot>MyTask-Armature-v0`.
        base: Name of the task to start from.
        robots: Names of robots of the package or of `register_robot`.
        reward_threshold: Return of an episode at which the task counts as solved.
        rewards: Rewards that replace or add to those of the base, as in `gymnasium.make`.
        **changes: New values of other fields of the task.

    Returns:
        The ids.

    Raises:
        ValueError: The name is not valid or belongs to another task, or an argument is not valid.
        RobotError: A robot does not exist or does not fit the task.

    Examples:
        >>> ce_gym.register_task("slow_walk", robots=["go1"], command_range=[[0, 0.3], [0, 0], [0, 0]])
        ('ce_gym/Go1SlowWalk-v0', 'ce_gym/Go1SlowWalk-Armature-v0')
    """
    check("name", name, re.fullmatch(r"[a-z][a-z0-9_]*", name), "lower-case letters, digits and underscores")
    check("base", base, base in KNOWN, f"one of {listed_names(base, KNOWN)}")
    weights = merged_rewards(KNOWN[base].rewards, {} if rewards is None else rewards)
    task = changed_task(replace(KNOWN[base], rewards=weights), changes)
    if KNOWN.get(name, task) != task:
        raise ValueError(f"name={name!r}; expected a name that no other task has")
    loaded = {robot: load_robot(robot) for robot in robots}
    KNOWN[name] = task
    ids = []
    for robot, description in loaded.items():
        path = str(OTHERS.get(robot, robot))
        for env_id, arguments in ids_of(id_stem(description, robot), path, [name]).items():
            register(env_id, arguments, own_task(description, name), reward_threshold)
            ids.append(env_id)
    return tuple(ids)


def missing(robot: Robot) -> list[RobotError]:
    """Return an error for each property that the tasks need and the robot lacks; one line each."""
    file = robot.source or robot.name
    problems = []
    if not robot.floating:
        problems.append(invalid_value(file, "base", "fixed", "a floating base, because tasks are about walking"))
    if not any(contact.group == "foot" for contact in robot.contacts):
        expected = "at least one contact sphere in this group"
        problems.append(invalid_value(file, "contacts of group 'foot'", None, expected))
    if not robot.independent:
        problems.append(invalid_value(file, "independent", (), "at least one joint"))
    if not robot.pose.height > 0.0:
        expected = "the height of the standing base above 0 [m]"
        problems.append(invalid_value(file, "pose.height", robot.pose.height, expected))
    return problems


def zero_limits(robot: Robot) -> list[str]:
    """Return a line for each kind of joint limit that is 0 in the robot file, the default of CAD programs."""
    joints = [robot.body(name) for name in robot.commanded]
    weak = [body.name for body in joints if body.joint.torque == 0.0 and not body.joint.stiffness]
    slow = [body.name for body in joints if body.joint.velocity == 0.0]
    advice = "nothing drives them; if motors do, write their largest torque into <limit effort>"
    lines = [f"no torque: the effort is 0, or there is no actuator, for {_listed(weak)}; {advice}"]
    lines += [f"no speed: the velocity is 0 for {_listed(slow)}; speed limits of joints are not simulated"]
    return [line for line, names in zip(lines, (weak, slow), strict=True) if names]


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more joints" if len(names) > 3 else "")


def id_stem(robot: Robot, name: str | None = None) -> str:
    """Return the start of the ids of a robot, such as "ce_gym/MyRobot".

    Raises:
        RobotError: The name has no letters or digits.
    """
    stem = "".join(word[:1].upper() + word[1:] for word in re.split(r"[\W_]+", name or robot.name))
    if not stem:
        raise invalid_value(robot.source, "name", name or robot.name, "a name with letters or digits in it")
    return f"ce_gym/{stem}"
