"""Physical parameters that are drawn for each episode."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.laws.scene_parameters import check_parameter, parameter_defaults
from ce_gym.envs.task.tasks import RANDOMISED, Range
from ce_gym.model.arguments import check
from ce_gym.model.description import Robot
from ce_gym.model.errors import listed_names

FACTORS = (
    *("stiffness", "kp", "kd", "motor_strength", "rotor_inertia", "ratio"),
    *("motor_damping", "motor_friction", "drive_friction", "cogging", "battery_voltage", "battery_resistance"),
)
"""Parameters whose ranges are factors on the value of the robot."""


class Randomised:
    """The parameters of one robot that a task draws, in the order of the task.

    Args:
        robot: The robot.
        ranges: Lower and upper bound by name, see `RANDOMISED`.

    Attributes:
        parameters: Names of the parameters of the dynamics.
        n_draws: Random numbers for each episode, one for each value of a parameter.

    Raises:
        ValueError: A parameter does not exist or its range is not valid.
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
        for key, name, bounds, default in zip(ranges, names, self._ranges, self._defaults, strict=True):
            try:
                check_parameter(robot, name, np.outer(bounds, default) if name in FACTORS else bounds)
            except ValueError as problem:
                expected = str(problem).split("; ")[-1]
                raise ValueError(f"randomise[{key!r}]=({bounds[0]}, {bounds[1]}); {expected}") from None
        self.n_draws = sum(len(default) for default in self._defaults)

    def values(self, draw: SX) -> SX:
        """Return the values of the parameters, stacked, for random numbers in [0, 1), shape (n_draws,)."""
        values, first = [SX(0, 1)], 0
        for name, (low, high), default in zip(self.parameters, self._ranges, self._defaults, strict=True):
            value = low + (high - low) * draw[first : first + len(default)]
            values.append(value * default if name in FACTORS else value)
            first += len(default)
        return ca.vertcat(*values)
