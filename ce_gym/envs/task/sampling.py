"""Random numbers of a traced function.

A kernel fills a buffer with uniform numbers from a counter-based stream. While a function is traced, it draws numbers
one by one; their count is the size of the buffer.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX


class Sampler:
    """Uniform numbers in [0, 1), consumed in order."""

    def __init__(self) -> None:
        self._symbols: list[SX] = []

    @property
    def symbols(self) -> SX:
        """Symbols of all numbers drawn so far, an input of the traced function, shape (n,)."""
        return ca.vertcat(*self._symbols)

    def unit(self) -> SX:
        """Return one number in [0, 1)."""
        self._symbols.append(SX.sym(f"u{len(self._symbols)}"))
        return self._symbols[-1]

    def uniform(self, low: float, high: float) -> SX:
        """Return one number in [low, high)."""
        return low + (high - low) * self.unit()

    def symmetric(self, count: int, bound: float) -> SX:
        """Return independent numbers in [-bound, bound), shape (count,)."""
        return ca.vertcat(SX(0, 1), *[self.uniform(-bound, bound) for _ in range(count)])

    def within(self, ranges: Sequence[tuple[float, float]]) -> SX:
        """Return one number in each range, shape (len(ranges),)."""
        return ca.vertcat(*[self.uniform(low, high) for low, high in ranges])
