"""`Batch`: the state of many robots on a device, made from a schema."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.compile.system import check_memory
from ce_gym.model.coordinates import unit_quaternions
from ce_gym.model.formats.archive import read_npz
from ce_gym.sim.devices import Array, Device
from ce_gym.sim.schema import Row
from ce_gym.sim.substeps import FRAME, HEIGHTS
from ce_gym.sim.terrain import Terrain

File = str | os.PathLike[str]
LARGEST_HEADER = 2**20
"""Most bytes of a snapshot's file beyond its numbers: names, types and shapes of arrays."""
Snapshot = Mapping[str, NDArray]
"""The state of a batch: rows of robots by name, copies in the memory of the CPU."""


class Batch:
    """Many robots with state, tables that they share, and a device.

    Args:
        rows: The schema of their state.
        num_envs: Number of robots.
        dtype: "float64" or "float32" for the lanes.
        device: Device with the memory of the state.
        terrain: The ground, if it is a field.
        num_threads: Threads that share the robots.

    Raises:
        ValueError: If the state does not fit into memory.

    Attributes:
        schema: Rows by name.
        arrays: Arrays of the rows, by name.
        tables: Arrays that all robots share, by name.
        n_changes: How often steps and resets have changed the state of each robot, int64, shape (num_envs,).
    """

    def __init__(
        self,
        rows: Iterable[Row],
        num_envs: int,
        dtype: str,
        device: Device,
        terrain: Terrain | None = None,
        num_threads: int = 1,
    ) -> None:
        self.schema = {row.name: row for row in rows}
        if device.name == "cpu":
            numbers = sum(row.size or 1 for row in self.schema.values())
            check_memory(f"num_envs={num_envs}", num_envs * numbers * np.dtype(dtype).itemsize)
        self.num_envs, self.dtype, self.place, self.num_threads = num_envs, dtype, device, num_threads
        self.arrays = {name: self._array(row) for name, row in self.schema.items()}
        self.tables: dict[str, Array] = {}
        self.n_changes = np.zeros(num_envs, np.int64)
        self._n_writes = {name: np.zeros(num_envs, np.int64) for name in self.schema}
        if terrain is not None:
            self.tables[HEIGHTS] = device.rows(terrain.heights.astype(dtype), dtype)
            self.write(FRAME, [*terrain.origin, terrain.cell])
        for name, row in self.schema.items():
            if np.any(row.reset):
                self.write(name, row.reset)

    def _array(self, row: Row) -> Array:
        if not row.dtype:
            return self.place.tiles(self.num_envs, row.size, self.dtype)
        shape = (self.num_envs, row.size) if row.size else (self.num_envs,)
        return self.place.zeros(shape, row.dtype)

    def rows(self, name: str) -> Array:
        """Return a copy of a state buffer, one robot per row; KeyError for an unknown name."""
        return self.place.read(self.arrays[name], self.num_envs)

    def write(self, name: str, values: Any, mask: Any = None) -> None:
        """Overwrite a state buffer.

        Args:
            name: Of the buffer.
            values: Shape (num_envs, size) or a shape that broadcasts to it; (num_envs,) for a plain buffer of size 0.
            mask: Robots to write, bool, shape (num_envs,); all robots if None.
        """
        self.place.write(self.arrays[name], values, mask)
        self._n_writes[name] += mask if isinstance(mask, np.ndarray) else True

    def version(self, name: str) -> NDArray[np.int64]:
        """Return numbers that grow whenever a state buffer of a robot may have changed, shape (num_envs,)."""
        return self.n_changes + self._n_writes[name]

    def unit(self, name: str, values: NDArray, source: str = "") -> NDArray:
        """Return rows of a state buffer, shape (..., size), with quaternions scaled to unit length.

        Args:
            name: Of the buffer.
            values: Values for the buffer.
            source: Origin of the values, for the message.

        Raises:
            ValueError: The norm of a quaternion is not within 1e-3 of 1.
        """
        return unit_quaternions(values, self.schema[name].quaternions, source + name, self.dtype)

    def snapshot(self, file: File | None = None) -> Snapshot:
        """Return the state by name, shape (num_envs, size) or (num_envs,), and write it to a file if one is given."""
        state = {name: self.place.host(self.rows(name)) for name, row in self.schema.items() if row.writer != "scene"}
        if file is not None:
            with Path(file).open("wb") as stream:  # numpy would add a suffix to a name
                np.savez(stream, **state)  # pyright: ignore[reportArgumentType]
        return state

    def restore(self, snapshot: Snapshot | File) -> None:
        """Continue from a snapshot, or from a file with one.

        Raises:
            ValueError: If the snapshot is from another kind of batch or on other ground, or has a number out of range
                or a quaternion that is not of unit length. Then nothing has been changed.
        """
        expected = self.snapshot()
        most_bytes = LARGEST_HEADER + sum(rows.nbytes for rows in expected.values())
        state = snapshot if isinstance(snapshot, Mapping) else load_snapshot(snapshot, most_bytes)
        for name in sorted(expected.keys() ^ state.keys()):
            there = "missing" if name in expected else "not part of this state"
            raise ValueError(f"snapshot: {name!r} is {there}; expected one of the same robot, scene and task")
        for name, rows in expected.items():
            got = np.asarray(state[name])
            if (got.shape, got.dtype) != (rows.shape, rows.dtype):
                wanted = f"{rows.dtype} {rows.shape}"
                raise ValueError(f"snapshot: {name!r} is {got.dtype} {got.shape}; expected {wanted}")
            self.schema[name].check_values(got)
            if name == FRAME and not np.array_equal(got, rows):
                raise ValueError(f"snapshot: {name!r} differs; expected one on the same ground")
        for name, rows in {name: self.unit(name, np.asarray(state[name]), "snapshot: ") for name in expected}.items():
            self.write(name, rows)


def load_snapshot(file: File, most_bytes: int) -> Snapshot:
    """Read a snapshot from a file, without executing code from the file.

    Args:
        file: A regular file.
        most_bytes: Limit on the unpacked size.

    Raises:
        ValueError: If the file has no snapshot, or a larger one; one line.
    """
    try:
        return read_npz(Path(file), most_bytes)
    except Exception as error:  # damaged files raise errors of many classes
        problem = " ".join(str(error).split())[:200]
        raise ValueError(f"snapshot {os.fspath(file)!r}: {problem}; expected a file that `snapshot` wrote") from None
