"""What a robot sees of the ground around it: heights on a grid of points, as an observation term.

Signs and shapes are those of legged_gym and Isaac Lab: base height minus ground, so that a hole is positive; the grid
turns with the heading of the base and stays level whatever its roll and pitch.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.grid import check, grid_points


def height_scan(
    s: TermContext,
    size: Sequence[float] = (1.6, 1.0),
    spacing: float = 0.1,
    centre: Sequence[float] = (0.0, 0.0),
    around: str = "base",
    clip: float = 1.0,
    scale: float = 1.0,
    drift: float = 0.0,
    shift: float = 0.0,
    dropout: float = 0.0,
    delay: int = 0,
) -> SX:
    """Heights of the base, less its standing height, above a grid of points on the ground [m], shape (17 x 11,).

    Args:
        s: The robot.
        size: Length and width of the grid [m].
        spacing: Distance of its points [m]. The last axis is width: `reshape(17, 11)` has rows from behind to ahead,
            columns from right to left.
        centre: Its middle, ahead of and to the left of what it is around [m].
        around: "base"; or "feet", for a grid around each, and heights of its lowest point.
        clip: Largest reading either way [m].
        scale: What readings are multiplied by.
        drift: Largest error of all readings in an episode [m].
        shift: Largest error of where the grid is along x and along y in an episode [m].
        dropout: Share of readings that are lost, and read 0.
        delay: How many control steps readings are late.

    Raises:
        ValueError: One line that names the parameter, its value and what was expected.
    """
    grid = grid_points(size, spacing, centre)
    check("around", around, around in ("base", "feet"), "'base' or 'feet'")
    for name, value in (("clip", clip), ("drift", drift), ("shift", shift)):
        check(name, value, value >= 0, "a length from 0 m on")
    check("dropout", dropout, 0 <= dropout < 1, "a share from 0 up to 1")
    check("delay", delay, isinstance(delay, int) and 0 <= delay <= 100, "a whole number from 0 to 100")
    seen = _late(s, _seen_from(s, around), delay)
    heading, centres = seen[:2], ca.reshape(seen[2:], 3, -1)
    away = ca.repmat(shift * s.drift("shift", 2) if shift else SX(2, 1), 1, centres.shape[1])
    ground = s.ground_around("heights", heading, centres[:2, :] + away, grid)
    above = ca.vec(ca.repmat(centres[2, :], grid.shape[1], 1)) - ground
    reading = ca.fmax(-clip, ca.fmin(clip, above + (drift * s.drift("offset") if drift else 0)))
    if dropout:
        reading = ca.if_else(s.chance(reading.numel()) < dropout, 0, reading)
    return scale * reading


def _seen_from(s: TermContext, around: str) -> SX:
    """Cosine and sine of the heading; then x and y of each centre, and how far up what sees it is, one after other."""
    base = s.kinematics.bodies[s.mechanism.robot.bodies[0].name]
    ahead = base.R[:2, 0]
    heading = ahead / ca.fmax(ca.norm_2(ahead), 1e-6)  # a base that looks straight up has none
    if around == "base":
        return ca.vertcat(heading, s.q[:2], s.q[2] - s.mechanism.robot.pose.height)
    return ca.vertcat(heading, *s.foot_places)


def _late(s: TermContext, now: SX, delay: int) -> SX:
    """What there was so many control steps ago, or when the episode began."""
    if not delay or s.exact:
        return now
    before = s.recall("seen", size=delay * now.numel())
    before = ca.if_else(s.begins, ca.repmat(now, delay, 1), before)
    s.keep("seen", ca.vertcat(now, before)[: before.numel()])
    return before[-now.numel() :]
