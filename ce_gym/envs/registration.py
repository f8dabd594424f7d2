"""The ids under which environments are found: `ce_gym/<Robot><Task>[-<Level>]-v0`."""

from __future__ import annotations

import gymnasium

from ce_gym.envs.task.tasks import TASKS
from ce_gym.model.mechanism import LEVELS

ROBOTS = ("mini_cheetah", "mit_humanoid", "tello", "jvrc1", "go1", "go2", "berkeley_humanoid")
"""Robots that ship with the package and have what the tasks ask for."""


def camel_case(name: str) -> str:
    """Return `mini_cheetah` as `MiniCheetah`."""
    return "".join(part.capitalize() for part in name.split("_"))


def environment_ids() -> dict[str, dict[str, str]]:
    """Return the arguments that each id stands for. An id without a level is the exact one.

    Examples:
        >>> ce_gym.environment_ids()["ce_gym/TelloVelocity-None-v0"]
        {'robot': 'tello', 'task': 'velocity', 'transmission': 'none'}
    """
    ids = {}
    for robot in ROBOTS:
        for task in TASKS:
            name = camel_case(robot) + camel_case(task)
            for level in (None, *LEVELS):
                suffix = f"-{camel_case(level)}" if level else ""
                arguments = {"robot": robot, "task": task, "transmission": level or "exact"}
                ids[f"ce_gym/{name}{suffix}-v0"] = arguments
    return ids


def register_environments() -> None:
    """Register every id with Gymnasium; harmless if done before."""
    for name, arguments in environment_ids().items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="ce_gym.envs.single:LeggedEnv",
                vector_entry_point="ce_gym.envs.vector:LeggedVectorEnv",
                max_episode_steps=TASKS[arguments["task"]].episode_length,
                kwargs=arguments,
            )
