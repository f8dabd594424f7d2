"""Dynamics and steps as functions for numba's `@njit` code.

The functions run the kernels of `ce_gym.Model` and `ce_gym.Simulator` without Python, with the same bits.
"""

try:
    import numba  # noqa: F401
except ImportError:
    raise ImportError('ce_gym.numba needs numba, which is not installed: pip install "ce_gym[numba]"') from None

from ce_gym.numba.constrained import constrained_forward_dynamics, operational_space_inertia
from ce_gym.numba.controller import Controller, controller
from ce_gym.numba.quantities import (
    bias_force,
    body_poses,
    contact_points,
    forward_dynamics,
    inverse_dynamics,
    mass_matrix,
    quantity,
)
from ce_gym.numba.stepper import Memory, Robots, set_state, stepper
from ce_gym.numba.terms import reward, termination

__all__ = [
    "Controller",
    "Memory",
    "Robots",
    "bias_force",
    "body_poses",
    "constrained_forward_dynamics",
    "contact_points",
    "controller",
    "forward_dynamics",
    "inverse_dynamics",
    "mass_matrix",
    "operational_space_inertia",
    "quantity",
    "reward",
    "set_state",
    "stepper",
    "termination",
]
