"""Where a robot's height scan looks: what is drawn on ground that is not flat."""

from __future__ import annotations

from inspect import signature

from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.terms.grid import grid_points
from ce_gym.envs.terms.height_scan import height_scan

Points = tuple[tuple[float, float], ...]


def scan_points(program: TaskProgram) -> Points:
    """Return the grid of the observation or the critic's block `height_scan`, ahead of and to the left of the base [m].

    Errors and delay of the sensor are left out. Empty if there is none, or one around the feet.
    """
    term = {**program.critic_terms, **program.observation_terms}.get("height_scan")
    if term is None:
        return ()
    given = signature(height_scan).bind(None, **term.parameters)
    given.apply_defaults()
    chosen = given.arguments
    if chosen["around"] != "base":
        return ()
    return tuple((float(x), float(y)) for x, y in grid_points(chosen["size"], chosen["spacing"], chosen["centre"]).T)
