"""Work-precision curves: what is measured of a scene, and what follows from it.

An error is the root mean square over all recorded times and position channels, 1 m and 1 rad counting alike, the
orientation of a base by its logarithm; against the truth, and against the limit that a code itself tends to as its step
goes to zero. Time is that of one core for one robot and one simulated second.
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
"""Steps to a hold at which ours is measured."""
PEER_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
"""The same for peers; the fourth-order method makes no use of the last."""
NUM_ENVS = 256
"""Robots in a batch of ours."""
TOLERANCES = (0.3, 0.1, 0.03, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
"""Of our steps that adapt [rad or m]."""
FINEST_SINGLE = 20, 1e-4
"""Most steps to a hold and least tolerance [rad or m] in single precision, where rounding does not show."""
ERROR_CONTROL = "error control"
"""Method of a peer's curve whose points are not steps but what was asked of an integrator."""
MARGIN = 10.0
"""How far below an error two references have to agree for it to count."""


@dataclass(frozen=True)
class Point:
    """One step length of one method.

    Attributes:
        dt: [s]; of steps that adapt, the tolerance [rad or m].
        seconds: Time for one robot and simulated second [s].
        truth: Error against the truth; not a number if the robot diverged.
        own: Error against the method's own limit.
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
        level: Transmission level, and for peers what else decides about the limit: how equalities are held, the law.
        method: Time-stepping method and solver.
        points: From long steps to short ones.
    """

    code: str
    level: str
    method: str
    points: tuple[Point, ...]

    @property
    def label(self) -> str:
        """Name for tables."""
        return f"{self.code} {self.level}, {self.method}"


@dataclass
class Measured:
    """Everything about one scene.

    Attributes:
        scene: The scene.
        curves: One for each method.
        agreement: Error between the two codes that the truth comes from.
        limits: How well the own limit of each family of curves is known, by (code, level).
    """

    scene: Scene
    agreement: float
    curves: list[Curve] = field(default_factory=list)
    limits: dict[tuple[str, str], float] = field(default_factory=dict)

    def error(self, point: Point) -> float:
        """Return the error that is compared: codes with different contact laws have different truths."""
        return point.truth if self.scene.smooth else point.own

    def known(self, curve: Curve) -> float:
        """Return how well that which the errors of a curve are taken against is known."""
        if self.scene.smooth:
            return self.agreement
        limit = self.limits[curve.code, curve.level]
        return max(limit, self.agreement) if curve.code == "ce_gym" else limit

    def errors(self, curve: Curve) -> list[float]:
        """Return the errors of a curve's points, none smaller than can be told from none."""
        return [max(self.error(point), MARGIN * self.known(curve)) for point in curve.points]


@dataclass(frozen=True)
class Comparison:
    """The least time in which each side reaches an error.

    Attributes:
        error: The error.
        ours: Our time for one robot and simulated second [s], None if not reached.
        method: Which method of ours.
        double: Our time without single precision [s], None if not reached.
        theirs: The peer's [s], None if not reached.
        peer: Which of its settings.
    """

    error: float
    ours: float | None
    method: str
    double: float | None
    theirs: float | None
    peer: str

    @property
    def ratio(self) -> float | None:
        """How many times as long the peer takes; None if not both reach the error."""
        return self.theirs / self.ours if self.ours and self.theirs else None

    @property
    def double_ratio(self) -> float | None:
        """The same with ours in double precision."""
        return self.theirs / self.double if self.double and self.theirs else None


def measure(
    scene: Scene, our_steps: Sequence[int], peer_steps: Sequence[int], rounds: int, more: Sequence[More] = ()
) -> Measured:
    """Measure all curves of a scene, competitors taking turns.

    Args:
        scene: The scene.
        our_steps: Steps to a hold of our methods.
        peer_steps: The same of MuJoCo's; none leaves it out.
        rounds: How often each point is timed.
        more: Other peers, where they are installed.
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
    """One point of one curve, to be run.

    Attributes:
        name: Code, level and method.
        dt: Length of a step [s]; of steps that adapt, the tolerance [rad or m].
        run: Runs through the scene and returns positions, shape (n_holds, nq).
        robots: How many at a time.
        limit: What the method tends to, shape (n_holds, nq).
    """

    name: tuple[str, str, str]
    dt: float
    run: Callable[[], Array]
    robots: int
    limit: Array


More: TypeAlias = Callable[[Scene, Array, Measured], list[Side]]
"""Sides of another peer from a scene, its truth and what is measured of it, which gets the limits of that peer."""


def reference(scene: Scene) -> tuple[Array, Array, Measured]:
    """Return the truth and the limit of our exact level, (n_holds, nq) each, and how far two codes agree on them."""
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
    """Return our methods at all step lengths; approximate levels tend to a truth of their own."""
    sides = []
    for way in scene.ours:
        limit = exact if way.level == scene.exact else accuracy_references.ours(scene, scene.reference // 2, way.level)
        name, single = ("ce_gym", way.level, way.name), way.dtype == "float32"
        batch = Ours(scene, way, NUM_ENVS)
        if way.method == "adaptive":  # as long as a tolerance allows, a hold at most
            for tolerance in (t for t in TOLERANCES if not single or t >= FINEST_SINGLE[1]):
                sides.append(Side(name, tolerance, partial(batch.run, 1, tolerance), NUM_ENVS, limit))
            continue
        for n in (n for n in steps if not single or n <= FINEST_SINGLE[0]):
            sides.append(Side(name, HOLD / n, partial(batch.run, n), NUM_ENVS, limit))
    return sides


def peer_sides(scene: Scene, steps: Sequence[int], measured: Measured) -> list[Side]:
    """Return MuJoCo's levels, ways to hold equalities and integrators at all step lengths."""
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
"""Steps to a hold from which MuJoCo's own limit is taken, compared with half as many; four times as many of a block."""
MOST_STEPS_RK4 = 200


def rms_error(scene: Scene, path: Array, reference: Array) -> float:
    """Return the error of positions (n_holds, nq), see the top of this file; not a number if `path` has one."""
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
    """Return the time in which a curve reaches an error for good [s], between its points on a log-log line.

    Args:
        curve: Its points from long steps to short ones.
        errors: Those of the points. A point counts if all shorter steps stay below `error` as well: where a curve
            crosses its final error by chance, nothing is reached.
        error: To reach.
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
    """Compare both sides at every decade of error, from the first that takes one of them more than its longest step.

    Ours are the exact curves, those of the peer `code` all it has. Ends where the limit of ours is known no better.
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
