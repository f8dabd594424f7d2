"""Assembly of a cluster with closed loops at its reference pose, computed once in numbers when a model is built.

The reference pose is the robot's standing pose for the independent joints and its `assembly` for the others, completed
so that every constraint holds. The reference pose determines the redundant rows of the constraints, the linear rows to
eliminate, and the branch of the loops.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.constraints.elimination import eliminate, linear_rows
from ce_gym.dynamics.constraints.residuals import residual
from ce_gym.model.clusters import Cluster
from ce_gym.model.constraints import Constraint, LoopConstraint
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError

Array = NDArray[np.float64]

CLOSED = 1e-10
"""Largest residual of a constraint that holds at the reference pose."""
SINGULAR = 1e-7
"""Smallest singular value, relative to the largest, of loops that are not singular."""
REDUNDANT = 1e-5
"""Smallest singular value of scaled rows that are not redundant.

Files with six digits misalign the axes of a planar loop by up to 3e-6.
"""
DISTINCT = 0.05
"""Smallest singular value of rows that are chosen first: of two nearly equal rows, the better one."""
VANISHING = 1e-9
"""Largest scale of rows that count as zero."""
NEARLY_CLOSED = 1e-5
"""Largest residual of rounded redundant rows in configurations that satisfy the other rows."""
SAMPLES, SPREADS = 6, (0.3, 0.1, 0.03)
"""Number of configurations to try around the reference pose, and their distances from it in units of coordinates."""
ENOUGH = 3
"""Number of closed configurations after which nearer ones are not tried."""
FARTHEST = 0.5
"""Largest move to close a configuration; beyond, it is on another branch, which may be singular."""


@dataclass(frozen=True)
class Assembly:
    """A cluster at its reference pose; `q = B [y; z] + q0` solves the linear constraints.

    Attributes:
        q: Spanning coordinates that satisfy all constraints [rad or m], shape (n,).
        B: Shape (n, d + m).
        q0: Shape (n,).
        unknown: Rows of `q` that are the unknowns `z`, which the nonlinear constraints determine, shape (m,).
        rows: Rows of the nonlinear constraints that are kept, shape (m,); the others are redundant.
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
    """Return the rows of a cluster's nonlinear constraints at spanning coordinates `q` (n,)."""
    return ca.vertcat(*[rows for _, rows in _rows_by_tie(robot, cluster, q)])


def _rows_by_tie(robot: Robot, cluster: Cluster, q: SX) -> list[tuple[Constraint, SX]]:
    """Return the nonlinear constraints of a cluster, each with its rows at `q` (n,)."""
    angles = {body: q[i] for i, body in enumerate(cluster.bodies)}
    return [(tie, residual(robot, tie, angles)) for tie in cluster.constraints if not tie.linear]


class Assembler:
    """Assembles one cluster.

    Args:
        robot: The robot.
        cluster: A cluster of the robot with a nonlinear constraint.
    """

    def __init__(self, robot: Robot, cluster: Cluster) -> None:
        self.robot, self.cluster, self.n = robot, cluster, len(cluster.bodies)
        self.A, self.b = linear_rows(cluster)
        symbol = SX.sym("q", self.n)
        by_tie = _rows_by_tie(robot, cluster, symbol)
        self.counts = [(tie, rows.numel()) for tie, rows in by_tie]
        rows = ca.vertcat(*[rows for _, rows in by_tie])
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
        rows = self._independent_rows(q if gap < CLOSED else self._close(start, list(range(self.n)), REDUNDANT)[0])
        if not rows:
            raise self._error("is redundant, because joints and linear constraints imply it: expected it left out")
        count = self.n - len(self.A) - len(rows)
        if count == 0:
            raise self._error(
                "leaves its joints no freedom: expected fewer constraints, or repeated ones that agree to 1e-5"
            )
        if len(self.independent) != count:
            chosen = ", ".join(self.cluster.independent) or "none"
            freedoms = (
                f"{count} freedom{'s' * (count > 1)}, as {len(rows) + len(self.A)} constraints tie {self.n} joints"
            )
            raise self._error(f"has {freedoms}: expected as many independent joints, unlike {chosen}")
        if gap >= CLOSED:
            q = self._close_rounded(start, rows, gap)
        condition = self._condition(q, rows)
        linear = eliminate(self.cluster, last=self.appears)
        return Assembly(q, linear.B, linear.q0, linear.unknown, rows, self.n_rows - len(rows), condition)

    def _close_rounded(self, q: Array, rows: tuple[int, ...], gap: float) -> Array:
        """Return coordinates that satisfy the kept rows; redundant rows may be rounded."""
        kept = [*range(len(self.A)), *(len(self.A) + row for row in rows)]
        q, residual = self._close(q, self.dependent, kept=kept)
        if residual >= CLOSED or np.abs(self._all(q)[0]).max() > NEARLY_CLOSED:
            raise self._error(
                f"does not close at the standing pose, gap {gap:.2g}: expected `pose` and `assembly` near"
            )
        return q

    def _error(self, problem: str) -> RobotError:
        bodies = ", ".join(name for name in self.cluster.bodies if self.robot.body(name).kind == "link")
        names = ", ".join(tie.name for tie in self.cluster.constraints)
        return RobotError(f"{self.robot.source or self.robot.name}: the loop of {bodies}, tied by {names}, {problem}")

    def _units(self) -> Array:
        """Return units of the coordinates [rad or m], shape (n,), in which rotors move about as fast as their joints.

        Steps and condition numbers then do not depend on gear ratios.
        """
        unit = np.ones(self.n)
        for i in set(range(self.n)) - self.appears:
            rows = self.A[self.A[:, i] != 0.0]
            unit[i] = max((float(np.abs(row).max() / abs(row[i])) for row in rows), default=1.0)
        return unit

    def _all(self, q: Array) -> tuple[Array, Array]:
        """Return the residuals of all rows, linear rows first, and their Jacobian by the coordinates in their units."""
        phi, K = (np.array(out.full()) for out in self.evaluate.call([ca.DM(q)]))
        scale = np.abs(self.A).max(axis=1, initial=0.0)
        linear = (self.A @ q - self.b) / scale
        return np.concatenate([linear, phi[:, 0]]), np.vstack([self.A / scale[:, None], K]) * self.unit

    def _close(
        self, q: Array, free: list[int], smallest: float = 1e-10, kept: list[int] | slice = slice(None)
    ) -> tuple[Array, float]:
        """Move the coordinates `free` until the rows `kept` are zero, by a damped Gauss-Newton iteration.

        The iteration does not move along directions whose singular value is below `smallest`, relative to the largest:
        a rounding error would cause a large move.
        """
        q = q.copy()
        for _ in range(200):
            phi, K = (x[kept] for x in self._all(q))
            if not (np.isfinite(phi).all() and np.isfinite(K).all()):
                return q, np.inf
            if np.abs(phi).max() < 1e-15:
                break
            step = -np.linalg.lstsq(K[:, free], phi, rcond=smallest)[0]
            q[free] += self.unit[free] * step * min(1.0, 0.3 / max(np.abs(step).max(), 1e-300))
        return q, float(np.abs(self._all(q)[0][kept]).max())

    def _start(self) -> Array:
        pose = dict(self.robot.pose.joints) | dict(self.robot.assembly)
        return np.array([pose.get(body, 0.0) for body in self.cluster.bodies])

    def _independent_rows(self, q: Array) -> tuple[int, ...]:
        """Return rows that the other rows do not imply, from closed configurations around the reference pose."""
        Ks: list[Array] = []
        gap = np.abs(self._all(q)[0]).max()
        limits = (max(CLOSED, 10 * gap), NEARLY_CLOSED) if gap < NEARLY_CLOSED else ()
        for limit, spread in itertools.product(limits, SPREADS):
            Ks += self._jacobians_around(q, spread, limit) if len(Ks) < ENOUGH else []
        if not Ks:
            raise self._error("does not close at the standing pose, nor near it: expected `pose` and `assembly` near")
        first, kept = len(self.A), list(range(len(self.A)))
        scaled = [self._scaled(K) for K in Ks]
        for least in (DISTINCT, REDUNDANT):
            for row in (row for row in range(first, first + self.n_rows) if row not in kept):
                if max(_smallest(K[[*kept, row]]) for K in scaled) > least:
                    kept.append(row)
        return tuple(sorted(row - first for row in kept[first:]))

    def _jacobians_around(self, q: Array, spread: float, limit: float) -> list[Array]:
        """Return the Jacobian of all rows in configurations near `q` with gaps below `limit`, on the same branch."""
        directions = np.eye(self.n)
        only_nearly_closed = np.abs(self._all(q)[0]).max() >= CLOSED
        if only_nearly_closed:  # do not move a rounded loop to the configuration in which it closes exactly
            values, directions = np.linalg.svd(self._scaled(self._all(q)[1]))[1:]
            directions = directions[(values > REDUNDANT).sum() :]
        samples = np.random.default_rng(0).uniform(-spread, spread, (SAMPLES, len(directions))) @ directions
        jacobians = []
        for start in q + self.unit * samples:
            closed, residual = self._close(start, list(range(self.n)), REDUNDANT)
            if residual < limit and np.abs((closed - start) / self.unit).max() < FARTHEST:
                jacobians.append(self._all(closed)[1])
        return jacobians

    def _scaled(self, K: Array) -> Array:
        """Scale rows to a largest entry of 1: the three rows of a loop's origin together, the rows of its axis not.

        In a planar loop the rows across its plane are zero up to rounding, and must not be scaled up.
        """
        scale = np.abs(K).max(axis=1)
        row = len(self.A)
        for tie, count in self.counts:
            if isinstance(tie, LoopConstraint):
                scale[row : row + 3] = scale[row : row + 3].max()
                scale[row + 3 : row + count] = 1.0
            row += count
        return np.divide(K, scale[:, None], out=np.zeros_like(K), where=scale[:, None] > VANISHING)

    def _condition(self, q: Array, rows: tuple[int, ...]) -> float:
        """Return the condition number of the dependent columns, each row scaled to its largest entry."""
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
    """Return the smallest singular value of rows; 0 if there are more rows than columns."""
    return 0.0 if K.shape[0] > K.shape[1] else float(np.linalg.svd(K, compute_uv=False)[-1])
