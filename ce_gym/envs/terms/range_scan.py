"""Distances along rays from a lidar or a camera on a link to the ground, as an observation term.

A ray is followed in equal steps; the first step that ends in the ground is made shorter by regula falsi, a fixed number
of times, so that the cost depends on nothing. What a ray crosses between two points of the march it does not see.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.recursion.kinematics import constant
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.grid import check_of, numbers, ray_directions, turned
from ce_gym.model.errors import listed_names

MOST_PLACES = 4000
"""How many places one sensor looks at, rays times steps."""
REFINEMENTS = 1
"""Look-ups of each ray after the march; for each all that was before is computed again."""
SMALLEST = 1e-12
"""Least difference of heights that is divided by [m], for a sensor in level ground has none."""


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
    """Distances from a place of a link to the ground along rays, `reach` where there is none [m], shape (3 x 7,).

    Of rays on rough ground of 0.15 m, marched by 5 cm, 97 % are within 1 mm; one that comes out of the ground again
    within a step of the march goes through.

    Args:
        s: The robot.
        link: Name of the link; "" for the base.
        position: Where the sensor is, in the link's frame [m].
        rotation: Roll, pitch and yaw of the sensor in the link's frame [rad]: it looks along x, z is up; a positive
            pitch looks down.
        rays: Rows and columns: `reshape(3, 7)` is a picture, from the top to the bottom and from left to right.
        view: Height and width of the picture [rad].
        pattern: "lidar" for equal angles between rows and columns, "camera" for equal distances in a picture plane.
        reach: Largest reading [m].
        steps: Of the march, `reach / steps` long.
        scale: What readings are multiplied by.
        drift: Largest error of all readings in an episode [m].
        dropout: Share of rays that do not come back, and read `reach`.

    Raises:
        ValueError: One line that names the parameter, its value and what was expected.
    """
    check, three = check_of("range_scan"), "three numbers"
    check("position", position, numbers(position, 3), three)
    check("rotation", rotation, numbers(rotation, 3), three)
    for name, value, least in (("reach", reach, 1e-3), ("drift", drift, 0)):
        check(name, value, numbers([value], 1) and value >= least, f"a length from {least:g} m on")
    check("dropout", dropout, numbers([dropout], 1) and 0 <= dropout < 1, "a share from 0 up to 1")
    check("steps", steps, isinstance(steps, int) and steps >= 1, "a whole number from 1 on")
    bodies = s.kinematics.bodies
    link = link or s.mechanism.robot.bodies[0].name
    check("link", link, link in bodies, f"one of {listed_names(link, bodies)}")
    directions = ray_directions(rays, view, pattern)
    check("rays", rays, directions.shape[1] * steps <= MOST_PLACES, f"at most {MOST_PLACES} rays times steps")
    body = bodies[link]
    start = body.point_position(constant(np.array(position, dtype=float)))
    along = body.R @ ca.DM(turned(rotation) @ directions)
    hit = _hit(s, start, along, reach, steps)
    reading = ca.if_else(hit < reach, hit + (drift * s.drift("offset") if drift else 0), reach)
    if dropout:
        reading = ca.if_else(s.chance(reading.numel()) < dropout, reach, reading)
    return scale * ca.fmax(0, ca.fmin(reach, reading))


def _hit(s: TermContext, start: SX, along: SX, reach: float, steps: int) -> SX:
    """Distance to the ground along rays [m], shape (n,): 0 for a sensor in the ground, more than `reach` if none."""
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
    none = SX(ca.DM.ones(n))
    high, over, under = 2 * reach * none, none, -none
    for k in range(steps, 0, -1):
        into = above[k] <= 0
        high = ca.if_else(into, step * k, high)
        over, under = ca.if_else(into, above[k - 1], over), ca.if_else(into, above[k], under)
    low = high - step
    for i in range(REFINEMENTS):
        middle = low + (high - low) * over / ca.fmax(over - under, SMALLEST)
        here = start[2] + ca.vec(along[2, :]) * middle - s.ground_under(f"refined_{i}", places(middle))
        into = here <= 0
        low, over, high, under = (
            ca.if_else(into, low, middle),
            ca.if_else(into, over, here),
            ca.if_else(into, middle, high),
            ca.if_else(into, here, under),
        )
    return ca.if_else(above[0] <= 0, 0, low + (high - low) * over / ca.fmax(over - under, SMALLEST))
