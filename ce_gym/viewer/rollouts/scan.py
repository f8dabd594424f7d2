"""The height and range scans of a task, for drawing."""

from __future__ import annotations

from inspect import signature
from typing import Any

import numpy as np

from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.terms.grid import grid_points, ray_directions, rotation_matrix
from ce_gym.envs.terms.height_scan import height_scan
from ce_gym.envs.terms.range_scan import range_scan
from ce_gym.model import Robot

Scan = dict[str, Any]
"""One sensor, see `Rollout.scan`."""


def scans_of(program: TaskProgram) -> tuple[Scan, ...]:
    """Return the scans among the observations and the critic's blocks, without errors and delay of the sensors."""
    terms, scans = {**program.critic_terms, **program.observation_terms}, list[Scan]()
    for sensor in (height_scan, range_scan):
        if (term := terms.get(sensor.__name__)) is not None:
            arguments = signature(sensor).bind(None, **term.parameters)
            arguments.apply_defaults()
            robot = program.model.robot
            scans += _grids(arguments.arguments, robot) if sensor is height_scan else [_rays(arguments.arguments)]
    return tuple(scans)


def _grids(options: dict[str, Any], robot: Robot) -> list[Scan]:
    """Return the grid around the base, or a grid around each foot: the mean of the foot's contact centres."""
    points = grid_points(options["size"], options["spacing"], options["centre"]).T.tolist()
    if options["around"] == "base":
        return [{"link": "", "at": [[0.0, 0.0, 0.0]], "points": points}]
    feet: dict[str, list[list[float]]] = {}
    for contact in robot.contacts:
        if contact.group == "foot":
            feet.setdefault(contact.body, []).append([float(x) for x in contact.position])
    return [{"link": link, "at": places, "points": points} for link, places in feet.items()]


def _rays(options: dict[str, Any]) -> Scan:
    along = rotation_matrix(options["rotation"]) @ ray_directions(options["rays"], options["view"], options["pattern"])
    at = [np.array(options["position"], float).tolist()]
    march = {"reach": float(options["reach"]), "steps": int(options["steps"])}
    return {"link": options["link"], "at": at, "rays": along.T.tolist(), **march}
