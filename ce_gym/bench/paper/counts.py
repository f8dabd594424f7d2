"""Our instruction counts on the paper's systems, beside those on file, and what follows: slopes, crossovers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from ce_gym.bench.paper.reference import ChainReference, RobotReference, chain_references, robot_references
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot, generators, load_robot, robots

Generator = Callable[[int, int], Robot]

BRANCHED: dict[str, Generator] = {
    "link_and_rotor": generators.link_and_rotor_chain,
    "belt_pair": generators.belt_pair_chain,
    "four_bar": generators.four_bar_chain,
}
PARALLEL: dict[str, Generator] = {
    "transmission_parallel": generators.transmission_parallel_chain,
    "rod_parallel": generators.rod_parallel_chain,
}
VARIANTS: dict[str, dict[str, Any]] = {
    "exact": {},
    "general": {"eliminate_rotors": False},
    "armature": {"transmission": "armature", "locked_rotors": False},
    "none": {"transmission": "none", "locked_rotors": False},
}
"""Ways to make a model: exact; the same with every rotor a body; the paper's two approximations, rotors deleted."""


@dataclass(frozen=True)
class ChainCount:
    """One chain: what others take, and what we take in each variant."""

    reference: ChainReference
    ours: dict[str, int]


@dataclass(frozen=True)
class RobotCount:
    """One robot: what others take, and what we take in each variant."""

    robot: str
    reference: RobotReference
    ours: dict[str, int]


def count(robot: Robot, variant: str) -> int:
    """Return the instructions of forward dynamics."""
    return Model(robot, **VARIANTS[variant]).n_instructions("forward_dynamics")


def branched_counts(branches: Iterable[int], depth: int) -> list[ChainCount]:
    """Count branched chains with the given numbers of branches and up to a depth."""
    wanted = set(branches)
    return [
        _chain_count(reference, BRANCHED[reference.chain](reference.branches or 1, reference.depth))
        for reference in chain_references()
        if reference.chain in BRANCHED and reference.branches in wanted and reference.depth <= depth
    ]


def parallel_counts(depths: Iterable[int]) -> list[ChainCount]:
    """Count parallel chains of the given depths, loops of every size on file."""
    wanted = set(depths)
    return [
        _chain_count(reference, PARALLEL[reference.chain](reference.depth, reference.loop_size or 0))
        for reference in chain_references()
        if reference.chain in PARALLEL and reference.depth in wanted
    ]


def robot_counts() -> list[RobotCount]:
    """Count every robot of the package that somebody else has counted."""
    shipped = set(robots())
    return [
        RobotCount(name, reference, _counts(load_robot(name)))
        for name, reference in robot_references().items()
        if name in shipped
    ]


def increments(counts: Sequence[int]) -> list[int]:
    """Return what each unit adds beyond the second: the first is special, it sits on the base."""
    return [after - before for before, after in pairwise(counts[1:])]


def crossover(sizes: Sequence[int], ours: Sequence[int], theirs: Sequence[int]) -> float | None:
    """Return the loop size at which we begin to take more than they do; None if we never do.

    Between measured sizes counts are taken to be powers of the size: straight lines on logarithmic axes.
    """
    logs = [math.log(a / b) for a, b in zip(ours, theirs, strict=True)]
    if logs[0] > 0.0:
        return float(sizes[0])
    for i in range(1, len(logs)):
        if logs[i] > 0.0:
            part = -logs[i - 1] / (logs[i] - logs[i - 1])
            return sizes[i - 1] * (sizes[i] / sizes[i - 1]) ** part
    return None


def _chain_count(reference: ChainReference, robot: Robot) -> ChainCount:
    return ChainCount(reference, _counts(robot))


def _counts(robot: Robot) -> dict[str, int]:
    """Without rotors, all variants are the exact one."""
    names = VARIANTS if any(robot.rotors()) else ("exact",)
    return {name: count(robot, name) for name in names}
