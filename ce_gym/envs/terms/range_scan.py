"""Range scan: an observation term with distances to the ground along rays from a lidar or a depth camera on a link.

Each ray is marched in equal steps. A fixed number of steps of regula falsi refines the first hit, so the cost is
constant. A ray misses ground that it enters and leaves within one step.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.recursion.kinematics import constant
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.grid import are_numbers, check_term, ray_directions, rotation_matrix
from ce_gym.model.arguments import is_number
from ce_gym.model.errors import listed_names

MAX_PLACES = 4000
"""Largest number of look-ups of one sensor, rays times steps."""
REFINEMENTS = 1
"""Refinements of each ray after the march. Each one computes all earlier look-ups again."""
SMALLEST = 1e-12
"""Smallest height difference in a division [m], for a sensor that is inside level ground."""


def range_scan(
    s: TermContext,
    link: str = "",
    position: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: Sequence[float] = (0.0, 0.5, 0.0),
    rays: Sequence[int] = (3, 7),
    view: Sequence[float] = (0.6, 1.2),
    pattern: str = "lidar",
    reach: float = 1.6,
    steps: int = 16,
    scale: float = 1.0,
    drift: float = 0.0,
    dropout: float = 0.0,
) -> SX:
    """Distances from a place of a link to the ground along rays, `reach` without a hit [m], shape (3 x 7,).

    With steps of 5 cm on rough ground of amplitude 0.15 m, 97 % of the rays are exact to 1 mm.

    Args:
        s: The robot.
        link: Name of the link; "" for the base.
        position: Position of the sensor in the link's frame [m].
        rotation: Roll, pitch and yaw of the sensor in the link's frame [rad]. The sensor looks along its x axis, and z
            is up; a positive pitch looks down.
        rays: Rows and columns. `reshape(3, 7)` gives a picture, from top to bottom and from left to right.
        view: Height and width of the picture [rad].
        pattern: "lidar" for equal angles between rows and columns, "camera" for equal distances in a picture plane.
        reach: Largest reading [m].
        steps: Steps of the march, each of length `reach / steps`.
        scale: Factor on the readings.
        drift: Largest error that all readings share during an episode [m].
        dropout: Share of rays that are lost and read `reach`.

    Raises:
        ValueError: A parameter is not valid; one line.
    """
    check = partial(check_term, "range_scan")
    check("position", position, are_numbers(position, 3), "three numbers")
    check("rotation", rotation, are_numbers(rotation, 3), "three numbers")
    for name, value, least in (("reach", reach, 1e-3), ("drift", drift, 0)):
        check(name, value, is_number(value) and value >= least, f"a length from {least:g} m on")
    check("dropout", dropout, is_number(dropout) and 0 <= dropout < 1, "a share from 0 up to 1")
    check("steps", steps, isinstance(steps, int) and steps >= 1, "a whole number from 1 on")
    bodies = s.kinematics.bodies
    link = link or s.mechanism.robot.bodies[0].name
    check("link", link, link in bodies, f"one of {listed_names(link, bodies)}")
    directions = ray_directions(rays, view, pattern)
    check("rays", rays, directions.shape[1] * steps <= MAX_PLACES, f"at most {MAX_PLACES} rays times steps")
    body = bodies[link]
    start = body.point_position(constant(np.array(position, dtype=float)))
    along = body.R @ ca.DM(rotation_matrix(rotation) @ directions)
    hit = _hit(s, start, along, reach, steps)
    reading = ca.if_else(hit < reach, hit + (drift * s.drift("offset") if drift else 0), reach)
    if dropout:
        reading = ca.if_else(s.chance(reading.numel()) < dropout, reach, reading)
    return scale * ca.fmax(0, ca.fmin(reach, reading))


def _hit(s: TermContext, start: SX, along: SX, reach: float, steps: int) -> SX:
    """Return distances to the ground along rays [m], shape (n,): 0 inside the ground, above `reach` without a hit."""
    if not s.on_field:
        down = ca.vec(-along[2, :])
        return ca.if_else(start[2] <= 0, 0, ca.if_else(down * 2 * reach > start[2], start[2] / down, 2 * reach))
    n, step = along.shape[1], reach / steps

    def places(distance: SX) -> SX:
        return ca.repmat(start[:2], 1, n) + along[:2, :] * ca.repmat(distance.T, 2, 1)

    marks = [SX(ca.DM.ones(n)) * (step * k) for k in range(1, steps + 1)]
    ground = s.ground_under("march", ca.horzcat(start[:2], *[places(mark) for mark in marks]))
    above = [ca.repmat(start[2] - ground[0], n, 1)]
    above += [start[2] + ca.vec(along[2, :]) * mark - ground[1 + n * k : 1 + n * k + n] for k, mark in enumerate(marks)]
    ones = SX(ca.DM.ones(n))
    high, over, under = 2 * reach * ones, ones, -ones
    for k in range(steps, 0, -1):
        inside = above[k] <= 0
        high = ca.if_else(inside, step * k, high)
        over = ca.if_else(inside, above[k - 1], over)
        under = ca.if_else(inside, above[k], under)
    low = high - step
    for i in range(REFINEMENTS):
        middle = low + (high - low) * over / ca.fmax(over - under, SMALLEST)
        here = start[2] + ca.vec(along[2, :]) * middle - s.ground_under(f"refined_{i}", places(middle))
        inside = here <= 0
        low, high = ca.if_else(inside, low, middle), ca.if_else(inside, middle, high)
        over, under = ca.if_else(inside, over, here), ca.if_else(inside, here, under)
    return ca.if_else(above[0] <= 0, 0, low + (high - low) * over / ca.fmax(over - under, SMALLEST))
