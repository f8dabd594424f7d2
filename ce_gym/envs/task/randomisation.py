"""Physical figures that are drawn anew for each episode."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.laws.scene_parameters import check_parameter, parameter_defaults
from ce_gym.envs.task.tasks import RANDOMISED, Range
from ce_gym.model.description import Robot
from ce_gym.model.errors import listed_names
from ce_gym.sim.arguments import check

FACTORS = (
    *("stiffness", "kp", "kd", "motor_strength", "rotor_inertia", "ratio"),
    *("motor_damping", "motor_friction", "drive_friction", "cogging", "battery_voltage", "battery_resistance"),
)
"""Figures whose ranges are factors on what the robot has."""


class Randomised:
    """The figures of one robot that a task draws, in the order of the task.

    Args:
        robot: The robot.
        ranges: Lower and upper bound by name, see `RANDOMISED`.

    Attributes:
        parameters: Names of the parameters of the dynamics.
        n_draws: Numbers in [0, 1) that they are made of, one for each of their values, stacked.

    Raises:
        ValueError: If a name does not exist or a range is none.
    """

    def __init__(self, robot: Robot, ranges: Mapping[str, Range]) -> None:
        base = robot.bodies[0].name
        names = []
        for name, (low, high) in ranges.items():
            kind = name.split(":")[0]
            check("randomise", name, kind in RANDOMISED, f"one of {listed_names(kind, RANDOMISED)}")
            if not low <= high:
                raise ValueError(f"randomise[{name!r}]=({low}, {high}); expected low <= high")
            names.append(f"{name}:{base}" if name in ("added_mass", "com_shift") else name)
        self.parameters = tuple(names)
        self._ranges = tuple(ranges.values())
        self._defaults = list(parameter_defaults(robot, robot.material, names, "randomise").values())
        for given, name, bounds, default in zip(ranges, names, self._ranges, self._defaults, strict=True):
            try:
                check_parameter(robot, name, np.outer(bounds, default) if name in FACTORS else bounds)
            except ValueError as problem:
                expected = str(problem).split("; ")[-1]
                raise ValueError(f"randomise[{given!r}]=({bounds[0]}, {bounds[1]}); {expected}") from None
        self.n_draws = sum(len(default) for default in self._defaults)

    def values(self, draw: SX) -> SX:
        """Return the parameters' values, stacked, for numbers in [0, 1), shape (n_draws,)."""
        values, first = [SX(0, 1)], 0
        for name, (low, high), default in zip(self.parameters, self._ranges, self._defaults, strict=True):
            value = low + (high - low) * draw[first : first + len(default)]
            values.append(value * default if name in FACTORS else value)
            first += len(default)
        return ca.vertcat(*values)
