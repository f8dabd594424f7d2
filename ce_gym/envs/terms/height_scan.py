"""Height scan: an observation term with heights of the ground on a grid of points.

Readings are base height minus ground height as in legged_gym and Isaac Lab, so a hole is positive. The grid turns with
the heading of the base and stays level.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.grid import check_term, grid_points


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
        spacing: Distance of neighbouring points [m]. `reshape(17, 11)` gives rows from behind to ahead and columns from
            right to left.
        centre: Middle of the grid, ahead of and to the left of the base or foot [m].
        around: "base", or "feet" for one grid around each foot with heights of the lowest point of that foot.
        clip: Largest absolute reading [m].
        scale: Factor on the readings.
        drift: Largest error that all readings share during an episode [m].
        shift: Largest error of the position of the grid along x and along y during an episode [m].
        dropout: Share of readings that are lost and read 0.
        delay: Control steps by which readings are late.

    Raises:
        ValueError: A parameter is not valid; one line.
    """
    grid = grid_points(size, spacing, centre)
    check_term("height_scan", "around", around, around in ("base", "feet"), "'base' or 'feet'")
    for name, value in (("clip", clip), ("drift", drift), ("shift", shift)):
        check_term("height_scan", name, value, value >= 0, "a length from 0 m on")
    check_term("height_scan", "dropout", dropout, 0 <= dropout < 1, "a share from 0 up to 1")
    whole = isinstance(delay, int) and 0 <= delay <= 100
    check_term("height_scan", "delay", delay, whole, "a whole number from 0 to 100")
    pose = _delayed(s, _sensor_pose(s, around), delay)
    heading, centres = pose[:2], ca.reshape(pose[2:], 3, -1)
    offset = ca.repmat(shift * s.drift("shift", 2) if shift else SX(2, 1), 1, centres.shape[1])
    ground = s.ground_around("heights", heading, centres[:2, :] + offset, grid)
    above = ca.vec(ca.repmat(centres[2, :], grid.shape[1], 1)) - ground
    reading = ca.fmax(-clip, ca.fmin(clip, above + (drift * s.drift("offset") if drift else 0)))
    if dropout:
        reading = ca.if_else(s.chance(reading.numel()) < dropout, 0, reading)
    return scale * reading


def _sensor_pose(s: TermContext, around: str) -> SX:
    """Return cosine and sine of the heading, then x, y and height of each centre, stacked."""
    base = s.kinematics.bodies[s.mechanism.robot.bodies[0].name]
    ahead = base.R[:2, 0]
    heading = ahead / ca.fmax(ca.norm_2(ahead), 1e-6)  # not defined for a vertical base
    if around == "base":
        return ca.vertcat(heading, s.q[:2], s.q[2] - s.mechanism.robot.pose.height)
    return ca.vertcat(heading, *s.foot_places)


def _delayed(s: TermContext, value: SX, delay: int) -> SX:
    """Return a value as it was `delay` control steps ago, or at the start of the episode."""
    if not delay or s.exact:
        return value
    older = s.recall("seen", size=delay * value.numel())
    older = ca.if_else(s.begins, ca.repmat(value, delay, 1), older)
    s.keep("seen", ca.vertcat(value, older)[: older.numel()])
    return older[-value.numel() :]
