"""Scenes of robots on their feet: dropped, trotting, on stairs, and a biped with closed loops."""

from __future__ import annotations

import numpy as np

from ce_gym.bench.accuracy.scenarios.scene import HOLD, ROUGH, Array, Scene, on_feet
from ce_gym.dynamics.model import Model
from ce_gym.sim.terrain import Terrain


def drop(height: float, duration: float) -> Scene:
    """Return Mini Cheetah let go `height` [m] above the ground, slightly tilted, holding its standing pose."""
    robot = on_feet("mini_cheetah")
    model = Model(robot)
    q = model.standing_q.copy()
    q[2] += height + 0.01
    q[3:7] = np.array([1.0, 0.03, 0.02, 0.0]) / np.linalg.norm([1.0, 0.03, 0.02, 0.0])
    targets = np.tile(model.standing_q[7:], (round(duration / HOLD), 1))
    name, title = f"drop_{round(100 * height)}cm", f"Mini Cheetah dropped {100 * height:.0f} cm"
    return Scene(name, title, robot, q, np.zeros(model.nv), targets, "position", ours=ROUGH, spread=0.003)


def trot() -> Scene:
    """Return Mini Cheetah with its diagonal legs lifted in turn by a fixed sequence of joint targets, 1 s."""
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
"""Of the stairs [m], and how the robot faces them [rad]: its left front foot lands on the edge of the first step."""


def stairs() -> Scene:
    """Return Mini Cheetah let go above stairs, its front feet over the first step."""
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
    """Return Cassie let go a centimetre above the ground, slightly tilted: rods close loops, leaf springs give way."""
    robot = on_feet("cassie")
    model = Model(robot)
    q = model.standing_q.copy()
    q[2] += 0.01
    q[3:7] = _turned(0.03, 0.02)
    targets, levels = np.tile(model.standing_q[7:], (20, 1)), ("none", "coupled", "exact")
    title, still = "Cassie let go above the ground", np.zeros(model.nv)
    return Scene("biped", title, robot, q, still, targets, "position", ours=ROUGH, levels=levels, spread=0.003)


def _turned(yaw: float, pitch: float) -> Array:
    """Return the quaternion of a turn about z after one that lifts the front [rad]."""
    a, b = yaw / 2, -pitch / 2
    return np.array([np.cos(a) * np.cos(b), -np.sin(a) * np.sin(b), np.cos(a) * np.sin(b), np.sin(a) * np.cos(b)])
