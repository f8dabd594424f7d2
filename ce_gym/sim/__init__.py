"""Many robots stepped together: state arrays and compiled kernels."""

from ce_gym.sim.simulator import Simulator
from ce_gym.sim.terrain import Terrain

__all__ = ["Simulator", "Terrain"]
