"""Torque limits, gains and task settings from a robot's weight, height, mass matrix and load in its standing pose.

With the weight W and the height h of the centre of mass above the feet, a torque is compared with W h. By Froude's
similarity, speeds grow with sqrt(g h) and times with sqrt(h / g), while angles stay the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ce_gym.dynamics.standing_load import Load, placeholders
from ce_gym.model.description import Robot

LIKELY_TORQUE = 0.75
"""Torque limit in place of a placeholder, over weight times height of the centre of mass [-]."""
STIFFNESS = 3.0
"""Sum of the position gains of one joint of all legs, over weight times height of the centre of mass [1/rad]."""
SAG = 0.15
"""Largest sag of a joint under its load in the standing pose [rad]."""
FREQUENCY = 3.0
"""Natural frequency of a joint on its position gain, at least [Hz]."""
DAMPING_RATIO = 0.7
LEAST_DAMPING_TIME = 0.02
"""Velocity gain over position gain, at least [s]."""
SATURATION = 0.1
"""Position error at which a joint may reach its torque limit, at least [rad or m]."""
REFERENCE_HEIGHT = 0.29
"""Height of the centre of mass of the quadruped whose rewards are the defaults of tasks [m]."""
REFERENCE_TORQUE = 26.0
"""Its weight times that height [N m]."""
SPEEDS = {True: ((-0.15, 0.25), (-0.1, 0.1)), False: ((-0.55, 0.55), (-0.25, 0.25))}
"""Commanded forward and sideways speeds over sqrt(g h), of bipeds and of others [-]."""
YAW_RATES = {True: 0.2, False: 0.18}
"""Largest commanded yaw rate over sqrt(g / h) [-]."""
FASTEST_TURN = {True: 0.7, False: 1.5}
"""Largest commanded yaw rate of bipeds and of others [rad/s]: servos of small robots limit it."""
PERIODS = {True: 2.6, False: 4.0}
"""Gait period over sqrt(h / g) [-]."""
SHORTEST_PERIOD = 0.5
"""Smallest gait period [s]: servos of small robots are slow."""
CLEARANCE = 0.1
"""Height of swinging feet over the height of the centre of mass [-]."""


def likely_torque(load: Load) -> float:
    """Return a torque limit in place of a placeholder [N m]."""
    return rounded(LIKELY_TORQUE * load.toppling)


def likely_gains(robot: Robot, load: Load, leg_joints: Sequence[str], n_feet: int) -> dict[str, tuple[float, float]]:
    """Return position and velocity gains by driven joint [N m/rad, N m s/rad]."""
    gains = {}
    unknown = set(placeholders(robot, load))
    for name in robot.driven:
        inertia = load.inertias[name]
        kp = max((2 * np.pi * FREQUENCY) ** 2 * inertia, abs(load.torques[name]) / SAG)
        if name in leg_joints:
            kp = max(kp, STIFFNESS * load.toppling / n_feet)
        limit = robot.body(name).joint.torque
        torque = likely_torque(load) if name in unknown or limit == 0.0 else limit
        kp = min(kp, torque / SATURATION)
        kd = max(2 * DAMPING_RATIO * np.sqrt(kp * inertia), LEAST_DAMPING_TIME * kp)
        gains[name] = rounded(kp), rounded(float(kd))
    return gains


def velocity_settings(robot: Robot, load: Load, leg_joints: Sequence[str], biped: bool) -> dict[str, Any]:
    """Return arguments of the velocity task that fit the robot's size.

    A robot with two feet takes its steps by a clock, as the humanoids of this package do.
    """
    g, h = float(np.linalg.norm(robot.gravity)), load.height
    speed, scale = np.sqrt(g * h), np.sqrt(h / REFERENCE_HEIGHT)
    forward, sideways = ([rounded(float(x * speed)) for x in bounds] for bounds in SPEEDS[biped])
    yaw = min(FASTEST_TURN[biped], rounded(float(YAW_RATES[biped] * np.sqrt(g / h))))
    largest = max(abs(x) for x in (*forward, *sideways))
    torques = rounded(-1e-4 * (REFERENCE_TORQUE / load.toppling) ** 2)
    tracking = {"width": rounded(0.25 * min(1.0, largest) ** 2)}
    turning = {"width": rounded(0.25 * min(1.0, yaw) ** 2)}
    base_height = rounded(float(-10.0 / scale**4))
    settings: dict[str, Any] = {
        "command_range": [forward, sideways, [-yaw, yaw]],
        "gait_period": max(SHORTEST_PERIOD, rounded(float(PERIODS[biped] * np.sqrt(h / g)))),
    }
    rewards: dict[str, Any] = {
        "track_linear_velocity": {"weight": 2.5 if biped else 1.5, **tracking},
        "track_angular_velocity": {"weight": 1.0 if biped else 0.75, **turning},
        "linear_velocity_z": rounded(float(-1.0 / scale**2)),
        "base_height": base_height,
        "torques": torques,
    }
    if biped:
        others = [joint for joint in robot.driven if joint not in leg_joints]
        settings |= {"action_scale": 0.4, "contacts": ["foot"]}
        if others:
            settings["action_joints"] = [joint for joint in robot.driven if joint in leg_joints]
        settings["observations"] = [
            *("base_linear_velocity", "base_angular_velocity", "projected_gravity", "velocity_command"),
            *("joint_positions", "joint_velocities", "last_action", "gait_phase"),
        ]
        settings["terminations"] = ["torso_contact", "tilt", "fallen"]
        clearance = {"weight": rounded(float(-10.0 / scale**3)), "height": rounded(CLEARANCE * h)}
        rewards |= {
            "survive": 0.5,
            "gait": 0.5,
            "foot_clearance": clearance,
            "foot_slip": rounded(float(-0.1 / scale**2)),
        }
        rewards |= {"feet_air_time": 0, "knee_contact": 0, "stand_still": 0, "pose": -0.1}
    return settings | {"rewards": rewards}


def rounded(x: float) -> float:
    """Return a number with two digits."""
    return float(f"{x:.2g}")
