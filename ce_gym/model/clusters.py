"""The cluster tree: groups of bodies that the recursions treat together because constraints couple their joints.

A constraint on the *joints* of some bodies groups these bodies and all bodies between them. Take the nearest common
ancestor of their parents: each body on the paths from the ancestor (exclusive) to the constrained bodies (inclusive)
belongs to the cluster. A closed loop or rod constrains the *bodies* themselves. Its paths start at the nearest common
ancestor of the bodies, which may be an end of the loop. Clusters that share a body are merged. Examples, as in the
paper's figure 3:

- a link and its rotor on the same parent form one cluster;
- a belt (knee, ankle on the knee, both rotors on the thigh) forms one cluster of four;
- a constraint between a body and its grandchild includes the body between;
- a loop nested in another, or two loops through one body, form one cluster.

All base bodies of a cluster are attached to one output body, as the recursive algorithms need. For one constraint this
holds by construction. If two clusters share a body, both output bodies are its ancestors, so one output body is a
member of the other cluster, and the union keeps the output body of that cluster. Output bodies are strictly nearer to
the root than their clusters, so clusters form a tree.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from ce_gym.model.constraints import Constraint
from ce_gym.model.description import Robot
from ce_gym.model.errors import invalid_value


@dataclass(frozen=True)
class Cluster:
    """Bodies with coupled joints, or one body without constraints.

    Attributes:
        bodies: Names, parents before children.
        constraints: The constraints among the bodies.
        independent: Bodies of the cluster with independent joint coordinates, in the robot's order; empty for the
            cluster of a floating base or of a ball joint.
        parent: Index of the parent cluster; None for the world.
        output_body: Body of the parent cluster to which all base bodies of this cluster are attached; None for the
            world.
    """

    bodies: tuple[str, ...]
    constraints: tuple[Constraint, ...]
    independent: tuple[str, ...]
    parent: int | None
    output_body: str | None

    @property
    def linear(self) -> bool:
        """Whether all constraints are linear."""
        return all(constraint.linear for constraint in self.constraints)


@dataclass(frozen=True)
class ClusterTree:
    """The clusters of a robot, parents before children, otherwise in the order of their first bodies."""

    clusters: tuple[Cluster, ...]

    def base_to_tip(self) -> Iterable[int]:
        """Indices of the clusters, parents before children."""
        return range(len(self.clusters))

    def tip_to_base(self) -> Iterable[int]:
        """Indices of the clusters, children before parents."""
        return reversed(range(len(self.clusters)))

    def cluster_of(self, body: str) -> int:
        """Return the index of the cluster that contains `body`; KeyError without such a body."""
        for index, cluster in enumerate(self.clusters):
            if body in cluster.bodies:
                return index
        raise KeyError(f"no cluster holds a body called {body!r}")

    def as_text(self) -> str:
        """Return a drawing of the tree, one cluster a line; `*` marks independent joints."""
        return "\n".join(["world", *self._lines(None, "")])

    def _lines(self, parent: int | None, indent: str) -> Iterator[str]:
        children = [i for i, cluster in enumerate(self.clusters) if cluster.parent == parent]
        for i in children:
            last = i == children[-1]
            yield f"{indent}{'└── ' if last else '├── '}{_label(self.clusters[i])}"
            yield from self._lines(i, indent + ("    " if last else "│   "))


def _label(cluster: Cluster) -> str:
    return " + ".join(f"{body}*" if body in cluster.independent else body for body in cluster.bodies)


def cluster_tree(robot: Robot) -> ClusterTree:
    """Group the bodies of `robot` into clusters.

    Raises:
        RobotError: A constraint reaches across a free joint or a ball joint.
    """
    parents = {body.name: body.parent for body in robot.bodies}
    spans = [_constraint_span(constraint, parents, robot) for constraint in robot.constraints]
    groups = _merged([[name] for name in parents] + spans)
    order = {name: i for i, name in enumerate(parents)}
    # Bodies are listed parents before children, so this order puts a cluster behind the one that carries it.
    members = sorted((sorted(group, key=order.__getitem__) for group in groups), key=lambda group: order[group[0]])
    index_of = {body: i for i, group in enumerate(members) for body in group}
    ties: list[list[Constraint]] = [[] for _ in members]
    for constraint, span in zip(robot.constraints, spans, strict=True):
        ties[index_of[span[0]]].append(constraint)
    return ClusterTree(
        tuple(_cluster(robot, group, tuple(tie), parents, index_of) for group, tie in zip(members, ties, strict=True))
    )


def _ancestors(body: str | None, parents: dict[str, str | None]) -> list[str | None]:
    """Return `body` and its ancestors out to the world (None), nearest first."""
    chain: list[str | None] = [body]
    while chain[-1] is not None:
        chain.append(parents[chain[-1]])
    return chain


def _constraint_span(constraint: Constraint, parents: dict[str, str | None], robot: Robot) -> list[str]:
    """Return the bodies of the cluster of one constraint."""
    if not constraint.ends:
        return _between(constraint.bodies, [parents[body] for body in constraint.bodies], parents)
    span = _between(constraint.ends, constraint.ends, parents)
    if not span:
        key = f"constraint {constraint.name!r}"
        expected = "two bodies that can move against each other"
        raise invalid_value(robot.source or robot.name, key, constraint.ends, expected)
    return span


def _between(tied: Sequence[str | None], below: Sequence[str | None], parents: dict[str, str | None]) -> list[str]:
    """Return the bodies on the paths to `tied` from the nearest common ancestor of `below`, without the ancestor."""
    above = [_ancestors(body, parents) for body in below]
    common = next(a for a in above[0] if all(a in chain for chain in above))
    chains = [_ancestors(body, parents) for body in tied]
    return [member for chain in chains for member in chain[: chain.index(common)] if member is not None]


def _merged(groups: Iterable[Iterable[str]]) -> list[set[str]]:
    """Merge the groups that share a member."""
    merged: list[set[str]] = []
    for group in groups:
        new = set(group)
        apart = [other for other in merged if other.isdisjoint(new)]
        for other in merged:
            if not other.isdisjoint(new):
                new |= other
        merged = [*apart, new]
    return merged


def _cluster(
    robot: Robot,
    group: list[str],
    ties: tuple[Constraint, ...],
    parents: dict[str, str | None],
    index_of: dict[str, int],
) -> Cluster:
    members = [body for body in robot.bodies if body.name in group]
    free = [body for body in members if body.joint.nv > 1]
    if free and ties:
        names = ", ".join(constraint.name for constraint in ties)
        expected = f"a tie that does not reach across the {free[0].joint.type} joint of {free[0].name}"
        if free[0].joint.type == "ball":
            expected += ", which must be three revolute joints in a loop (ce_gym.model.coincident_hinges)"
        raise invalid_value(robot.source or robot.name, f"constraint {names}", tuple(group), expected)
    output = parents[group[0]]
    return Cluster(
        bodies=tuple(group),
        constraints=ties,
        independent=tuple(name for name in robot.independent if name in group),
        parent=None if output is None else index_of[output],
        output_body=output,
    )
