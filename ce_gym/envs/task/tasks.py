"""Tasks as plain data: which terms, with which weights, commands, actions and timing.

A task names functions of rewards.py, observations.py, terminations.py and metrics.py; it works for every robot whose
description has what those functions ask for. Change one with `dataclasses.replace` or through the arguments of
`gymnasium.make`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

Range = tuple[float, float]
Terms = tuple[str, ...] | Mapping[str, Mapping[str, Any]]
"""Names of terms, or their parameters by name."""
Actions = Literal["joint_pd", "joint_torque", "motor_pd", "motor_torque"]


@dataclass(frozen=True)
class Task:
    """What a robot is asked to do.

    Attributes:
        rewards: Weight of each reward term, or a mapping of `weight` and parameters, by the name of its function; the
            reward is the weighted sum times the control step.
        observations: Observation blocks, in order: names, or parameters by name. So are the following three.
        terminations: Conditions that end an episode as a failure.
        metrics: Figures averaged over each episode.
        critic: Blocks that the critic sees besides the policy's, without noise, if observations come as a dictionary.
        noise: Largest error of observation blocks, uniform, by name, in their own units.
        history: How many observations the policy sees, the newest first.
        actions: What an action means: "joint_pd", joint targets `standing pose + action_scale * action` [rad];
            "motor_pd", targets of the motors' rotors, `angle in the standing pose + action_scale * N * action`, with N
            how far a motor turns for each radian of the joint that it drives most; "joint_torque" and "motor_torque",
            shares of the joints' and the motors' largest torques.
        action_scale: See `actions`.
        action_joints: Patterns of the joints that actions move, such as "*hip*"; the others hold the standing pose, or
            have no torque. Actions on motors move those in the clusters of these joints.
        latency: Range of the time an action takes to arrive, in sub-steps, drawn for each episode.
        command_range: Lower and upper bound of forward [m/s], sideways [m/s] and yaw rate [rad/s] commands.
        command_curriculum: Share of `command_range` with which every robot begins; it grows with tracking, see
            `ce_gym.envs.task.curriculum`. 1 for all of the range from the start.
        command_period: Time between new commands [s].
        standing_fraction: Share of commands that ask the robot to stand.
        heading: Whether the yaw rate is commanded so that the robot turns to a heading drawn with the command.
        gait_period: Time of one cycle of the clock that gait terms go by [s].
        randomise: Range of physical figures that are drawn for each episode, by name; see `RANDOMISED`.
        push_period: Time between pushes [s]; 0 for none.
        push_speed: Largest change of the base's horizontal velocity by a push, each way [m/s].
        dt: Length of a physics sub-step [s].
        n_substeps: Sub-steps in a control step.
        episode_length: Control steps until time is up.
        terrain: The ground, by its `kind` and the arguments of that, see `ce_gym.envs.task.terrain_tiles`.
        contacts: Which contact spheres take part: "all", or names of groups or spheres. Spheres that end the episode
            when they touch the ground need not.
        seldom: Those of them that are computed only where they are near, see `ce_gym.Simulator`.
        self_collisions: Which links push each other apart: "listed", "all" or pairs, see `ce_gym.Simulator`.
        friction: "tangent" or "secant", see `ce_gym.Simulator`.
        motors: "ideal" or "limited", see `ce_gym.Simulator`.
        control_period: Of the motors' controllers [s], a multiple of `dt`; 0 for none, see `ce_gym.Simulator`.
        method: How sub-steps are made, "euler" or another, see `ce_gym.Simulator`.
        tolerance: Of method "adaptive" [rad or m]; every robot then makes steps of its own within each sub-step.
        only_positive: Whether a negative total reward counts as zero, so that ending an episode early never pays.
        reset_noise: Largest deviation from the standing pose at the start: of joints [rad], joint velocities [rad/s]
            and base velocities [rad/s and m/s].
        start: Range of how an episode begins instead of in the standing pose, by name; see `STARTS`.
    """

    rewards: Mapping[str, float | Mapping[str, Any]]
    observations: Terms
    terminations: Terms
    metrics: Terms
    critic: Terms = ()
    noise: Mapping[str, float] = field(default_factory=dict)
    history: int = 1
    actions: Actions = "joint_pd"
    action_scale: float = 0.5
    action_joints: tuple[str, ...] = ("*",)
    latency: tuple[int, int] = (0, 0)
    command_range: tuple[Range, ...] = ((-1.0, 1.0), (-0.5, 0.5), (-1.0, 1.0))
    command_curriculum: float = 1.0
    command_period: float = 5.0
    standing_fraction: float = 0.1
    heading: bool = False
    gait_period: float = 0.8
    randomise: Mapping[str, Range] = field(default_factory=dict)
    push_period: float = 0.0
    push_speed: float = 0.5
    dt: float = 0.005
    n_substeps: int = 4
    episode_length: int = 1000
    terrain: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({"kind": "flat"}))
    contacts: str | tuple[str, ...] = ("foot", "knee")
    seldom: str | tuple[str, ...] = ()
    self_collisions: str | tuple[tuple[str, ...], ...] = ()
    friction: Literal["tangent", "secant"] = "tangent"
    motors: Literal["ideal", "limited"] = "ideal"
    control_period: float = 0.0
    method: str = "euler"
    tolerance: float | None = None
    only_positive: bool = True
    reset_noise: Mapping[str, float] = field(
        default_factory=lambda: MappingProxyType({"joint_position": 0.1, "joint_velocity": 0.2, "base_velocity": 0.2})
    )
    start: Mapping[str, Range] = field(default_factory=dict)


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
    "drive_friction": "factor on what that is more at rest and under load [-]",
    "cogging": "factor on the cogging of motors, limited ones [-]",
    "ambient": "temperature of the air around motors that grow warm, limited ones [deg C]",
    "battery_voltage": "factor on the voltage of the battery without load, limited motors [-]",
    "battery_resistance": "factor on its resistance, likewise [-]",
    "added_mass": "mass added to the base [kg]; added_mass:BODY for another body",
    "com_shift": "shift of the base's centre of mass, each axis [m]; com_shift:BODY for another body",
}
"""What can be drawn for each episode."""

STARTS = {
    "height": "of the base above its standing height [m]",
    "lean": "angle of the base to upright, to any side [rad]",
}
"""What can be said of how episodes begin."""


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
