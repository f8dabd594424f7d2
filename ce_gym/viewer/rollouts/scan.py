"""Where a robot's height and range scans look: what is drawn on ground that is not flat."""

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
"""One sensor, plain data, see `Rollout.scan`."""

BASE: Scan = {"link": "", "at": [[0.0, 0.0, 0.0]]}


def scans_of(program: TaskProgram) -> tuple[Scan, ...]:
    """Return where the observations or the critic's blocks `height_scan` and `range_scan` look, see `Rollout.scan`.

    Errors and delay of the sensors are left out. Empty if there are none.
    """
    terms, found = {**program.critic_terms, **program.observation_terms}, list[Scan]()
    for sensor in (height_scan, range_scan):
        if (term := terms.get(sensor.__name__)) is not None:
            given = signature(sensor).bind(None, **term.parameters)
            given.apply_defaults()
            robot = program.model.robot
            found += _grids(given.arguments, robot) if sensor is height_scan else [_rays(given.arguments)]
    return tuple(found)


def _grids(chosen: dict[str, Any], robot: Robot) -> list[Scan]:
    """The grid about the base, or that about each foot, the mean of the middles of its contacts."""
    points = grid_points(chosen["size"], chosen["spacing"], chosen["centre"]).T.tolist()
    if chosen["around"] == "base":
        return [{**BASE, "points": points}]
    feet: dict[str, list[list[float]]] = {}
    for contact in robot.contacts:
        if contact.group == "foot":
            feet.setdefault(contact.body, []).append([float(x) for x in contact.position])
    return [{"link": link, "at": places, "points": points} for link, places in feet.items()]


def _rays(chosen: dict[str, Any]) -> Scan:
    along = rotation_matrix(chosen["rotation"]) @ ray_directions(chosen["rays"], chosen["view"], chosen["pattern"])
    at = [np.array(chosen["position"], float).tolist()]
    march = {"reach": float(chosen["reach"]), "steps": int(chosen["steps"])}
    return {"link": chosen["link"], "at": at, "rays": along.T.tolist(), **march}
