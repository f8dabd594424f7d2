"""Parts of the explicit reference of scenes with contact: ground, self-contact, springs and dampers of joints.

Each part has other formulas than ce_gym: stairs in closed form instead of a table, closest points of segments from five
candidates instead of clipping, passive joints from their power and energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ce_gym.bench.accuracy.scenarios import Scene
from ce_gym.dynamics.model import Model
from ce_gym.model.checks.collisions import colliding
from ce_gym.sim.terrain import Terrain

SX = ca.SX


def passive(model: Model, q: SX, v: SX) -> SX:
    """Return generalised forces of dampers and springs of all joints of a floating robot, shape (nv,)."""
    at_q, at_v, robot = SX.sym("q", model.nq), SX.sym("v", model.nv), model.robot
    positions, speeds = model.casadi_function("spanning")(at_q, at_v)
    rows, power, energy = robot.spanning_rows, SX(0), SX(0)
    for body in robot.bodies[1:]:
        (at,), (moves,) = rows[body.name]
        power += body.joint.damping * speeds[moves] ** 2 / 2
        energy += body.joint.stiffness * (positions[at] - body.joint.springref) ** 2 / 2
    pull = ca.vertcat(SX(6, 1), ca.gradient(energy, at_q)[7:])
    return ca.Function("passive", [at_q, at_v], [ca.gradient(power, at_v) + pull])(q, v)


def plane(terrain: Terrain | None, x: SX, radius: float) -> tuple[SX | float, SX]:
    """Return the height under a sphere's centre of the plane that it touches [m], and the normal, shape (3,)."""
    if terrain is None:
        return 0.0, SX([0.0, 0.0, 1.0])
    _, slope = stairs(terrain, x)
    meets = x + radius * slope / ca.sqrt(1 + slope**2)
    height, slope = stairs(terrain, meets)
    return height + slope * (x - meets), ca.vertcat(-slope, 0, 1) / ca.sqrt(1 + slope**2)


def stairs(terrain: Terrain, x: SX) -> tuple[SX, SX]:
    """Return height [m] and slope of stairs along x; each edge rises over two cells, in two parabolas."""
    heights = terrain.heights[:, 0]
    height, slope = SX(float(heights[0])), SX(0)
    for i in np.flatnonzero(np.diff(heights)):
        u = (x - terrain.origin[0]) / terrain.cell - float(i) - 0.5
        u, rise = ca.fmax(-1, ca.fmin(1, u)), float(heights[i + 1] - heights[i])
        height += rise * ca.if_else(u < 0, (1 + u) ** 2 / 2, 1 - (1 - u) ** 2 / 2)
        slope += rise / terrain.cell * (1 - ca.fabs(u))
    return height, slope


@dataclass
class Moving:
    """Bodies in the world.

    Attributes:
        names: Names of the bodies.
        poses: Positions (3, n) and rotations (3, 3 n).
        turns: Time derivatives of the rotations, shape (3, 3 n).
        moves: Time derivatives of the positions, shape (3, n).
    """

    names: Sequence[str]
    poses: tuple[SX, SX]
    turns: SX
    moves: SX

    def place(self, which: int, point: tuple[float, ...]) -> SX:
        """Return the position of a point of a body in the world [m], shape (3,)."""
        return self.poses[0][:, which] + self.poses[1][:, 3 * which : 3 * which + 3] @ SX(ca.DM(point))

    def velocity(self, which: int, place: SX) -> SX:
        """Return the velocity of the point of a body at a position in the world [m/s], shape (3,)."""
        R, turn = (x[:, 3 * which : 3 * which + 3] for x in (self.poses[1], self.turns))
        return self.moves[:, which] + turn @ R.T @ (place - self.poses[0][:, which])


def pressed(scene: Scene, bodies: Moving) -> list[tuple[int, SX]]:
    """Return self-contact forces: bodies and world wrenches about the origin, shape (6,)."""
    law, wrenches = scene.robot.material, []
    for first, second in colliding(scene.robot, scene.touching):
        a, b = (bodies.names.index(one.body) for one in (first, second))
        ends = [bodies.place(i, end) for i, one in ((a, first), (b, second)) for end in (one.start, one.end)]
        here, there = nearest(*ends)
        distance = ca.sqrt(ca.sumsqr(here - there))
        n, depth = (here - there) / distance, first.radius + second.radius - distance
        out = ca.dot(n, bodies.velocity(a, here) - bodies.velocity(b, there))
        lam = ca.if_else(depth > 0, ca.fmax(law.stiffness * depth - law.damping * out, 0), 0)
        force = lam * ca.vertcat(ca.cross(here, n), n)
        wrenches += [(a, force), (b, -force)]
    return wrenches


def nearest(a: SX, b: SX, c: SX, d: SX) -> tuple[SX, SX]:
    """Return the closest points of two segments: of their lines if inside both, or the best end and its projection."""
    u, w, r = b - a, d - c, c - a
    uu, ww, uw = ca.sumsqr(u), ca.sumsqr(w), ca.dot(u, w)
    s, t = (
        x / (uu * ww - uw**2) for x in (ww * ca.dot(u, r) - uw * ca.dot(w, r), uw * ca.dot(u, r) - uu * ca.dot(w, r))
    )
    best, square = (a + s * u, c + t * w), ca.sumsqr(a + s * u - c - t * w)
    square = ca.if_else(ca.logic_and(ca.fmin(s, t) >= 0, ca.fmax(s, t) <= 1), square, 1e9)
    for pair in [(end, _foot(end, c, w)) for end in (a, b)] + [(_foot(end, a, u), end) for end in (c, d)]:
        other = ca.sumsqr(pair[0] - pair[1])
        best = ca.if_else(other < square, pair[0], best[0]), ca.if_else(other < square, pair[1], best[1])
        square = ca.fmin(other, square)
    return best


def _foot(point: SX, start: SX, along: SX) -> SX:
    """Return the point of a segment that is closest to a point."""
    return start + ca.fmax(0, ca.fmin(1, ca.dot(point - start, along) / ca.sumsqr(along))) * along
