"""How a cluster with closed loops goes together at its reference pose: found once, in numbers, when a model is built.

The reference pose is the robot's standing pose for the independent joints and its `assembly` for the others, completed
so that every constraint is met. It decides which rows of the constraints are redundant, which linear rows are
eliminated, and on which branch the loops are.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.constraints.elimination import eliminate, linear_rows
from ce_gym.dynamics.constraints.residuals import residual
from ce_gym.model.clusters import Cluster
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError

Array = NDArray[np.float64]

CLOSED = 1e-10
"""Largest residual of a constraint that is met at the reference pose."""
SINGULAR = 1e-7
"""Smallest singular value, relative to the largest, of loops that are not singular."""
REDUNDANT = 1e-6
"""Smallest singular value of rows, each with a largest entry of 1, that do not repeat each other: files are rounded."""
NEARLY_CLOSED = 1e-6
"""Largest residual of rounded rows in configurations that meet all others."""
SAMPLES, SPREADS = 6, (0.3, 0.1, 0.03)
"""Configurations around the reference pose that are tried, and how far from it, in units of the coordinates."""
FARTHEST = 0.5
"""How far a configuration may move when it is closed: beyond, it is on another branch, which may be singular."""


@dataclass(frozen=True)
class Assembly:
    """A cluster at its reference pose; `q = B [y; z] + q0` solves the linear constraints.

    Attributes:
        q: Spanning coordinates that meet all constraints [rad or m], shape (n,).
        B: Shape (n, d + m).
        q0: Shape (n,).
        unknown: Rows of `q` that are the unknowns `z`, which other than linear constraints determine, shape (m,).
        rows: Rows of those constraints that are kept, shape (m,); the others are redundant.
        dropped: Number of redundant rows.
        condition: Condition number of the constraint Jacobian of the dependent coordinates, rows scaled.
    """

    q: Array
    B: Array
    q0: Array
    unknown: tuple[int, ...]
    rows: tuple[int, ...]
    dropped: int
    condition: float


def nonlinear_rows(robot: Robot, cluster: Cluster, q: SX) -> SX:
    """Return the rows of a cluster's constraints that are not linear, at spanning coordinates `q` (n,)."""
    angles = {body: q[i] for i, body in enumerate(cluster.bodies)}
    ties = [tie for tie in cluster.constraints if not tie.linear]
    return ca.vertcat(*[residual(robot, tie, angles) for tie in ties])


class Assembler:
    """Assembles one cluster.

    Args:
        robot: The robot.
        cluster: One of its clusters, with a constraint that is not linear.
    """

    def __init__(self, robot: Robot, cluster: Cluster) -> None:
        self.robot, self.cluster, self.n = robot, cluster, len(cluster.bodies)
        self.A, self.b = linear_rows(cluster)
        symbol = SX.sym("q", self.n)
        rows = nonlinear_rows(robot, cluster, symbol)
        self.n_rows = rows.numel()
        self.evaluate = ca.Function("rows", [symbol], [ca.densify(rows), ca.densify(ca.jacobian(rows, symbol))])
        pattern = np.array(ca.DM(ca.sparsify(ca.jacobian(rows, symbol)).sparsity(), 1).full())
        self.appears = set(np.flatnonzero(pattern.any(axis=0)).tolist())
        self.independent = [cluster.bodies.index(name) for name in cluster.independent]
        self.dependent = [i for i in range(self.n) if i not in self.independent]
        self.unit = self._units()

    def assemble(self) -> Assembly:
        """Return the cluster at its reference pose.

        Raises:
            RobotError: The loops do not close, or the independent joints do not determine the others.
        """
        start = self._start()
        if not all(np.isfinite(x).all() for x in self._all(start)):
            raise self._error("is not a number at the standing pose: expected `pose` and `assembly` where it is one")
        q, gap = self._close(start, self.dependent)
        closed = gap < CLOSED
        rows = self._independent_rows(q if closed else self._close(q, list(range(self.n)))[0])
        if not rows:
            raise self._error("says nothing that joints and linear constraints do not: expected it left out")
        count = self.n - len(self.A) - len(rows)
        if len(self.independent) != count:
            raise self._error(f"has {len(self.independent)} independent joints: expected {count} of them")
        if count == 0:
            raise self._error("leaves its joints no freedom: expected fewer constraints")
        if not closed:
            raise self._error(
                f"does not close at the standing pose, gap {gap:.2g}: expected `pose` and `assembly` near"
            )
        condition = self._condition(q, rows)
        linear = eliminate(self.cluster, last=self.appears)
        return Assembly(q, linear.B, linear.q0, linear.unknown, rows, self.n_rows - len(rows), condition)

    def _error(self, problem: str) -> RobotError:
        names = ", ".join(tie.name for tie in self.cluster.constraints)
        return RobotError(f"{self.robot.source or self.robot.name}: the cluster tied by {names} {problem}")

    def _units(self) -> Array:
        """Units of the coordinates [rad or m], shape (n,): in theirs, rotors move about as fast as what they drive.

        That makes steps and condition numbers those of the loops, whatever the gear ratios are.
        """
        unit = np.ones(self.n)
        for i in set(range(self.n)) - self.appears:
            rows = self.A[self.A[:, i] != 0.0]
            unit[i] = max((float(np.abs(row).max() / abs(row[i])) for row in rows), default=1.0)
        return unit

    def _all(self, q: Array) -> tuple[Array, Array]:
        """Residual of all rows, linear ones first, and their Jacobian by the coordinates in their units."""
        phi, K = (np.array(out.full()) for out in self.evaluate.call([ca.DM(q)]))
        scale = np.abs(self.A).max(axis=1, initial=0.0)
        linear = (self.A @ q - self.b) / scale
        return np.concatenate([linear, phi[:, 0]]), np.vstack([self.A / scale[:, None], K]) * self.unit

    def _close(self, q: Array, free: list[int], smallest: float = 1e-10) -> tuple[Array, float]:
        """Move the coordinates `free` until the constraints are met, by a damped Gauss-Newton iteration.

        Directions whose singular value is below `smallest`, relative to the largest, are left alone: along them the
        iteration would wander far for the sake of a rounding error.
        """
        q = q.copy()
        for _ in range(200):
            phi, K = self._all(q)
            if not (np.isfinite(phi).all() and np.isfinite(K).all()):
                return q, np.inf
            if np.abs(phi).max() < 1e-15:
                break
            step = -np.linalg.lstsq(K[:, free], phi, rcond=smallest)[0]
            q[free] += self.unit[free] * step * min(1.0, 0.3 / max(np.abs(step).max(), 1e-300))
        return q, float(np.abs(self._all(q)[0]).max())

    def _start(self) -> Array:
        given = dict(self.robot.pose.joints) | dict(self.robot.assembly)
        return np.array([given.get(body, 0.0) for body in self.cluster.bodies])

    def _independent_rows(self, q: Array) -> tuple[int, ...]:
        """Find rows that are not implied by others, in configurations around the reference pose that meet them all."""
        Ks = next((Ks for spread in SPREADS if (Ks := self._jacobians_around(q, spread))), [])
        if not Ks:
            raise self._error("does not close at the standing pose, nor near it: expected `pose` and `assembly` near")
        first, kept = len(self.A), list(range(len(self.A)))
        for row in range(first, first + self.n_rows):
            if max(_smallest(K[[*kept, row]]) for K in Ks) > REDUNDANT:
                kept.append(row)
        return tuple(row - first for row in kept[first:])

    def _jacobians_around(self, q: Array, spread: float) -> list[Array]:
        """Return the Jacobian of all rows in configurations near `q` that are closed, on the same branch."""
        samples = self.unit * np.random.default_rng(0).uniform(-spread, spread, (SAMPLES, self.n))
        found = []
        for start in q + samples:
            closed, gap = self._close(start, list(range(self.n)), REDUNDANT)
            if gap < NEARLY_CLOSED and np.abs((closed - start) / self.unit).max() < FARTHEST:
                found.append(self._all(closed)[1])
        return found

    def _condition(self, q: Array, rows: tuple[int, ...]) -> float:
        """Condition number of the dependent columns, each row scaled to its largest entry."""
        K = self._all(q)[1][[*range(len(self.A)), *(len(self.A) + row for row in rows)]]
        K = K / np.abs(K).max(axis=1, keepdims=True).clip(1e-300)
        values = np.linalg.svd(K[:, self.dependent], compute_uv=False)
        if values[-1] <= SINGULAR * values[0]:
            raise self.singular()
        return float(values[0] / values[-1])

    def singular(self) -> RobotError:
        """Return the error of a cluster whose independent joints do not determine the others."""
        names, chosen = ", ".join(self.cluster.bodies[i] for i in self.dependent), ", ".join(self.cluster.independent)
        expected = f"expected independent joints that determine {names} at the standing pose, unlike {chosen}"
        return self._error(f"is singular: {expected}")


def _smallest(K: Array) -> float:
    """Smallest singular value of rows scaled to their largest entry; 0 if a row vanishes."""
    scale = np.abs(K).max(axis=1, initial=0.0, keepdims=True)
    if (scale < 1e-9).any() or K.shape[0] > K.shape[1]:
        return 0.0
    return float(np.linalg.svd(K / scale, compute_uv=False)[-1])
