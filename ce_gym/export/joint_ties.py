"""Joint coordinates as linear functions of the independent ones, from the linear constraints."""

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
        ratios: Ratio of each other joint with an influence, by name.
        offset: Coordinate if all other joints are at zero [rad or m].
    """

    ratios: dict[str, float]
    offset: float = 0.0

    def at(self, coordinates: Mapping[str, float]) -> float:
        """Return the coordinate [rad or m] for coordinates of the other joints, by name."""
        return self.offset + sum(ratio * coordinates[name] for name, ratio in self.ratios.items())

    def scaled(self, factor: float) -> Tie:
        """Return the tie of the coordinate times a factor."""
        return Tie({name: factor * ratio for name, ratio in self.ratios.items()}, factor * self.offset)


def joint_ties(mechanism: Mechanism) -> dict[str, Tie]:
    """Return every joint coordinate as a linear function of others, by joint name.

    Without closed loops, the others are the independent joints. With closed loops, they include the joints that only
    the loops determine.

    Raises:
        RobotError: If the independent joints do not determine the others, or loops do not close.
    """
    ties: dict[str, Tie] = {}
    for cluster, closure in zip(mechanism.tree.clusters, closures(mechanism), strict=True):
        if mechanism.robot.body(cluster.bodies[0]).joint.nv > 1:
            continue
        B, q0 = linear_solution(cluster) if closure is None else (closure.assembly.B, closure.assembly.q0)
        unknown = () if closure is None else closure.assembly.unknown
        arguments = [*cluster.independent, *(cluster.bodies[i] for i in unknown)]
        for name, row, offset in zip(cluster.bodies, B, q0, strict=True):
            ties[name] = Tie({y: float(x) for y, x in zip(arguments, row, strict=True) if x != 0.0}, float(offset))
    return {body.name: ties[body.name] for body in mechanism.robot.bodies if body.name in ties}
