"""Tasks as plain data: terms with their weights, commands, actions, timing and scene options.

A task names functions of rewards.py, observations.py, terminations.py and metrics.py. It works for every robot whose
description has the links and contacts that these functions read. Change a task with `dataclasses.replace` or through
the arguments of `gymnasium.make`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

from ce_gym.dynamics.forces.scene import SceneOptions
from ce_gym.envs.task.checks import action_kinds, command_ranges, list_of_names, magnitudes, ranges, terms, whole_range
from ce_gym.envs.task.terrain_tiles import checked_terrain
from ce_gym.model.options import flag, names, number, option, positive, whole

Range = tuple[float, float]
Terms = tuple[str, ...] | Mapping[str, Mapping[str, Any]]
"""Names of terms, or their parameters by name."""
Actions = Literal["joint_pd", "joint_velocity", "joint_torque", "motor_pd", "motor_torque"]

RESET_NOISE = {"joint_position": 0.1, "joint_velocity": 0.2, "base_velocity": 0.2}
"""Largest deviations from the standing pose at the start, see `Task.reset_noise`."""

STARTS = {
    "height": "of the base above its standing height [m]",
    "lean": "angle of the base to upright, to any side [rad]",
}
"""Quantities that can differ from the standing pose at the start of an episode."""


@dataclass(frozen=True, kw_only=True)
class Task(SceneOptions):
    """Terms, commands, actions and timing of an environment, beside the `SceneOptions` of its physics.

    Attributes:
        rewards: Weight of each reward term, or a mapping of `weight` and parameters, by the name of its function; the
            reward is the weighted sum times the control step.
        observations: Observation blocks, in order: names, or parameters by name. As an argument also "deployable": the
            blocks of the task that a robot can measure, see `deployable`.
        terminations: Conditions that end an episode as a failure, as names or parameters by name; contacts that they
            read need not be in `contacts`.
        metrics: Figures averaged over each episode, as names or parameters by name.
        critic: Observation blocks that only the critic sees, without noise, if `obs_mode` is "dict".
        noise: Largest error of each observation block, uniform, by name, in the unit of the block.
        history: Number of observations that the policy sees, the newest first.
        actions: Meaning of an action, or meanings by pattern of joints such as `{"*": "joint_pd", "*wheel":
            "joint_velocity"}`, of which the last pattern that fits a joint counts. "joint_pd": joint targets, `standing
            pose + action_scale * action` [rad]. "joint_velocity": shares of the largest joint velocities, held by `kd`.
            "motor_pd": targets of rotors, `angle in the standing pose + action_scale * N * action` [rad], where N is
            the gear ratio to the joint that the motor drives most. "joint_torque" and "motor_torque": shares of the
            largest torques of joints and motors.
        action_scale: See `actions`.
        action_joints: Patterns of the joints that actions move, such as "*hip*"; the others hold the standing pose, or
            have no torque. Actions on motors move those in the clusters of these joints.
        latency: Range of the time an action takes to arrive, in sub-steps, drawn for each episode.
        command_range: Lower and upper bound of forward [m/s], sideways [m/s] and yaw rate [rad/s] commands.
        command_curriculum: Share of `command_range` with which every robot begins; good tracking increases the share,
            see `ce_gym.envs.task.curriculum`. 1 for the full range from the start.
        command_period: Time between new commands [s].
        standing_fraction: Share of commands that ask the robot to stand.
        heading: Whether the yaw rate is commanded so that the robot turns to a heading drawn with the command.
        gait_period: Period of the clock of gait terms [s].
        randomise: Ranges of physical parameters that are drawn for each episode, by name, see `RANDOMISED`.
        push_period: Time between pushes [s]; 0 for none.
        push_speed: Largest change of the base's horizontal velocity by a push, each way [m/s].
        n_substeps: Number of sub-steps in a control step.
        episode_length: Number of control steps until an episode is truncated.
        terrain: The ground: its `kind` and the arguments of this kind, see `ce_gym.envs.task.terrain_tiles`.
        only_positive: Whether a negative total reward counts as zero, so that ending an episode early never pays.
        reset_noise: Largest deviation from the standing pose at the start: of joints [rad], joint velocities [rad/s]
            and base velocities [rad/s and m/s].
        start: Ranges of deviations from the standing pose at the start of an episode, by name, see `STARTS`.
    """

    rewards: Mapping[str, float | Mapping[str, Any]]
    observations: Terms = option(terms)
    terminations: Terms = option(terms)
    metrics: Terms = option(terms)
    critic: Terms = option(terms, ())
    noise: Mapping[str, float] = option(magnitudes(), {}, merges=True)
    history: int = option(whole(1, 1000), 1)
    actions: Actions | Mapping[str, Actions] = option(action_kinds(get_args(Actions)), "joint_pd")
    action_scale: float = option(positive(), 0.5)
    action_joints: tuple[str, ...] = option(list_of_names, ("*",))
    latency: tuple[int, int] = option(whole_range, (0, 0))
    command_range: tuple[Range, ...] = option(command_ranges, ((-1.0, 1.0), (-0.5, 0.5), (-1.0, 1.0)))
    command_curriculum: float = option(positive(1), 1.0)
    command_period: float = option(positive(), 5.0)
    standing_fraction: float = option(number(0, 1), 0.1)
    heading: bool = option(flag, False)
    gait_period: float = option(positive(), 0.8)
    randomise: Mapping[str, Range] = option(ranges(), {})
    push_period: float = option(number(0), 0.0)
    push_speed: float = option(number(0), 0.5)
    n_substeps: int = option(whole(1), 4)
    episode_length: int = option(whole(1), 1000)
    terrain: Mapping[str, Any] = option(lambda _, value: checked_terrain(value), {"kind": "flat"})
    contacts: str | tuple[str, ...] = option(names, ("foot", "knee"))
    only_positive: bool = option(flag, True)
    reset_noise: Mapping[str, float] = option(magnitudes(RESET_NOISE), RESET_NOISE, merges=True)
    start: Mapping[str, Range] = option(ranges(STARTS), {})


NOT_MEASURED = ("base_linear_velocity", "base_height", "contact_forces", "parameters")
"""Observation blocks that no sensor of a robot provides."""


def deployable(observations: Terms) -> Terms:
    """Return the observation blocks that a robot can measure, with "gyro" in place of "base_angular_velocity"."""
    names = {name: name for name in observations if name not in NOT_MEASURED}
    names |= {"base_angular_velocity": "gyro"} if "base_angular_velocity" in names else {}
    if isinstance(observations, Mapping):
        return {new: observations[old] for old, new in names.items()}
    return tuple(names.values())


RANDOMISED = {
    "friction": "Coulomb coefficient of the contacts [-]",
    "stiffness": "factor on the contacts' stiffness [-]",
    "kp": "factor on each joint's position gain [-]",
    "kd": "factor on each joint's velocity gain [-]",
    "motor_strength": "factor on motor torques and limits [-]",
    "rotor_inertia": "factor on the spin inertia of rotors [-]",
    "ratio": "factor on the gear ratios [-]",
    "motor_damping": "factor on the viscous friction of each motor, limited ones [-]",
    "motor_friction": "factor on the dry friction of each motor, limited ones [-]",
    "drive_friction": "factor on the additional friction of motors at rest and under load [-]",
    "cogging": "factor on the cogging of motors, limited ones [-]",
    "ambient": "temperature of the air around motors with heat, limited ones [deg C]",
    "battery_voltage": "factor on the voltage of the battery without load, limited motors [-]",
    "battery_resistance": "factor on the resistance of the battery, limited motors [-]",
    "added_mass": "mass added to the base [kg]; added_mass:BODY for another body",
    "com_shift": "shift of the base's centre of mass, each axis [m]; com_shift:BODY for another body",
}
"""Parameters that can be drawn for each episode."""


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

RUN = replace(
    VELOCITY,
    rewards={"forward": 1.0, "survive": 0.5, "ctrl": -0.05, "orientation": -1.0, "action_rate": -0.01},
    observations=tuple(name for name in VELOCITY.observations if name != "velocity_command"),
    metrics=("forward_speed", "sideways_speed"),
    only_positive=False,
)

STAND = replace(
    VELOCITY,
    rewards={"track_linear_velocity": 1.0, "orientation": -2.0, "base_height": -10.0, "pose": -0.2, "torques": -1e-4},
    observations=tuple(name for name in VELOCITY.observations if name != "velocity_command"),
    metrics=("tilt_angle",),
    command_range=((0.0, 0.0),) * 3,
    push_period=2.0,
)

JUMP = replace(
    VELOCITY,
    rewards={"height": 20.0, "flight": 1.0, "orientation": -1.0, "pose": -0.05, "torques": -2e-5, "survive": 0.2},
    observations=(*(name for name in VELOCITY.observations if name != "velocity_command"), "gait_phase"),
    metrics=("highest_base",),
    gait_period=1.0,
)

TASKS: Mapping[str, Task] = MappingProxyType({"velocity": VELOCITY, "run": RUN, "stand": STAND, "jump": JUMP})
