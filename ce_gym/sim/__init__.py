"""Many robots stepped together: state arrays and compiled kernels."""

from ce_gym.sim.simulator import Simulator

__all__ = ["Simulator"]
