"""Scenes of a block on four corners, with friction only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ce_gym.bench.accuracy.scenarios.scene import HOLD, ROUGH, SLIP_SPEED, Array, Scene, Way, diagonal
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Pose, Robot

BLOCK_HALF = (0.15, 0.1, 0.05)
"""Half lengths of the edges [m]."""
BLOCK_MASS = 10.0
BLOCK_FRICTION = 0.5
GRAVITY = 9.81


def block(name: str, title: str, push: Array) -> Scene:
    """Return a block on four corners under a horizontal force, as a fraction of its weight, shape (n_holds,)."""
    a, b, c = BLOCK_HALF
    third = BLOCK_MASS / 3.0
    inertia = diagonal(third * (b * b + c * c), third * (a * a + c * c), third * (a * a + b * b))
    box = Body("block", "link", None, Placement(), Joint("free"), Inertial(BLOCK_MASS, (0.0, 0.0, 0.0), inertia))
    corners = tuple(
        ContactSphere(f"corner{i}", "block", (x, y, -c), 0.0)
        for i, (x, y) in enumerate(((a, b), (a, -b), (-a, b), (-a, -b)))
    )
    material = ContactMaterial(5e4, 300.0, BLOCK_FRICTION, SLIP_SPEED)
    height = c - BLOCK_MASS * GRAVITY / (4 * material.stiffness)
    robot = Robot("block", (box,), contacts=corners, material=material, pose=Pose(c))
    q, holds = np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]), len(push)
    pushes = GRAVITY * np.stack([push, 0 * push, 0 * push], axis=1)
    ours = ROUGH
    none = np.zeros((holds, 0))
    return Scene(name, title, robot, q, np.zeros(6), none, push=pushes, ours=ours, levels=("none",), spread=0.0)


def stick() -> Scene:
    """Return the block that sticks; this scene is smooth, so explicit methods can simulate it."""
    push = 0.8 * BLOCK_FRICTION * np.ones(25)
    scene = block("stick", "Block that sticks, 0.8 of the cone", push)
    return replace(scene, ours=(*ROUGH, Way("rk4")))


def blocks() -> dict[str, Callable[[], Scene]]:
    """Return the friction scenes: sticking, breakaway, sliding, and an alternating force."""
    n = 25
    t = HOLD * np.arange(n)
    one = np.ones(n)
    return {
        "stick": stick,
        "breakaway": lambda: block("breakaway", "Block that breaks away, 1.2 of the cone", 1.2 * BLOCK_FRICTION * one),
        "slide": lambda: block("slide", "Block that slides, 2 of the cone", 2.0 * BLOCK_FRICTION * one),
        "reversal": lambda: block(
            "reversal", "Block pushed to and fro", 1.6 * BLOCK_FRICTION * np.sin(2 * np.pi * 4.0 * t)
        ),
    }
