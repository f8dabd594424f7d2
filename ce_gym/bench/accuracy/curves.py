"""Work-precision curves of a scene: errors and times of all methods, and comparisons between codes.

An error is the root mean square over all recorded times and positions, where 1 m and 1 rad have equal weight and the
orientation of a base is a rotation vector. There are two errors: against the reference solution, and against the limit
of the same code for short steps. Time is the processor time of one core for one robot and one simulated second.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias

import numpy as np

from ce_gym.bench.accuracy.ours import Ours
from ce_gym.bench.accuracy.peers import Peer, families
from ce_gym.bench.accuracy.references import contact as accuracy_contact
from ce_gym.bench.accuracy.references import smooth as accuracy_references
from ce_gym.bench.accuracy.scenarios import HOLD, SINGLE, Array, Scene, Way
from ce_gym.bench.measure.timing import Competitor, interleaved

OUR_STEPS = (1, 2, 5, 10, 20, 50, 100, 200)
"""Steps per hold of methods of ce_gym."""
PEER_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
"""Steps per hold of peers; the fourth-order method does not use the last."""
NUM_ENVS = 256
"""Robots in a batch of ce_gym."""
TOLERANCES = (0.3, 0.1, 0.03, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
"""Tolerances of the adaptive method [rad or m]."""
FINEST_SINGLE = 20, 1e-4
"""Largest number of steps per hold and smallest tolerance [rad or m] in single precision, because of rounding."""
ERROR_CONTROL = "error control"
"""Method of a peer's curve whose points are accuracies of an integrator instead of step lengths."""
MARGIN = 10.0
"""Smallest ratio of an error to the difference of the references."""


@dataclass(frozen=True)
class Point:
    """One step length of one method.

    Attributes:
        dt: Step length [s]; tolerance of an adaptive method [rad or m].
        seconds: Time for one robot and simulated second [s].
        truth: Error against the reference solution; NaN if the robot diverged.
        own: Error against the limit of the method.
    """

    dt: float
    seconds: float
    truth: float
    own: float


@dataclass(frozen=True)
class Curve:
    """One method of one code on one scene.

    Attributes:
        code: "ce_gym", "MuJoCo" or "Drake".
        level: Transmission level; for peers also the kind of equality constraints or contact law, if the limit depends
            on them.
        method: Time-stepping method and solver.
        points: Points from long to short steps.
    """

    code: str
    level: str
    method: str
    points: tuple[Point, ...]

    @property
    def label(self) -> str:
        """Return the name for tables."""
        return f"{self.code} {self.level}, {self.method}"


@dataclass
class Measured:
    """Measurements of one scene.

    Attributes:
        scene: The scene.
        curves: One curve for each method.
        agreement: Difference of the two reference codes.
        limits: Error of the limit of each family of curves, by (code, level).
    """

    scene: Scene
    agreement: float
    curves: list[Curve] = field(default_factory=list)
    limits: dict[tuple[str, str], float] = field(default_factory=dict)

    def error(self, point: Point) -> float:
        """Return the error for comparisons: against the reference in smooth scenes, the own limit in contact."""
        return point.truth if self.scene.smooth else point.own

    def known(self, curve: Curve) -> float:
        """Return the error of the reference of a curve."""
        if self.scene.smooth:
            return self.agreement
        limit = self.limits[curve.code, curve.level]
        return max(limit, self.agreement) if curve.code == "ce_gym" else limit

    def errors(self, curve: Curve) -> list[float]:
        """Return the errors of a curve's points, limited from below by the error of the reference."""
        return [max(self.error(point), MARGIN * self.known(curve)) for point in curve.points]


@dataclass(frozen=True)
class Comparison:
    """The shortest time in which both sides reach an error.

    Attributes:
        error: The error.
        ours: Time of ce_gym for one robot and simulated second [s], None if not reached.
        method: Method of ce_gym.
        double: Time of ce_gym in double precision [s], None if not reached.
        theirs: Time of the peer [s], None if not reached.
        peer: Settings of the peer.
    """

    error: float
    ours: float | None
    method: str
    double: float | None
    theirs: float | None
    peer: str

    @property
    def ratio(self) -> float | None:
        """Return the ratio of times, peer to ce_gym; None unless both reach the error."""
        return self.theirs / self.ours if self.ours and self.theirs else None

    @property
    def double_ratio(self) -> float | None:
        """Return the ratio with ce_gym in double precision."""
        return self.theirs / self.double if self.double and self.theirs else None


def measure(
    scene: Scene, our_steps: Sequence[int], peer_steps: Sequence[int], rounds: int, more: Sequence[More] = ()
) -> Measured:
    """Return all curves of a scene, with competitors timed alternately.

    Args:
        scene: The scene.
        our_steps: Steps per hold of methods of ce_gym.
        peer_steps: Steps per hold of MuJoCo; if empty, MuJoCo is not measured.
        rounds: Number of timings of each point.
        more: Other peers, if they are installed.
    """
    truth, ours_limit, measured = reference(scene)
    sides = our_sides(scene, our_steps, ours_limit)
    sides += peer_sides(scene, peer_steps, measured) if peer_steps else []
    sides += [side for peers in more for side in peers(scene, truth, measured)]
    paths: dict[Side, Array] = {}

    def runner(side: Side) -> Callable[[], None]:
        return lambda: paths.__setitem__(side, side.run())

    timings = interleaved({str(i): Competitor(runner(s)) for i, s in enumerate(sides)}, rounds, time.thread_time)
    seconds = {side: timings[str(i)].best / (side.robots * scene.duration) for i, side in enumerate(sides)}
    for name in dict.fromkeys(side.name for side in sides):
        points = [
            Point(s.dt, seconds[s], rms_error(scene, paths[s], truth), rms_error(scene, paths[s], s.limit))
            for s in sides
            if s.name == name
        ]
        measured.curves.append(Curve(*name, tuple(points)))
    return measured


@dataclass(frozen=True, eq=False)
class Side:
    """One point of one curve, before the measurement.

    Attributes:
        name: Code, level and method.
        dt: Step length [s]; tolerance of an adaptive method [rad or m].
        run: Function that simulates the scene and returns positions, shape (n_holds, nq).
        robots: Number of robots in a batch.
        limit: Positions in the limit of short steps, shape (n_holds, nq).
    """

    name: tuple[str, str, str]
    dt: float
    run: Callable[[], Array]
    robots: int
    limit: Array


More: TypeAlias = Callable[[Scene, Array, Measured], list[Side]]
"""Function that returns the sides of another peer from scene, reference and measurements, and adds its limits."""


def reference(scene: Scene) -> tuple[Array, Array, Measured]:
    """Return reference and limit of the exact level, shape (n_holds, nq), and measurements with their agreement."""
    if scene.smooth:
        truth = accuracy_references.ours(scene, scene.reference // 2)
        return (
            truth,
            truth,
            Measured(scene, rms_error(scene, accuracy_references.theirs(scene, scene.reference), truth)),
        )
    truth = accuracy_contact.explicit(scene, 40_000)
    fine = Ours(scene, Way("extrapolated", scene.exact), 1)
    limit = fine.run(4000)
    measured = Measured(scene, rms_error(scene, limit, truth))
    measured.limits["ce_gym", scene.exact] = rms_error(scene, fine.run(2000), limit)
    return truth, limit, measured


def our_sides(scene: Scene, steps: Sequence[int], exact: Array) -> list[Side]:
    """Return methods of ce_gym at all step lengths; simplified levels have their own limits."""
    sides = []
    for way in scene.ours:
        limit = exact if way.level == scene.exact else accuracy_references.ours(scene, scene.reference // 2, way.level)
        name, single = ("ce_gym", way.level, way.name), way.dtype == "float32"
        batch = Ours(scene, way, NUM_ENVS)
        if way.method == "adaptive":  # the tolerance limits steps, and a hold is the longest
            for tolerance in (t for t in TOLERANCES if not single or t >= FINEST_SINGLE[1]):
                sides.append(Side(name, tolerance, partial(batch.run, 1, tolerance), NUM_ENVS, limit))
            continue
        for n in (n for n in steps if not single or n <= FINEST_SINGLE[0]):
            sides.append(Side(name, HOLD / n, partial(batch.run, n), NUM_ENVS, limit))
    return sides


def peer_sides(scene: Scene, steps: Sequence[int], measured: Measured) -> list[Side]:
    """Return MuJoCo's levels, kinds of equality constraints and integrators at all step lengths."""
    sides = []
    for family in families(scene):
        finest = PEER_LIMIT if scene.robot.independent else 4 * PEER_LIMIT
        limit, coarser = (Peer(family, "RK4", n).run() for n in (finest, finest // 2))
        measured.limits["MuJoCo", family.name] = rms_error(scene, coarser, limit)
        for integrator in INTEGRATORS:
            for n in [n for n in steps if integrator != "RK4" or n <= MOST_STEPS_RK4]:
                run = Peer(family, integrator, n).run
                sides.append(Side(("MuJoCo", family.name, integrator), HOLD / n, run, 1, limit))
    return sides


INTEGRATORS = ("Euler", "implicitfast", "discrete", "RK4")
PEER_LIMIT = 1000
"""Steps per hold for MuJoCo's limit, compared with half as many steps; four times as many for a block."""
MOST_STEPS_RK4 = 200


def rms_error(scene: Scene, path: Array, reference: Array) -> float:
    """Return the error of positions (n_holds, nq), see the top of this file; NaN if `path` contains NaN."""
    difference = path - reference
    if scene.robot.floating:
        turn = _relative_rotation(reference[:, 3:7], path[:, 3:7])
        difference = np.concatenate([difference[:, :3], turn, difference[:, 7:]], axis=1)
    return float(np.sqrt(np.mean(difference**2)))


def _relative_rotation(a: Array, b: Array) -> Array:
    """Return rotation vectors [rad] from quaternions `a` to `b`, shape (n, 3)."""
    w = np.sum(a * b, axis=1)
    vector = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    vector *= np.where(w < 0, -1.0, 1.0)[:, None]
    sine = np.linalg.norm(vector, axis=1)
    angle = 2 * np.arctan2(sine, np.abs(w))
    return vector * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)[:, None]


def time_to(curve: Curve, errors: Sequence[float], error: float) -> float | None:
    """Return the time at which a curve reaches an error [s], by interpolation on log-log axes.

    A point reaches the error only if all shorter steps also have smaller errors, because a curve can cross its final
    error by chance.

    Args:
        curve: Curve with points from long to short steps.
        errors: Errors of the points.
        error: Error to reach.
    """
    reached = None
    for i in reversed(range(len(errors))):
        if not errors[i] <= error:
            break
        reached = i
    if reached is None:
        return None
    seconds = min(point.seconds for point in curve.points[reached:])
    if reached and errors[reached - 1] < math.inf and errors[reached] > 0:
        start = curve.points[reached - 1].seconds
        share = math.log(errors[reached - 1] / error) / math.log(errors[reached - 1] / errors[reached])
        seconds = min(seconds, start * (seconds / start) ** share)
    return seconds


def comparisons(measured: Measured, code: str = "MuJoCo") -> list[Comparison]:
    """Return comparisons at every decade of error, from the first that needs more than the longest step.

    The curves of ce_gym at the exact level are compared with all curves of the peer `code`. The smallest error is the
    accuracy of the limit of ce_gym.
    """
    ours = [curve for curve in measured.curves if curve.code == "ce_gym" and curve.level == measured.scene.exact]
    theirs = [curve for curve in measured.curves if curve.code == code]
    stepping = [curve for curve in theirs if curve.method != ERROR_CONTROL]
    coarse = [min((e for c in side if (e := measured.errors(c)[0]) > 0), default=1.0) for side in (ours, stepping)]
    found, exponent = [], min(-1, math.floor(math.log10(max(coarse))))
    while 10.0**exponent >= MARGIN * min(measured.known(curve) for curve in ours):
        level = 10.0**exponent
        our_time, method = _fastest(measured, ours, level)
        double, _ = _fastest(measured, [curve for curve in ours if not curve.method.endswith(SINGLE)], level)
        their_time, settings = _fastest(measured, theirs, level)
        if our_time is None and their_time is None:
            break
        found.append(Comparison(level, our_time, method, double, their_time, settings))
        exponent -= 1
    return found


def _fastest(measured: Measured, curves: Sequence[Curve], error: float) -> tuple[float | None, str]:
    times = {c: time_to(c, measured.errors(c), error) for c in curves}
    reached = {c: t for c, t in times.items() if t is not None}
    if not reached:
        return None, ""
    best = min(reached, key=lambda c: reached[c])
    return reached[best], best.label.split(" ", 1)[1]
