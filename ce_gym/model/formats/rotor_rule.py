"""Which bodies of a file that has no word for it are rotors? One rule for URDF+ and MJCF.

Both formats write a rotor as a link like any other. It matters which is which: transmission levels differ in what they
keep of *rotors*. At the exact level the answer changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from ce_gym.model.constraints import Constraint, LinearConstraint
from ce_gym.model.description import Body
from ce_gym.model.mechanism import is_axisymmetric

_NAMES = ("rotor", "motor")


def with_rotors(
    bodies: Iterable[Body], constraints: Iterable[Constraint], dependent: Iterable[str]
) -> tuple[Body, ...]:
    """Return the bodies with those that are rotors marked as such.

    A rotor is a body

    - that turns, and whose angle is one of the `dependent` ones;
    - that a linear constraint ties to bodies on other branches, never to its own carrier, and that no other kind of
      constraint holds;
    - that carries nothing;
    - that is symmetric about its axis, or whose name says "rotor" or "motor". (The finger of a gripper is tied to its
      twin by a coupling too, but is lopsided.)

    Args:
        bodies: Parents before children.
        constraints: What ties their joints together.
        dependent: Names of the bodies whose joint coordinates are not independent.
    """
    bodies, constraints, dependent = tuple(bodies), tuple(constraints), set(dependent)
    carriers = {body.parent for body in bodies}
    tied = _tied_across_branches(bodies, constraints)

    def is_rotor(body: Body) -> bool:
        moves_nothing = body.name not in carriers and body.joint.type == "revolute"
        looks_so = is_axisymmetric(body) or any(name in body.name.lower() for name in _NAMES)
        return body.name in dependent & tied and moves_nothing and looks_so

    return tuple(replace(body, kind="rotor") if is_rotor(body) else body for body in bodies)


def _tied_across_branches(bodies: tuple[Body, ...], constraints: tuple[Constraint, ...]) -> set[str]:
    """Names in linear constraints that do not name the body's carrier, less those that are part of a loop."""
    parents = {body.name: body.parent for body in bodies}
    linear = [c for c in constraints if isinstance(c, LinearConstraint)]
    loops = {name for c in constraints if not c.linear for name in c.bodies}
    return {name for c in linear for name in c.bodies if parents.get(name) not in c.bodies} - loops
