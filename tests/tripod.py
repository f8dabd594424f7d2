"""Tripod, a floating robot of two joints on three feet: for what does not depend on a robot's size, and cheap.

`gymnasium.make("ce_gym/MiniCheetahVelocity-v0", robot=TRIPOD)` is its environment.
"""

from pathlib import Path

TRIPOD = str(Path(__file__).parent / "data" / "tripod" / "tripod.yaml")
