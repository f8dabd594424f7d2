"""What ties joint coordinates or bodies together: the kinds of constraints, frozen data.

Functions that users register are known here by name. A description holds the name only, so that it stays plain data;
the dynamics calls the functions with CasADi expressions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from ce_gym.model.errors import RobotError
from ce_gym.model.frames import ORIGIN, Placement, Vec3
from ce_gym.model.ranges import Finite, Positive


@dataclass(frozen=True)
class Constraint:
    """Base class of constraints; each kind has data here, and checks, a residual and a reader in other files.

    Attributes:
        name: Name for messages.
        linear: Whether the constraint is linear in joint coordinates.
    """

    name: str
    linear: ClassVar[bool] = False

    @property
    def ends(self) -> tuple[str | None, ...]:
        """The bodies of a loop or rod, None for the world; empty if the constraint is between joint coordinates."""
        return ()

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the constrained bodies, or of the bodies with constrained joint coordinates; not the world."""
        return tuple(body for body in self.ends if body is not None)


@dataclass(frozen=True)
class LinearConstraint(Constraint):
    """`sum(coefficient * angle of body) = offset`: gears, belts, planetary stages, averaging differentials.

    A gear of ratio N between a rotor and a link is `{rotor: 1, link: -N}`.

    Attributes:
        coefficients: Pairs (body, coefficient), at least two, none zero.
        offset: Right-hand side [rad or m].
    """

    coefficients: tuple[tuple[str, float], ...]
    offset: Annotated[Finite, "rad or m"] = 0.0
    linear: ClassVar[bool] = True

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies whose joint coordinates the constraint ties together."""
        return tuple(body for body, _ in self.coefficients)


@dataclass(frozen=True)
class PolynomialConstraint(Constraint):
    """`coordinate of dependent = sum(coefficients[k] * (coordinate of argument)^k)`: a joint that follows on a cam.

    Either of the two may be the independent joint.

    Attributes:
        dependent: Body whose joint coordinate is the polynomial.
        argument: Body whose joint coordinate is its argument.
        coefficients: By ascending power, in units of the dependent coordinate over powers of the other's.
    """

    dependent: str
    argument: str
    coefficients: tuple[float, ...]

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies whose joint coordinates the constraint ties together."""
        return (self.dependent, self.argument)


@dataclass(frozen=True)
class LoopConstraint(Constraint):
    """A joint that closes a loop: a frame on one body and a frame on another share their origin, and perhaps an axis.

    Attributes:
        joint: "revolute" shares origin and axis (5 rows, of which a planar loop needs 2); "ball" only the origin (3).
        first: A body, or None for the world.
        second: Another body, or None for the world.
        first_placement: Pose of the joint frame in `first`.
        second_placement: Pose of the joint frame in `second`.
        axis: Unit axis of a revolute joint in the joint frame.
    """

    joint: Literal["revolute", "ball"]
    first: str | None
    second: str | None
    first_placement: Placement = ORIGIN
    second_placement: Placement = ORIGIN
    axis: Vec3 = (0.0, 0.0, 1.0)

    @property
    def ends(self) -> tuple[str | None, ...]:
        """The two bodies, None for the world."""
        return (self.first, self.second)


@dataclass(frozen=True)
class RodConstraint(Constraint):
    """A massless rod with ball joints at its ends: a point of one body keeps its distance from a point of another.

    Attributes:
        first: A body, or None for the world.
        second: Another body, or None for the world.
        first_point: Where the rod ends on `first` [m].
        second_point: Where the rod ends on `second` [m].
        length: [m].
    """

    first: str | None
    second: str | None
    first_point: Vec3
    second_point: Vec3
    length: Annotated[Positive, "m"]

    @property
    def ends(self) -> tuple[str | None, ...]:
        """The two bodies, None for the world."""
        return (self.first, self.second)


@dataclass(frozen=True)
class FunctionConstraint(Constraint):
    """A function of joint coordinates that a user registered under a name, see `register_constraint`.

    With `dependent` empty the function is implicit, `phi(coordinates of arguments) = 0`; otherwise it is explicit,
    `coordinates of dependent = gamma(coordinates of arguments)`.

    Attributes:
        function: Name under which the function is registered.
        arguments: Bodies whose joint coordinates are its arguments, in order.
        dependent: Bodies whose joint coordinates an explicit function returns, in order.
    """

    function: str
    arguments: tuple[str, ...]
    dependent: tuple[str, ...] = ()

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies whose joint coordinates the constraint ties together."""
        return (*self.dependent, *self.arguments)


ConstraintFunction = Callable[[Sequence[Any]], Sequence[Any]]

_functions: dict[str, ConstraintFunction] = {}


def register_constraint(name: str, function: ConstraintFunction) -> None:
    """Make a function available to `FunctionConstraint` under a name.

    Args:
        name: The name; registering it again with another function replaces it for models built later.
        function: Takes a sequence of joint coordinates (CasADi SX scalars) [rad or m] and returns a sequence of
            expressions: residuals `phi` that vanish, or coordinates `gamma` of dependent joints.
    """
    _functions[name] = function


def constraint_function(name: str) -> ConstraintFunction:
    """Return the function registered under `name`.

    Raises:
        RobotError: No function has this name.
    """
    if name not in _functions:
        known = ", ".join(sorted(_functions)) or "there are none"
        raise RobotError(f"constraint function {name!r}: expected a registered function ({known}); register_constraint")
    return _functions[name]
