"""`Terrain`: ground that is not flat, as a grid of heights with a smooth surface over it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.compile.system import check_memory
from ce_gym.model.arguments import check, check_whole, is_number
from ce_gym.sim.terrain.files import read_heights

HIGHEST = 1e4
"""Largest height of random ground and of a step [m]."""
BYTES = 40.0
"""Memory for each height while a field is made, with its coordinates and copies [bytes]."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """A height field.

    The surface is the biquadratic B-spline with the heights as control values. Slopes are continuous, planes are
    exact, and every point lies between the heights around it; edges are rounded over a cell. Beyond the outermost
    heights the surface is extrapolated linearly. It is level there if the two outermost rows or columns are equal, as
    in all constructors but `slope`.

    Attributes:
        heights: Shape (rows, columns), 3 or more of each [m]. Entry (i, j) is the height at
            `(origin[0] + i cell, origin[1] + j cell)`.
        cell: Distance of neighbouring heights along x and along y [m].
        origin: Place (x, y) of the first height [m].

    Raises:
        ValueError: If a number is out of range or the heights have another shape.

    Examples:
        Before, in the middle of and after five steps of 10 cm:

        >>> stairs = ce_gym.Terrain.stairs(rise=0.1, tread=0.3, count=5, start=1.0)
        >>> print(stairs.at([0.0, 1.75, 9.0], 0.0)[:, 0].round(3))
        [0.  0.3 0.5]
    """

    heights: NDArray
    cell: float
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        kind = np.asarray(self.heights).dtype
        check("heights", kind.name, kind.kind in "fiu", "an array of real numbers")
        heights = np.array(self.heights, dtype=float, order="C")
        if heights.ndim != 2 or min(heights.shape) < 3:
            raise ValueError(f"heights has shape {heights.shape}; expected (rows, columns), 3 or more of each")
        if not _finite(heights):
            raise ValueError("heights holds a number that is not finite")
        check("cell", self.cell, _positive(self.cell), "a length above 0 m")
        origin = np.asarray(self.origin, dtype=float)
        check("origin", self.origin, origin.shape == (2,) and _finite(origin), "two finite numbers")
        heights.flags.writeable = False
        object.__setattr__(self, "heights", heights)
        object.__setattr__(self, "cell", float(self.cell))
        object.__setattr__(self, "origin", (float(origin[0]), float(origin[1])))

    def __repr__(self) -> str:
        rows, columns = self.heights.shape
        return f"Terrain({rows} x {columns} heights, cell={self.cell}, origin={self.origin})"

    @classmethod
    def flat(cls) -> Terrain:
        """Return the plane z = 0 as a field. A simulator without terrain has the same ground and is faster."""
        return cls(np.zeros((3, 3)), 1.0)

    @classmethod
    def slope(cls, angle: float, heading: float = 0.0) -> Terrain:
        """Return an endless inclined plane through the world's origin.

        Args:
            angle: Inclination [rad], below a right angle.
            heading: Direction in which it rises, from x towards y [rad].
        """
        check("angle", angle, abs(angle) < np.pi / 2, "less than a right angle")
        check("heading", heading, _finite(heading), "a finite angle")
        x, y = np.meshgrid(*[np.array([-1.0, 0.0, 1.0])] * 2, indexing="ij")
        return cls(np.tan(angle) * (np.cos(heading) * x + np.sin(heading) * y), 1.0, (-1.0, -1.0))

    @classmethod
    def rough(cls, seed: int, amplitude: float, cell: float = 0.1, size: float = 20.0) -> Terrain:
        """Return a square of random ground around the world's origin.

        Args:
            seed: Seed of the heights.
            amplitude: Heights are drawn uniformly from `-amplitude` to `amplitude` [m].
            cell: Distance of the heights [m].
            size: Side of the square [m].
        """
        check_whole("seed", seed, 0)
        check(
            "amplitude",
            amplitude,
            is_number(amplitude) and 0 <= amplitude <= HIGHEST,
            f"a length from 0 to {HIGHEST:g} m",
        )
        draw = np.random.default_rng(seed).uniform
        return cls.from_function(lambda x, _: draw(-amplitude, amplitude, x.shape), cell, size)

    @classmethod
    def stairs(cls, rise: float, tread: float, count: int, start: float = 1.0, cell: float = 0.02) -> Terrain:
        """Return stairs that rise along x, level before and after, endless along y.

        Args:
            rise: Height of one step [m]; below 0 they descend.
            tread: Length of one step [m].
            count: Number of steps.
            start: Where the first step rises [m].
            cell: Distance of the heights [m]; a step rises over a length of two.
        """
        check("rise", rise, is_number(rise) and abs(rise) <= HIGHEST, f"a height, at most {HIGHEST:g} m in size")
        check_whole("count", count, 1)
        check("start", start, _finite(start), "a finite place")
        check("cell", cell, _positive(cell), "a length above 0 m")
        check("tread", tread, _finite(tread) and tread >= 2 * cell, "at least two cells")
        check_memory(f"count={count}", BYTES * 3.0 * count * (tread / cell))
        # Half a cell off, so that the first step rises about its place.
        rows = np.arange(-2, np.ceil((count - 1) * tread / cell) + 3)
        heights = rise * np.clip(np.floor((rows + 0.5) * cell / tread) + 1, 0, count)
        return cls(np.repeat(heights[:, None], 3, axis=1), cell, (start - 1.5 * cell, -cell))

    @classmethod
    def from_function(
        cls,
        function: Callable[[NDArray, NDArray], ArrayLike],
        cell: float,
        size: float,
        centre: tuple[float, float] = (0.0, 0.0),
    ) -> Terrain:
        """Return a square of ground, level beyond.

        Args:
            function: Height [m] from arrays of x and y [m], both shape (n, n).
            cell: Distance of the heights [m].
            size: Side of the square [m], at least two cells.
            centre: Place (x, y) of its middle [m].
        """
        check("cell", cell, _positive(cell), "a length above 0 m")
        check("size", size, _finite(size) and size >= 2 * cell, "at least two cells")
        check_memory(f"size={size:g}, cell={cell:g}", BYTES * (float(size) / cell) * (float(size) / cell))
        half = round(size / cell) / 2 * cell
        along = np.linspace(-half, half, round(size / cell) + 1)
        x, y = np.meshgrid(centre[0] + along, centre[1] + along, indexing="ij")
        heights = np.asarray(function(x, y), dtype=float)
        if heights.shape not in ((), x.shape):
            raise ValueError(f"function returns shape {heights.shape}; expected {x.shape}")
        level = np.pad(np.broadcast_to(heights, x.shape), 1, mode="edge")
        return cls(level, cell, (centre[0] - half - cell, centre[1] - half - cell))

    @classmethod
    def from_file(cls, file: str | Path, cell: float, height: float = 1.0) -> Terrain:
        """Return a height map with its middle at the world's origin, level beyond.

        Args:
            file: Heights [m] as a NumPy array `.npy`, rows along x and columns along y; or a picture that Pillow reads,
                seen from above with x to the right and y up.
            cell: Distance of the heights [m], a pixel of the picture.
            height: Height of white, or of the largest 16-bit value [m]; black is 0. For pictures only.

        Raises:
            ValueError: If the file cannot be read or a number is out of range.
        """
        check("cell", cell, is_number(cell) and cell > 0, "a length above 0 m")
        check("height", height, is_number(height), "a length in metres")
        heights = np.pad(read_heights(file, height), 1, mode="edge")
        return cls(heights, cell, tuple(-cell * (n - 1) / 2 for n in heights.shape))

    def at(self, x: ArrayLike, y: ArrayLike) -> NDArray:
        """Return height and slopes of the surface at places, as in the compiled step.

        Args:
            x: Places along x [m].
            y: Places along y [m], of a shape that broadcasts with `x`.

        Returns:
            Height [m], dz/dx and dz/dy, shape (..., 3).
        """
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        rows, weights_x, slopes_x = _spline((x - self.origin[0]) / self.cell, self.heights.shape[0])
        columns, weights_y, slopes_y = _spline((y - self.origin[1]) / self.cell, self.heights.shape[1])
        around = self.heights[rows[..., :, None], columns[..., None, :]]

        def weighted(along_x: NDArray, along_y: NDArray) -> NDArray:
            return np.einsum("...i,...ij,...j->...", along_x, around, along_y)

        slopes = weighted(slopes_x, weights_y) / self.cell, weighted(weights_x, slopes_y) / self.cell
        return np.stack([weighted(weights_x, weights_y), *slopes], axis=-1)


def _spline(u: NDArray, count: int) -> tuple[NDArray, NDArray, NDArray]:
    """Return indices of the three of `count` heights around `u`, in cells, their weights, and slopes of the weights."""
    inside = np.clip(u, 0.5, count - 1.5)
    nearest = np.minimum(np.floor(inside + 0.5), count - 2)
    t = inside - nearest
    slopes = np.stack([t - 0.5, -2 * t, t + 0.5], axis=-1)
    weights = np.stack([(t - 0.5) ** 2 / 2, 0.75 - t**2, (t + 0.5) ** 2 / 2], axis=-1)
    return nearest[..., None].astype(int) + [-1, 0, 1], weights + slopes * (u - inside)[..., None], slopes


def _finite(figure: ArrayLike) -> bool:
    return bool(np.isfinite(figure).all())


def _positive(length: float) -> bool:
    return _finite(length) and length > 0
