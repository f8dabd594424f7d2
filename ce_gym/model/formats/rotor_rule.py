"""One rule for URDF+ and MJCF that tells rotors from links.

Both formats write a rotor like any other link. The transmission levels treat *rotors* differently; at the exact level
the distinction has no effect.
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
    """Return the bodies with `kind="rotor"` for rotors.

    A rotor is a body

    - on a revolute joint with a `dependent` angle;
    - in linear constraints with bodies on other branches, never with its own carrier, and in no other kind of
      constraint;
    - that carries no other body;
    - symmetric about its axis, or with "rotor" or "motor" in its name. (The finger of a gripper is also coupled to
      its twin, but is not symmetric.)

    Args:
        bodies: Parents before children.
        constraints: The constraints among the bodies.
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
    """Return bodies in linear constraints that do not name the body's carrier, without bodies of loops."""
    parents = {body.name: body.parent for body in bodies}
    linear = [c for c in constraints if isinstance(c, LinearConstraint)]
    loops = {name for c in constraints if not c.linear for name in c.bodies}
    return {name for c in linear for name in c.bodies if parents.get(name) not in c.bodies} - loops
