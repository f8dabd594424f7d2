"""A scene of links that push each other apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ce_gym.bench.accuracy.scenarios.scene import HOLD, METHODS_IN_CONTACT, SMOOTH, Scene, Way, unbounded
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot
from ce_gym.model.checks.collisions import capsules_of

PAIRS = (("FR_knee_link", "FL_knee_link"), ("HR_knee_link", "HL_knee_link"))
CLOSE, CROSS = 0.6, 0.15
"""How far hips swing inwards, and how far shanks are out of line with each other, or they would be parallel [rad]."""


def shanks() -> Scene:
    """Return Mini Cheetah, floating without gravity, whose hips press the shanks of its pairs of legs on each other."""
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
