"""The coordinates of joints in `q` and `v`; `nq` is larger than `nv` because free and ball joints have a quaternion.

    q = [base position, base quaternion, quaternions of ball joints, joints with one coordinate]
    v = [base angular, base linear, angular velocities of ball joints, joints with one coordinate]

Quaternions are (w, x, y, z), child to parent. Angular velocities are in the axes of the moving body.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

UNIT_TOLERANCE = 1e-3
"""Largest difference from 1 of the norm of an input quaternion."""
UNIT_ROUNDING = 16
"""Quaternions within so many machine epsilons of unit length keep their bits."""
SIZES: dict[str, tuple[int, int]] = {"free": (7, 6), "ball": (4, 3)}
"""Number of positions and of velocities, by type of joint; other types have one of each."""


@dataclass(frozen=True)
class Layout:
    """The rows of each kind of joint in `q` and `v`.

    Attributes:
        floating: Whether the base is free.
        balls: Number of ball joints.
        joints: Number of independent joints with one coordinate.
    """

    floating: bool
    balls: int
    joints: int

    @property
    def base_nq(self) -> int:
        """Number of positions of the base, 7 if it is floating (position and quaternion) or none."""
        return SIZES["free"][0] if self.floating else 0

    @property
    def base_nv(self) -> int:
        """Number of velocities of the base."""
        return SIZES["free"][1] if self.floating else 0

    @property
    def joints_q(self) -> int:
        """First row of `q` of joints with one coordinate."""
        return self.base_nq + SIZES["ball"][0] * self.balls

    @property
    def joints_v(self) -> int:
        """First row of `v` of joints with one coordinate."""
        return self.base_nv + SIZES["ball"][1] * self.balls

    @property
    def nq(self) -> int:
        """Number of positions."""
        return self.joints_q + self.joints

    @property
    def nv(self) -> int:
        """Number of velocities."""
        return self.joints_v + self.joints

    @property
    def ball_turns(self) -> tuple[tuple[int, int], ...]:
        """First rows in `q` and in `v` of each ball joint."""
        (nq, nv), first_q, first_v = SIZES["ball"], self.base_nq, self.base_nv
        return tuple((first_q + nq * i, first_v + nv * i) for i in range(self.balls))

    @property
    def turns(self) -> tuple[tuple[int, int], ...]:
        """First rows in `q` of each quaternion, the base's first, and in `v` of its angular velocity."""
        return (((3, 0),) if self.floating else ()) + self.ball_turns


def sizes(kind: str) -> tuple[int, int]:
    """Return the number of positions and of velocities of a type of joint."""
    return SIZES.get(kind, (1, 1))


def placed(joints: Iterable[tuple[str, str]]) -> dict[str, tuple[range, range]]:
    """Return the rows in `q` and in `v` of joints one after the other, given as pairs (name, type)."""
    rows, first_q, first_v = {}, 0, 0
    for name, kind in joints:
        nq, nv = sizes(kind)
        rows[name] = range(first_q, first_q + nq), range(first_v, first_v + nv)
        first_q, first_v = first_q + nq, first_v + nv
    return rows


def unit_quaternions(q: NDArray, first: Iterable[int], name: str = "q", dtype: DTypeLike = np.float64) -> NDArray:
    """Return rows with quaternions scaled to unit length.

    Quaternions of unit length to rounding keep their bits, and so do quaternions that are not a number.

    Args:
        q: Rows with quaternions of nearly unit length, shape (..., n).
        first: Columns at which quaternions (w, x, y, z) begin.
        name: Name of the rows in error messages.
        dtype: Type whose machine epsilon is the unit of rounding.

    Raises:
        ValueError: The norm of a quaternion is not within `UNIT_TOLERANCE` of 1.
    """
    rounding, result = UNIT_ROUNDING * np.finfo(dtype).eps, q
    for i in first:
        norm = np.linalg.norm(np.asarray(q[..., i : i + 4], float), axis=-1)
        off = np.abs(norm - 1)
        if (wrong := off > UNIT_TOLERANCE).any():
            place = tuple(int(j) for j in np.argwhere(wrong)[0])
            entry = "".join(f"{j}, " for j in place) + f"{i}:{i + 4}"
            expected = f"a quaternion (w, x, y, z) of norm 1 within {UNIT_TOLERANCE:g}"
            raise ValueError(f"{name}[{entry}] has norm {norm[place]:.4g}; expected {expected}: divide it by its norm")
        if (scaled := off > rounding).any():
            result = np.array(result, float) if result is q else result
            result[scaled, i : i + 4] /= norm[scaled, None]
    return result
