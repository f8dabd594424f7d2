"""Ground that is not flat: `Terrain`, and the files that it can come from."""

from ce_gym.sim.terrain.field import Terrain

__all__ = ["Terrain"]
