"""What linear constraints say about joints: every coordinate as a linear function of a few."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ce_gym.dynamics.constraints.closure import closures
from ce_gym.dynamics.constraints.cluster_constraints import linear_solution
from ce_gym.model.mechanism import Mechanism


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

    def scaled(self, factor: float) -> Tie:
        """Return the tie of a coordinate that is larger by a factor."""
        return Tie({name: factor * ratio for name, ratio in self.ratios.items()}, factor * self.offset)


def joint_ties(mechanism: Mechanism) -> dict[str, Tie]:
    """Return every joint coordinate as a function of the independent ones, by joint name.

    With closed loops, the linear constraints alone leave more joints free: functions are then of the independent joints
    and of those that only the loops determine.

    Raises:
        RobotError: If the independent joints do not determine the others, or loops do not close.
    """
    ties: dict[str, Tie] = {}
    for cluster, closure in zip(mechanism.tree.clusters, closures(mechanism), strict=True):
        if mechanism.robot.body(cluster.bodies[0]).joint.nv > 1:
            continue
        B, q0 = linear_solution(cluster) if closure is None else (closure.assembly.B, closure.assembly.q0)
        unknown = () if closure is None else closure.assembly.unknown
        kept = [*cluster.independent, *(cluster.bodies[i] for i in unknown)]
        for name, row, offset in zip(cluster.bodies, B, q0, strict=True):
            ties[name] = Tie({y: float(x) for y, x in zip(kept, row, strict=True) if x != 0.0}, float(offset))
    return {body.name: ties[body.name] for body in mechanism.robot.bodies if body.name in ties}
