"""Registration of environments for a robot file of the user.

    ids = ce_gym.register_robot("my_robot.yaml")
    env = gymnasium.make("ce_gym/MyRobotVelocity-Armature-v0")

The registry belongs to one process: a worker process that is not a fork must call `register_robot` again, or be given
the `EnvSpec` in place of the id.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from ce_gym.envs.registration import ids_of, register, reward_threshold
from ce_gym.envs.runtime.setup import own_task
from ce_gym.envs.task.tasks import TASKS
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, invalid_value
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
        RobotError: The file is not valid, the robot does not fit the tasks, or another robot has the ids.

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
    tasks = {task: own_task(robot, task) for task in TASKS}
    ids = ids_of(id_stem(robot, name), str(file), tasks)
    for env_id, arguments in ids.items():
        task = arguments["task"]
        register(env_id, arguments, tasks[task], reward_threshold(task, "gait" in tasks[task].rewards))
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
