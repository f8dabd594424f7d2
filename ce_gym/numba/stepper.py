"""Sub-steps of a `Simulator` as an `@njit` function."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ce_gym.numba.kernel_call import kernel_call, scratch_size
from ce_gym.sim.interruptible_runs import LONGEST
from ce_gym.sim.simulator import Simulator


class Robots(NamedTuple):
    """The state of a simulator's robots in its own memory, for the function of `stepper`.

    Arrays in tiles have shape (n_tiles, size, lanes): number i of robot k is at `[k // lanes, i, k % lanes]`.

    Attributes:
        num_envs: Number of robots.
        q: Positions, in tiles.
        v: Velocities, in tiles.
        target: Targets of `Simulator.step`, shape (num_envs, n). They are 0 until they are written.
        torque: Motor torques at the joints, in tiles; of size 0 if the simulator does not compute them.
        contact_forces: Forces on the contact spheres, in tiles, size 3 n; of size 0 if they are not computed.
        diverged: 1 for robots that are frozen, in tiles of size 1.
        arrays: All arguments of the kernel.
        scratch: Memory of the kernel.
        n_changes: See `Batch.n_changes`; tells recorders of gradients that robots have been stepped.
    """

    num_envs: int
    q: NDArray[Any]
    v: NDArray[Any]
    target: NDArray[Any]
    torque: NDArray[Any]
    contact_forces: NDArray[Any]
    diverged: NDArray[Any]
    arrays: tuple[NDArray[Any], ...]
    scratch: NDArray[np.int64]
    n_changes: NDArray[np.int64]


def stepper(simulator: Simulator) -> tuple[Robots, Callable[[Robots, int], None]]:
    """Return the state of a simulator's robots, and the `@njit` function `step(robots, n_substeps)`.

    The function does what `Simulator.step` does with `robots.target`, with the same bits, in the calling thread. It
    changes the state of the simulator. No other thread may use the same simulator at the same time.

    Raises:
        ValueError: If the simulator is on a GPU or has a controller.
    """
    if simulator.device != "cpu" or simulator.controlled:
        raise ValueError("stepper: a simulator on a GPU or with a controller; expected one on the CPU without")
    kernel, state = simulator._kernel, simulator._arrays | simulator._batch.tables
    target = np.zeros((simulator.num_envs, len(simulator.target_names)), simulator.dtype)
    arrays = {**state, "target": target}
    nothing = np.zeros((len(state["q"]), 0, kernel.lanes), simulator.dtype)
    views = {name: arrays.get(name, nothing) for name in ("q", "v", "target", "torque", "contact_forces", "diverged")}
    passed = tuple(arrays[buffer.name] for buffer in kernel.arguments)
    scratch = np.zeros(scratch_size(kernel), np.int64)
    changes = simulator._batch.n_changes
    robots = Robots(simulator.num_envs, **views, arrays=passed, scratch=scratch, n_changes=changes)
    call, lanes = kernel_call(kernel), kernel.lanes

    @njit(nogil=True)
    def step(robots, n_substeps):
        """Advance all robots by `n_substeps` sub-steps of length `dt`."""
        robots.n_changes[:] += 1
        n_tiles = -(-robots.num_envs // lanes)
        for made in range(0, n_substeps, LONGEST):
            call(robots.arrays, robots.scratch, min(LONGEST, n_substeps - made), 0, n_tiles, robots.num_envs)

    return robots, step
