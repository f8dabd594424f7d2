"""What linear constraints say about joints: every coordinate as a linear function of a few.

The dynamics does the same cluster by cluster, and then solves the loops too; here is what can be said without that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.clusters import Cluster, cluster_tree
from ce_gym.model.description import LinearConstraint, Robot
from ce_gym.model.errors import RobotError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Tie:
    """A joint coordinate as a linear function of others, `q = sum(ratio * y) + offset`.

    Attributes:
        ratios: Ratio for each of the other joints that matters, by name.
        offset: Value when all of those are zero [rad or m].
    """

    ratios: dict[str, float]
    offset: float = 0.0

    def at(self, coordinates: Mapping[str, float]) -> float:
        """Return the coordinate [rad or m] for given ones of the other joints."""
        return self.offset + sum(ratio * coordinates[name] for name, ratio in self.ratios.items())


def joint_ties(robot: Robot) -> dict[str, Tie]:
    """Return every joint coordinate as a function of the independent ones, by joint name.

    With closed loops, the linear constraints alone leave more joints free: functions are then of the independent joints
    and of those that only the loops determine. Rotors are never among these if a linear constraint ties them.

    Raises:
        RobotError: If the independent joints do not determine the others.
    """
    linear = [constraint for constraint in robot.constraints if isinstance(constraint, LinearConstraint)]
    names = [body.name for body in robot.bodies if body.joint.type != "free"]
    dependent = [name for name in names if name not in robot.independent]
    rows = [dict(constraint.coefficients) for constraint in linear]
    A = np.array([[row.get(name, 0.0) for name in names] for row in rows]).reshape(len(rows), len(names))
    solved = _solvable(A, robot, names, dependent)
    in_loops = {name for cluster in clusters_with_loops(robot) for name in cluster.bodies}
    if len(solved) < len(rows) or not set(dependent) <= {*solved, *in_loops}:
        raise RobotError(f"{robot.name}: the independent joints do not determine {', '.join(dependent)}")
    kept = [name for name in names if name not in solved]
    ties = {name: Tie({name: 1.0}) for name in kept}
    if solved:
        column = {name: i for i, name in enumerate(names)}
        offset = np.array([constraint.offset for constraint in linear])
        right = np.column_stack([offset, -A[:, [column[name] for name in kept]]])
        solution = np.linalg.solve(A[:, [column[name] for name in solved]], right)
        for name, row in zip(solved, solution, strict=True):
            ratios = {y: float(x) for y, x in zip(kept, row[1:], strict=True) if abs(x) > 1e-14}
            ties[name] = Tie(ratios, float(row[0]))
    return {name: ties[name] for name in names}


def _solvable(A: Array, robot: Robot, names: list[str], dependent: list[str]) -> list[str]:
    """Return dependent joints that the linear constraints `A q = b` can be solved for, rotors before others."""
    columns: list[int] = []
    for name in sorted(dependent, key=lambda name: robot.body(name).kind != "rotor"):
        more = [*columns, names.index(name)]
        if np.linalg.matrix_rank(A[:, more]) == len(more):
            columns = more
    return [names[i] for i in columns]


def clusters_with_loops(robot: Robot) -> list[Cluster]:
    """Return the clusters with a constraint that is not linear."""
    clusters = cluster_tree(robot).clusters
    return [c for c in clusters if any(not isinstance(tie, LinearConstraint) for tie in c.constraints)]
