"""Tasks as plain data: which terms, with which weights, commands, actions and timing.

A task names functions of rewards.py, observations.py, terminations.py and metrics.py; it works for every robot whose
description has what those functions ask for. Change one with `dataclasses.replace` or through the arguments of
`gymnasium.make`. May know nothing but names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal


@dataclass(frozen=True)
class Task:
    """What a robot is asked to do.

    Attributes:
        rewards: Weight of each reward term, by the name of its function; the reward is the weighted sum times the
            control step.
        observations: Observation blocks, in order.
        terminations: Conditions that end an episode as a failure.
        metrics: Figures averaged over each episode.
        command_range: Lower and upper bound of forward [m/s], sideways [m/s] and yaw rate [rad/s] commands.
        command_period: Time between new commands [s].
        standing_fraction: Share of commands that ask the robot to stand.
        action_scale: Joint target = standing pose + action_scale * action [rad].
        dt: Length of a physics sub-step [s].
        n_substeps: Sub-steps in a control step.
        episode_length: Control steps until time is up.
        contacts: Which contact spheres take part: "all", or names of groups or spheres. Spheres that end the episode
            when they touch the ground need not.
        friction: "tangent" or "secant", see `ce_gym.Simulator`.
        only_positive: Whether a negative total reward counts as zero, so that ending an episode early never pays.
    """

    rewards: Mapping[str, float]
    observations: tuple[str, ...]
    terminations: tuple[str, ...]
    metrics: tuple[str, ...]
    command_range: tuple[tuple[float, float], ...] = ((-1.0, 1.0), (-0.5, 0.5), (-1.0, 1.0))
    command_period: float = 5.0
    standing_fraction: float = 0.1
    action_scale: float = 0.5
    dt: float = 0.005
    n_substeps: int = 4
    episode_length: int = 1000
    contacts: str | tuple[str, ...] = ("foot", "knee")
    friction: Literal["tangent", "secant"] = "tangent"
    only_positive: bool = True
    reset_noise: Mapping[str, float] = field(
        default_factory=lambda: MappingProxyType({"joint_position": 0.1, "joint_velocity": 0.2, "base_velocity": 0.2})
    )


VELOCITY = Task(
    rewards={
        "track_linear_velocity": 1.5,
        "track_angular_velocity": 0.75,
        "linear_velocity_z": -1.0,
        "angular_velocity_xy": -0.05,
        "orientation": -2.0,
        "base_height": -10.0,
        "torques": -1e-4,
        "action_rate": -0.01,
        "feet_air_time": 0.3,
        "stand_still": -0.05,
        "pose": -0.05,
        "knee_contact": -1.0,
    },
    observations=(
        "base_linear_velocity",
        "base_angular_velocity",
        "projected_gravity",
        "velocity_command",
        "joint_positions",
        "joint_velocities",
        "last_action",
    ),
    terminations=("torso_contact", "tilt"),
    metrics=("forward_speed_error", "sideways_speed_error", "yaw_rate_error"),
)

TASKS: Mapping[str, Task] = MappingProxyType({"velocity": VELOCITY})
