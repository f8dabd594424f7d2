"""Stepping robots that have diverged again, from where they were, with smaller steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.compile import CriticalSection, Kernel
from ce_gym.sim.pieces import run_substeps
from ce_gym.sim.substeps import DT
from ce_gym.sim.tiles import read_rows, tiles, write_rows

Arrays = Mapping[str, NDArray]


@dataclass(frozen=True)
class Retry:
    """Steps some robots again, by themselves, with half the step, a quarter of it, and so on.

    Attributes:
        halvings: How often the step is halved before a robot is given up.
        kernel: That makes the steps.
    """

    halvings: int
    kernel: Kernel

    def __call__(
        self,
        before: Arrays,
        after: Arrays,
        num_envs: int,
        inputs: Arrays,
        shared: Arrays,
        n_substeps: int,
        section: CriticalSection,
    ) -> NDArray[np.bool_]:
        """Step again the robots that diverged between `before` and `after`, and write what became of them to `after`.

        A robot that no step length saves stays as it is in `after`: frozen and flagged. Robots are stepped alone, so
        that the others keep every bit.

        Args:
            before: Tiled arrays at the start of the call, by buffer; nothing in them is changed.
            after: The same at its end.
            num_envs: Number of robots in them.
            inputs: Rows that the call was given, shape (num_envs, size) each.
            shared: Arrays that all robots have in common.
            n_substeps: Sub-steps that the call made.
            section: The one that this is called in.

        Returns:
            Which robots were stepped again, shape (num_envs,).
        """
        failed = read_rows(after["diverged"], num_envs)[:, 0] > read_rows(before["diverged"], num_envs)[:, 0]
        again, parts = failed.copy(), 1
        for _ in range(self.halvings):
            if not failed.any():
                break
            parts *= 2
            alone = {name: _rows_as_tiles(array, num_envs, failed) for name, array in before.items()}
            given = {name: np.ascontiguousarray(rows[failed]) for name, rows in inputs.items()}
            n = int(failed.sum())
            alone[DT] /= parts
            run_substeps(self.kernel, alone | given | dict(shared), n, parts * n_substeps, section)
            saved = read_rows(alone["diverged"], n)[:, 0] < 0.5
            chosen = failed.copy()
            chosen[failed] = saved
            for name, array in alone.items():
                if name == DT:
                    continue
                rows = np.zeros((num_envs, array.shape[1]), array.dtype)
                rows[failed] = read_rows(array, n)
                write_rows(after[name], rows, chosen)
            failed &= ~chosen
        return again


def _rows_as_tiles(array: NDArray, num_envs: int, mask: NDArray[np.bool_]) -> NDArray:
    """Return the rows of some robots as tiles of their own."""
    rows = read_rows(array, num_envs)[mask]
    alone = tiles(len(rows), array.shape[1], array.dtype.name)
    write_rows(alone, rows)
    return alone
