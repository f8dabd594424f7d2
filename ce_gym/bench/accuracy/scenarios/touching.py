"""Scenes with contact: a dropped robot, trotting, stairs, a biped with closed loops, legs pressed together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ce_gym.bench.accuracy.scenarios.scene import (
    HOLD,
    METHODS_IN_CONTACT,
    ROUGH,
    SMOOTH,
    Array,
    Scene,
    Way,
    on_feet,
    unbounded,
)
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot
from ce_gym.model.checks.collisions import capsules_of
from ce_gym.sim.terrain import Terrain


def drop(height: float, duration: float) -> Scene:
    """Return Mini Cheetah released `height` [m] above the ground, slightly tilted, in its standing pose."""
    robot = on_feet("mini_cheetah")
    model = Model(robot)
    q = model.standing_q.copy()
    q[2] += height + 0.01
    q[3:7] = np.array([1.0, 0.03, 0.02, 0.0]) / np.linalg.norm([1.0, 0.03, 0.02, 0.0])
    targets = np.tile(model.standing_q[7:], (round(duration / HOLD), 1))
    name, title = f"drop_{round(100 * height)}cm", f"Mini Cheetah dropped {100 * height:.0f} cm"
    return Scene(name, title, robot, q, np.zeros(model.nv), targets, "position", ours=ROUGH, spread=0.003)


def trot() -> Scene:
    """Return Mini Cheetah that lifts diagonal legs alternately for 1 s, with fixed joint targets."""
    robot = on_feet("mini_cheetah")
    model = Model(robot)
    t = HOLD * np.arange(round(1.0 / HOLD))
    targets = np.tile(model.standing_q[7:], (len(t), 1))
    for i, name in enumerate(model.joint_links):
        swing = np.maximum(0.0, np.sin(2 * np.pi * 2.5 * t + (0.0 if name[:2] in ("FR", "HL") else np.pi)))
        if name.endswith(("_hip_link", "_knee_link")):
            targets[:, i] += (-0.35 if "hip" in name else 0.7) * swing
    ours, start = ROUGH, model.standing_q
    return Scene("trot", "Trot on the spot, 1 s", robot, start, np.zeros(model.nv), targets, "position", ours=ours)


RISE, TREAD, PITCH, YAW = 0.1, 0.3, 0.26, 0.1
"""Sizes of the stairs [m], and orientation of the robot [rad]; the left front foot lands on the first edge."""


def stairs() -> Scene:
    """Return Mini Cheetah released above stairs, with its front feet over the first step."""
    robot = on_feet("mini_cheetah")
    model = Model(robot)
    terrain = Terrain.stairs(RISE, TREAD, 3, start=0.225)
    q = model.standing_q.copy()
    q[3:7] = _turned(YAW, PITCH)
    q[2] += RISE / 2 + 0.05
    targets = np.tile(model.standing_q[7:], (20, 1))
    title, still = "Mini Cheetah let go above stairs", np.zeros(model.nv)
    return Scene("stairs", title, robot, q, still, targets, "position", ours=ROUGH, terrain=terrain, spread=0.003)


def biped() -> Scene:
    """Return Cassie released 1 cm above the ground, slightly tilted, with closed loops of rods and leaf springs."""
    robot = on_feet("cassie")
    model = Model(robot)
    q = model.standing_q.copy()
    q[2] += 0.01
    q[3:7] = _turned(0.03, 0.02)
    targets, levels = np.tile(model.standing_q[7:], (20, 1)), ("none", "coupled", "exact")
    title, still = "Cassie let go above the ground", np.zeros(model.nv)
    return Scene("biped", title, robot, q, still, targets, "position", ours=ROUGH, levels=levels, spread=0.003)


PAIRS = (("FR_knee_link", "FL_knee_link"), ("HR_knee_link", "HL_knee_link"))
CLOSE, CROSS = 0.6, 0.15
"""Inward angle of the hips, and angle between the shanks, so that the shanks are not parallel [rad]."""


def shanks() -> Scene:
    """Return Mini Cheetah, floating without gravity, whose hips press the shanks of each pair of legs together."""
    robot = load_robot("mini_cheetah")
    capsules = tuple(capsule for pair in PAIRS for link in pair for capsule in capsules_of(robot, link))
    robot = unbounded(replace(robot, contacts=(), capsules=capsules, gravity=(0.0, 0.0, 0.0)))
    model = Model(robot)
    t = HOLD * np.arange(20)
    swing = CLOSE * np.sin(np.pi * t / t[-1])
    targets = np.tile(model.standing_q[7:], (len(t), 1))
    start = model.standing_q.copy()
    for i, name in enumerate(model.joint_links):
        right, front = name[1] == "R", name[0] == "F"
        if name.endswith("_abad_link"):
            targets[:, i] += swing if right else -swing
        elif name.endswith("_hip_link"):
            targets[:, i] += CROSS if right == front else -CROSS
            start[7 + i] = targets[0, i]
    coarse = tuple(Way(method, dtype="float32") for method in METHODS_IN_CONTACT)
    ours = (*SMOOTH, *coarse)
    title, still = "Legs pressed on each other", np.zeros(model.nv)
    return Scene("shanks", title, robot, start, still, targets, "position", ours=ours, touching=PAIRS, spread=0.003)


def _turned(yaw: float, pitch: float) -> Array:
    """Return the quaternion of a pitch that lifts the front, followed by a yaw [rad]."""
    a, b = yaw / 2, -pitch / 2
    return np.array([np.cos(a) * np.cos(b), -np.sin(a) * np.sin(b), np.cos(a) * np.sin(b), np.sin(a) * np.cos(b)])
