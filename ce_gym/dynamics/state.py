"""The state of one robot from step to step, as named parts that force laws declare; and the outputs of a step."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from ce_gym.dynamics.algebra.spatial import SX


@dataclass(frozen=True)
class Field:
    """A part of the state of a robot.

    Attributes:
        name: Of the part, and of the buffer that holds it.
        size: How many numbers it has.
        unit: Of each.
        meaning: One line for readers.
        reset: Its value after a reset: zeros, or the normal forces of contacts at rest.
        explicit: Whether explicit methods can keep it: the law returns its rate, or it follows from the forces at the
            start of the step. Else explicit methods are refused.
    """

    name: str
    size: int
    unit: str
    meaning: str
    reset: Literal["zero", "resting_load"] = "zero"
    explicit: bool = False


@dataclass(frozen=True)
class Output:
    """A quantity that a step can report.

    Attributes:
        name: Of the output, and of its buffer.
        unit: Of each number.
        meaning: One line for readers.
        of: The moment that it belongs to: the start of the step, its end, or the mean over it.
    """

    name: str
    unit: str
    meaning: str
    of: Literal["start", "end", "mean"] = "end"

    def __str__(self) -> str:
        """Return meaning and unit."""
        return f"{self.meaning} [{self.unit}]"


class State:
    """Positions, velocities and the memory of force laws, by name.

    Args:
        parts: Columns by name; empty ones may be left out.
    """

    def __init__(self, parts: dict[str, SX]) -> None:
        self.parts = {name: value for name, value in parts.items() if value.numel()}

    @staticmethod
    def symbolic(fields: Iterable[Field]) -> State:
        """Return a state of fresh symbols."""
        return State({field.name: SX.sym(field.name, field.size) for field in fields})

    @property
    def q(self) -> SX:
        """Positions, shape (nq,)."""
        return self["q"]

    @property
    def v(self) -> SX:
        """Velocities, shape (nv,)."""
        return self["v"]

    @property
    def dependent(self) -> SX:
        """Guess of the dependent coordinates that are found by iteration, shape (n_guess,)."""
        return self["dependent"]

    def __getitem__(self, name: str) -> SX:
        """Return a part; a column of no entries if the scene does not have it."""
        return self.parts.get(name, SX(0, 1))

    def items(self) -> list[tuple[str, SX]]:
        """Return the parts by name, in the order of the fields."""
        return list(self.parts.items())

    def replaced(self, **parts: SX) -> State:
        """Return the state with other values of some parts; empty parts are ignored.

        Raises:
            KeyError: If the state has no such part.
        """
        if unknown := [name for name, value in parts.items() if value.numel() and name not in self.parts]:
            raise KeyError(unknown[0])
        return State({name: parts.get(name, value) for name, value in self.parts.items()})
