"""The parameters of a robot in a scene: of its model and of the force laws."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.normal import HuntCrossley, normal_law
from ce_gym.dynamics.forces.scene import Scene, StepOptions
from ce_gym.dynamics.laws.scene_laws import LAWS, PARAMETERS
from ce_gym.dynamics.parameters import RANGES, check_ratios, least_value, with_parameters
from ce_gym.model.description import ContactMaterial, Robot
from ce_gym.model.errors import check_names
from ce_gym.model.mechanism import Mechanism


def parameter_defaults(
    robot: Robot, material: ContactMaterial, names: Sequence[str], argument: str = "parameters"
) -> dict[str, NDArray]:
    """Return the value that leaves the robot unchanged, for each declared parameter, shape (size,).

    Args:
        robot: The robot.
        material: Of its contacts.
        names: The declared parameters.
        argument: Name of `names` in error messages.

    Raises:
        ValueError: If a name is not a parameter of the robot, or is listed twice.
    """
    known = {name: parameter for parameter in PARAMETERS.values() for name in parameter.names(robot)}
    check_names(argument, names, known, "one of", listed=f"{', '.join(PARAMETERS)}, BODY being a link, ROTOR a rotor")
    if "ratio" in names:
        check_ratios(robot)
    return {name: np.array(known[name].default(robot, material), dtype=float) for name in names}


def check_parameter(robot: Robot, name: str, values: ArrayLike) -> None:
    """Check the values of a parameter.

    Args:
        robot: The robot.
        name: Of one of its parameters.
        values: Of some robots, any shape.

    Raises:
        ValueError: If a value is not finite or out of range; one line.
    """
    numbers, kind = np.asarray(values, dtype=float), name.split(":")[0]
    parameter = next(parameter for parameter in PARAMETERS.values() if parameter.kind == kind)
    allowed, (least, expected) = RANGES[parameter.allowed], least_value(robot, name)
    lowest = least if expected else allowed.lowest
    good = (numbers > lowest if kind == "added_mass" else numbers >= lowest) & (numbers <= allowed.highest)
    if wrong := numbers[~good].tolist():
        raise ValueError(f"{name}={wrong[0]:g}; expected {expected or f'{allowed.expected} [{parameter.unit}]'}")


def split_parameters(robot: Robot, material: ContactMaterial, names: Sequence[str], values: SX) -> dict[str, SX]:
    """Return the declared parameters by name, given their values stacked in that order."""
    sizes = [len(default) for default in parameter_defaults(robot, material, names).values()]
    return dict(zip(names, ca.vertsplit(values, np.cumsum([0, *sizes]).tolist()), strict=True)) if names else {}


def law_values(robot: Robot, material: ContactMaterial, names: Sequence[str], values: SX) -> dict[str, SX]:
    """Return the force laws' parameters by name; `values` stacks the declared ones in the order of `names`."""
    given = split_parameters(robot, material, names, values)
    of_laws = [parameter.name for law in LAWS for parameter in law.parameters]
    defaults = parameter_defaults(robot, material, of_laws)
    return {name: given.get(name, SX(default)) for name, default in defaults.items()}


def make_scene(mechanism: Mechanism, options: StepOptions, parameters: SX, ground: SX) -> Scene:
    """Return a scene whose declared parameters, stacked in the order of the options, are `parameters`.

    Raises:
        ValueError: The damping of contacts is a parameter, under a law that has none.
    """
    law = normal_law(options.normal_law, options.material)
    if "damping" in options.parameters and isinstance(law, HuntCrossley):
        raise ValueError("parameters='damping'; expected a material without dissipation, which takes its place")
    robot, material = mechanism.robot, options.material
    named = with_parameters(mechanism, split_parameters(robot, material, options.parameters, parameters))
    return Scene(named, options, law_values(robot, material, options.parameters, parameters), ground)
