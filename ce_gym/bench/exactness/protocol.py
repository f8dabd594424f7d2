"""The settings of the studies, as data; docs/exactness.md says what they are for. None is fitted to results."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Leg:
    """One leg of a robot, and how it runs.

    Attributes:
        robot: Name of the robot.
        root: The body that the leg begins at; None for a robot that is nothing but a leg.
        foot: The body that carries the foot's point.
        point: The middle of the sole, in the frame of that body [m].
        speed: Running speed [m/s].
        frequency: Strides per second [Hz].
    """

    robot: str
    root: str | None
    foot: str
    point: tuple[float, float, float]
    speed: float
    frequency: float


LEGS = {
    "mit_humanoid_leg": Leg("mit_humanoid_leg", None, "ankle_link", (0.025, 0.0, -0.041), 2.0, 2.0),
    "tello_leg": Leg("tello", "left-hip-clamp", "left-foot", (0.025, 0.0, -0.041), 1.5, 2.5),
    "mini_cheetah_leg": Leg("mini_cheetah", "HR_abad_link", "HR_knee_link", (0.0, 0.004, -0.195), 3.0, 4.0),
}

# Controllers
PLANT_STEP, HOLD = 1e-4, 1e-3
"""Step of the plant, and how long a torque is held [s]."""
BANDWIDTHS = (3.0, 8.0, 20.0)
"""Natural frequencies of the critically damped loops [Hz]."""
FREQUENCIES = (1.0, 1.5, *(float(f) for f in range(2, 11)))
"""Of the sinusoids without feedback [Hz]."""
SLOWEST, FASTEST, SWEEP = 1.0, 10.0, 4.5
"""First and last frequency of a chirp [Hz], and how long it takes [s]."""
AMPLITUDE, FOOT_AMPLITUDE, CORNER, REACH = 0.5, 0.04, 1.5, 0.45
"""Of joints [rad] and of the foot [m] below the corner frequency [Hz]; most of a joint's range that is used."""
POSES, POSE_SPREAD = 8, 0.15
"""How many centres of motion, and how far they are from the standing pose [rad]."""
CLEARANCE = 0.1
"""Height of a swing leg's ellipse [m]."""
SETTLE, COUNTED = 2, 3
"""Strides that are not counted, and that are."""
HIGHEST_BANDWIDTH = 250.0
"""Largest natural frequency of the search for the largest stable one [Hz]."""

# Contacts
FEET = {
    "mini_cheetah": {f"{leg}_knee_link": (0.0, side, -0.195) for leg, side in
                     (("HR", 0.004), ("HL", -0.004), ("FR", 0.004), ("FL", -0.004))},
    "mit_humanoid": {f"{side}_ankle_link": (0.025, 0.0, -0.041) for side in ("right", "left")},
    "tello": {f"{side}-foot": (0.025, 0.0, -0.041) for side in ("left", "right")},
}  # fmt: skip
"""The one contact of each foot: body and place in it [m]."""
RADII = {"mini_cheetah": 0.0202}
"""Of the feet, where they are not points [m]."""
FALL = 1.0
"""Speed of a fall [m/s]."""
RATIOS, INERTIAS = (0.25, 0.5, 1.0, 2.0), (0.25, 1.0, 4.0)
"""Factors on gear ratios and on rotor inertia."""
STIFFNESSES = (5e4, 5e5, 5e6, 5e7)
"""Of the ground [N/m]; the last is for impulses only."""
LOSS_TIME = 0.01
"""Damping over stiffness, for impulses [s]; peak forces are on springs alone."""
WINDOW = 0.02
"""How long a contact is looked at on the softest ground [s]; inversely as the root of the stiffness on others."""
CONTACT_STEP = 2e-6
"""[s]."""

# Designs
RATIO_GRID, INERTIA_GRID = np.geomspace(0.4, 2.5, 13), np.geomspace(0.25, 4.0, 7)
TORQUE_POWER = 2 / 3
"""Of a rotor's inertia, that its motor's torque grows with: a thin ring of growing radius."""


@dataclass(frozen=True)
class Program:
    """How a robot jumps and runs: poses are factors on its standing pose.

    Attributes:
        crouch: Where it begins.
        tuck: In flight.
        gains: Factor on the robot's own.
        gait: About which its legs run.
        legs: First body, and share of a stride by which it is late, of the leg of each foot of `FEET`.
        speed: [m/s].
        frequency: Strides per second [Hz].
    """

    crouch: float
    tuck: float
    gains: float
    gait: float
    legs: tuple[tuple[str, float], ...]
    speed: float
    frequency: float


PROGRAMS = {
    "mini_cheetah": Program(1.375, 1.25, 3.0, 1.0, (
        ("HR_abad_link", 0.0), ("HL_abad_link", 0.5), ("FR_abad_link", 0.5), ("FL_abad_link", 0.0)), 3.0, 4.0),
    "mit_humanoid": Program(2.33, 2.0, 1.0, 1.5, (("right_hip_rz_link", 0.0), ("left_hip_rz_link", 0.5)), 2.0, 2.0),
}  # fmt: skip
PUSH = 0.3
"""The pose that legs are pushed to, as a factor on the standing pose."""
RAMPS = (0.05, 0.1, 0.15)
"""Durations of the push [s]."""
CROUCHED, TUCK, FLIGHT, JUMP = 0.5, 0.2, 0.25, 0.9
"""Time in the crouch; from push to tuck; from tuck to the look at pitch; of the push and what follows [s]."""
DROP, LANDING = 0.3, 0.3
"""Height of a drop [m] and time of its landing [s]."""
DESIGN_STEP, TARGET_STEP, LANDING_LAW = 5e-4, 5e-3, 0.5
"""Step, and how long a target holds [s]; Hunt and Crossley's dissipation [s/m]."""
SEEDS, FLIGHT_SEEDS = 8, 16
POSE_NOISE, RAMP_NOISE = 0.02, 0.05
"""Of poses [rad] and, relative, of ramps."""
K2, K2_INERTIA = 0.05**2 / 0.173, 6.3e-5
"""Torque squared over loss [N^2 m^2/W] of a motor with this rotor inertia [kg m^2]: torque constant and resistance of
Mini Cheetah's motors, mit-biomimetics/Cheetah-Software, MiniCheetah.h."""

LEVEL_SEED = 0
