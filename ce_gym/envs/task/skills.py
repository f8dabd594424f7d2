"""Skills as tasks: jumps, a landing, hopping on one leg, getting up, a backflip.

Every robot can have every skill. The robots in `SKILLED` have ids, and their files adapt the tasks. Motors are limited.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from ce_gym.envs.task.tasks import VELOCITY, Task

SEEN = (*(name for name in VELOCITY.observations if name != "velocity_command"), "gait_phase")
"""Observations of the skills. The gait clock has the period of an episode and so tells the time."""

HIGH_JUMP = replace(
    VELOCITY,
    rewards={
        "new_height": 20.0,
        "standing": {"weight": 10.0, "begin": 1.2},  # with weight 2 Mini Cheetah ends in a crouch
        "survive": 0.5,
        "orientation": -2.0,
        "swerve": -0.1,
        "pose": -0.02,
        "action_rate": -0.01,
        "torques": -1e-5,
        "knee_contact": -0.5,
    },
    observations=SEEN,
    metrics=("apex", "stands"),
    action_scale=1.2,
    command_range=((0.0, 0.0),) * 3,
    gait_period=2.5,
    episode_length=125,
    motors="limited",
    only_positive=False,
)

LONG_JUMP = replace(
    HIGH_JUMP,
    rewards={
        **HIGH_JUMP.rewards,
        "new_height": {"weight": 4.0, "most": 0.3},
        "new_distance": 12.0,
        "standing": {"weight": 10.0, "begin": 1.0},
    },
    metrics=("longest_flight", "apex", "stands"),
)

LAND = replace(
    HIGH_JUMP,
    rewards={
        "standing": {"weight": 2.0, "begin": 0.8},
        "survive": 1.0,
        "orientation": -2.0,
        "swerve": -0.1,
        "pose": -0.05,
        "action_rate": -0.01,
        "torques": -1e-5,
        "knee_contact": -1.0,
    },
    metrics=("stands",),
    start={"height": (1.0, 1.0), "lean": (0.0, 0.1)},
)

HOP = replace(
    HIGH_JUMP,
    rewards={
        "survive": 1.0,
        "hop": 1.0,
        "flight": 0.5,
        "orientation": -2.0,
        "swerve": -0.2,
        "angular_velocity_xy": -0.05,
        "action_rate": -0.01,
        "torques": -1e-5,
    },
    terminations=("torso_contact", "tilt", "fallen", "other_foot"),
    metrics=("flights", "distance"),
    gait_period=0.5,
    episode_length=500,
)

RECOVER = replace(
    HIGH_JUMP,
    rewards={
        "upright": 1.0,
        "standing": {"weight": 3.0, "width": 0.02},
        "pose": -0.02,
        "action_rate": -0.01,
        "torques": -2e-5,
    },
    observations=SEEN[:-1],
    terminations=(),
    metrics=("stands", "stood_after"),
    contacts="all",
    episode_length=200,
    start={"height": (0.1, 0.3), "lean": (0.0, 3.1416)},
    reset_noise={"joint_position": 0.8, "joint_velocity": 1.0, "base_velocity": 1.0},
)

BACKFLIP = replace(
    HIGH_JUMP,
    rewards={
        "new_turn": 2.0,
        "new_height": {"weight": 10.0, "most": 0.4},
        "standing_again": 8.0,
        "roll": -5.0,
        "swerve": -0.1,
        "pose": -0.02,
        "action_rate": -0.01,
        "torques": -1e-5,
        "knee_contact": -0.5,
    },
    terminations=("torso_contact", "turned_too_far"),
    metrics=("turn", "apex", "stands", "flipped"),
)

SKILLS: Mapping[str, Task] = MappingProxyType(
    {
        "high_jump": HIGH_JUMP,
        "long_jump": LONG_JUMP,
        "land": LAND,
        "hop": HOP,
        "recover": RECOVER,
        "backflip": BACKFLIP,
    }
)

SKILLED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "high_jump": ("mini_cheetah", "go2", "mit_humanoid", "tello"),
        "long_jump": ("mini_cheetah", "go2", "mit_humanoid"),
        "land": ("mini_cheetah", "go2", "mit_humanoid", "tello"),
        "hop": ("mit_humanoid",),
        "recover": ("mini_cheetah",),
        "backflip": ("mini_cheetah",),
    }
)
"""Robots with ids of a skill."""
