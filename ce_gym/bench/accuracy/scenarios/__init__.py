"""Scenes of the accuracy benchmark: robot, initial state, drives and duration."""

from __future__ import annotations

from collections.abc import Callable

from ce_gym.bench.accuracy.scenarios.blocks import BLOCK_FRICTION, GRAVITY, blocks
from ce_gym.bench.accuracy.scenarios.flight import belt_leg, elastic_leg, four_bar, humanoid, stiff_leg, tello, tumble
from ce_gym.bench.accuracy.scenarios.scene import HOLD, SINGLE, Array, Scene, Way
from ce_gym.bench.accuracy.scenarios.touching import biped, drop, shanks, stairs, trot

SCENES: dict[str, Callable[[], Scene]] = {
    "humanoid": humanoid,
    "tumble": tumble,
    "four_bar": four_bar,
    "tello": tello,
    "belt_leg": belt_leg,
    "stiff_1e3": lambda: stiff_leg(1e3),
    "stiff_1e4": lambda: stiff_leg(1e4),
    "stiff_1e5": lambda: stiff_leg(1e5),
    "drop_3cm": lambda: drop(0.03, 0.3),
    "drop_30cm": lambda: drop(0.3, 0.5),
    "drop_100cm": lambda: drop(1.0, 0.7),
    "trot": trot,
    **blocks(),
    "elastic": elastic_leg,
    "stairs": stairs,
    "shanks": shanks,
    "biped": biped,
}
"""Functions that return the scenes, by name."""

__all__ = ["BLOCK_FRICTION", "GRAVITY", "HOLD", "SCENES", "SINGLE", "Array", "Scene", "Way"]
