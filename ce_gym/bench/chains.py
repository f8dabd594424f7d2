"""Robots of any size: the scaling chains of the constraint-embedding paper.

Two families, both planar about z. *Branched chains* hang on a floating base: several equal branches, each a row of
equal units (a link with its rotor, a pair of links with two belts, a four-bar). *Parallel chains* stand on the ground
and are tied together at one depth, so that the tie makes a cluster as large as one likes. Where a chain has closed
loops, its standing pose and assembly close them away from singularities.

Source of the rules and figures: Chignoli, Adrian, Kim, Wensing, arXiv:2311.13732, and the authors' library
ROAM-Lab-ND/generalized_rbda 45fa7c4, Benchmarking/urdfs/*.xacro. Rotors have no mass there, so deleting them and
locking them differ only by their inertia at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ce_gym.model.constraints import Constraint, LinearConstraint, LoopConstraint
from ce_gym.model.description import Body, Inertial, Joint, Pose, Robot
from ce_gym.model.errors import invalid_value
from ce_gym.model.frames import Placement, Vec3

GEAR_RATIO = 6.0
BASE = "base"
ABOUT_Z = Joint("revolute", (0.0, 0.0, 1.0))
AT_END: Vec3 = (1.0, 0.0, 0.0)


def _inertial(mass: float, com: Vec3, ixx: float, iyy: float, izz: float) -> Inertial:
    return Inertial(mass, com, ((ixx, 0.0, 0.0), (0.0, iyy, 0.0), (0.0, 0.0, izz)))


BASE_INERTIAL = _inertial(5.0, (0.0, 0.0, 0.0), 0.1, 0.1, 0.1)
LINK = _inertial(1.0, (0.5, 0.0, 0.0), 1.0, 1.0, 1.0)
ROTOR = _inertial(0.0, (0.0, 0.0, 0.0), 1e-4, 1e-4, 1e-4)
BAR = _inertial(3.3, (0.0, 0.0, 0.0), 0.011253, 0.036203, 0.042673)
CRANK_ANGLE = 1.0
"""Standing pose of a four-bar's crank [rad]; at zero all of its bars lie on one line, a singularity."""
PARALLEL_LINK = _inertial(0.25, (0.0, 0.5, 0.0), 0.01, 0.1, 0.01)


@dataclass(frozen=True)
class Unit:
    """One unit of a branch.

    Attributes:
        bodies: Parents before children.
        constraints: Ties among them.
        independent: Bodies whose joint coordinates are independent.
        tip: The body that carries the next unit.
        pose: Pairs (independent body, standing angle) where it is not zero [rad].
        assembly: Pairs (dependent body, standing angle) of closed loops [rad].
    """

    bodies: tuple[Body, ...]
    constraints: tuple[Constraint, ...]
    independent: tuple[str, ...]
    tip: str
    pose: tuple[tuple[str, float], ...] = ()
    assembly: tuple[tuple[str, float], ...] = ()


def link_and_rotor_chain(branches: int, depth: int) -> Robot:
    """Return branches of links, each driven by a geared rotor on its parent.

    Args:
        branches: Number of equal branches on the floating base, at least 1.
        depth: Number of links in each branch, at least 1.

    Raises:
        RobotError: A number is too small.
    """
    return _branched("link_and_rotor", branches, depth, _link_and_rotor)


def belt_pair_chain(branches: int, depth: int) -> Robot:
    """Return branches of pairs of links, both driven from the parent of the pair; a belt couples the second to both.

    Args:
        branches: Number of equal branches on the floating base, at least 1.
        depth: Number of pairs in each branch, at least 1.

    Raises:
        RobotError: A number is too small.
    """
    return _branched("belt_pair", branches, depth, _belt_pair)


def four_bar_chain(branches: int, depth: int) -> Robot:
    """Return branches of parallelogram four-bars, each driven by its crank and carried by the rocker before it.

    Args:
        branches: Number of equal branches on the floating base, at least 1.
        depth: Number of four-bars in each branch, at least 1.

    Raises:
        RobotError: A number is too small.
    """
    return _branched("four_bar", branches, depth, _four_bar)


def transmission_parallel_chain(depth: int, loop_size: int) -> Robot:
    """Return two parallel chains whose summed angles are equal down to one depth: an explicit, linear tie.

    Args:
        depth: Number of links in each chain, at least 1.
        loop_size: Number of bodies tied together; even, from 2 to `2 * depth`.

    Raises:
        RobotError: A number is too small or too large.
    """
    name = f"transmission_parallel_d{depth}_l{loop_size}"
    _require(name, "depth", depth, depth >= 1, "at least 1")
    _require(name, "loop_size", loop_size, loop_size in range(2, 2 * depth + 1, 2), f"even, from 2 to {2 * depth}")
    tied = loop_size // 2
    first, second = _parallel_chain(1, depth, (0.0, 0.0, 0.0)), _parallel_chain(2, depth, (0.0, 0.0, 0.0))
    coefficients = [(body.name, 1.0) for body in first[:tied]] + [(body.name, -1.0) for body in second[:tied]]
    bodies = tuple(body for pair in zip(first, second, strict=True) for body in pair)
    independent = tuple(body.name for body in bodies if body is not second[tied - 1])
    return Robot(name, bodies, (LinearConstraint("transmission", tuple(coefficients)),), independent)


def rod_parallel_chain(depth: int, loop_size: int) -> Robot:
    """Return two parallel chains joined at one depth by a connecting rod: a closed loop, an implicit tie.

    Args:
        depth: Number of links in each chain, at least 1.
        loop_size: Number of bodies in the loop, the rod included; odd, from 3 to `2 * depth + 1`.

    Raises:
        RobotError: A number is too small or too large.
    """
    name = f"rod_parallel_d{depth}_l{loop_size}"
    _require(name, "depth", depth, depth >= 1, "at least 1")
    _require(name, "loop_size", loop_size, loop_size in range(3, 2 * depth + 2, 2), f"odd, from 3 to {2 * depth + 1}")
    tied = loop_size // 2
    first, second = _parallel_chain(1, depth, (0.0, 0.0, 0.0)), _parallel_chain(2, depth, (1.0, 0.0, 0.0))
    rod = _body("connecting_rod", first[tied - 1].name, (0.0, 1.0, 0.0), PARALLEL_LINK)
    loop = _pin("loop", rod, (1.0, 0.0, 0.0), second[tied - 1], (0.0, 1.0, 0.0))
    links = [body for pair in zip(first, second, strict=True) for body in pair]
    independent = tuple(body.name for body in links if body is not second[0])
    return Robot(name, (*links[: 2 * tied], rod, *links[2 * tied :]), (loop,), independent)


def _branched(kind: str, branches: int, depth: int, unit: Callable[[str, str], Unit]) -> Robot:
    """Hang `branches` rows of `depth` units on a floating base; bodies go branch by branch, base to tip."""
    name = f"{kind}_b{branches}_d{depth}"
    _require(name, "branches", branches, branches >= 1, "at least 1")
    _require(name, "depth", depth, depth >= 1, "at least 1")
    units: list[Unit] = []
    for branch in range(1, branches + 1):
        parent = BASE
        for level in range(1, depth + 1):
            units.append(unit(f"{branch}_{level}", parent))
            parent = units[-1].tip
    base = Body(BASE, "link", None, Placement(), Joint("free"), BASE_INERTIAL)
    return Robot(
        name,
        (base, *(body for unit in units for body in unit.bodies)),
        tuple(constraint for unit in units for constraint in unit.constraints),
        tuple(joint for unit in units for joint in unit.independent),
        pose=Pose(joints=tuple(pair for unit in units for pair in unit.pose)),
        assembly=tuple(pair for unit in units for pair in unit.assembly),
    )


def _link_and_rotor(label: str, parent: str) -> Unit:
    link = _body(f"link_{label}", parent, AT_END, LINK)
    rotor = _rotor(f"rotor_{label}", parent)
    gear = LinearConstraint(f"gear_{label}", ((rotor.name, 1.0), (link.name, -GEAR_RATIO)))
    return Unit((link, rotor), (gear,), (link.name,), link.name)


def _belt_pair(label: str, parent: str) -> Unit:
    first = _body(f"link_{label}a", parent, AT_END, LINK)
    second = _body(f"link_{label}b", first.name, AT_END, LINK)
    rotors = _rotor(f"rotor_{label}a", parent), _rotor(f"rotor_{label}b", parent)
    gear = LinearConstraint(f"gear_{label}", ((rotors[0].name, 1.0), (first.name, -GEAR_RATIO)))
    belt = LinearConstraint(
        f"belt_{label}", ((rotors[1].name, 1.0), (first.name, -GEAR_RATIO), (second.name, -GEAR_RATIO))
    )
    return Unit((first, *rotors, second), (gear, belt), (first.name, second.name), second.name)


def _four_bar(label: str, parent: str) -> Unit:
    rocker = _body(f"rocker_{label}", parent, (1.0, 0.0, 0.0), BAR)
    crank = _body(f"crank_{label}", parent, (0.0, 0.0, 0.0), BAR)
    coupler = _body(f"coupler_{label}", crank.name, (0.5, 0.0, 0.0), BAR)
    loop = _pin(f"loop_{label}", rocker, (0.5, 0.0, 0.0), coupler, (1.0, 0.0, 0.0))
    return Unit(
        (rocker, crank, coupler),
        (loop,),
        (crank.name,),
        rocker.name,
        pose=((crank.name, CRANK_ANGLE),),
        assembly=((rocker.name, CRANK_ANGLE), (coupler.name, -CRANK_ANGLE)),
    )


def _pin(name: str, first: Body, first_point: Vec3, second: Body, second_point: Vec3) -> LoopConstraint:
    """Join two bodies by a pin about z."""
    return LoopConstraint(name, "revolute", first.name, second.name, Placement(first_point), Placement(second_point))


def _parallel_chain(chain: int, depth: int, root: Vec3) -> list[Body]:
    parents = [None, *(f"link_{chain}_{level}" for level in range(1, depth))]
    positions = [root, *[(0.0, 1.0, 0.0)] * (depth - 1)]
    return [
        _body(f"link_{chain}_{level}", parent, position, PARALLEL_LINK)
        for level, (parent, position) in enumerate(zip(parents, positions, strict=True), start=1)
    ]


def _body(name: str, parent: str | None, position: Vec3, inertial: Inertial) -> Body:
    return Body(name, "link", parent, Placement(position), ABOUT_Z, inertial)


def _rotor(name: str, parent: str) -> Body:
    return Body(name, "rotor", parent, Placement(AT_END), ABOUT_Z, ROTOR)


def _require(name: str, key: str, value: int, met: bool, expected: str) -> None:
    if not met:
        raise invalid_value(name, key, value, expected)
