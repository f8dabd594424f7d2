"""Sub-steps of a `Simulator`, and setting its state, as `@njit` functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ce_gym.model.coordinates import UNIT_ROUNDING, UNIT_TOLERANCE
from ce_gym.numba.kernel_call import kernel_call, scratch_size
from ce_gym.numba.quantities import quantity
from ce_gym.sim.interruptible_runs import LONGEST
from ce_gym.sim.simulator import Simulator


class Memory(NamedTuple):
    """Parts of the state that follow from positions and velocities.

    Attributes:
        zero: Arrays that become 0, in tiles.
        load: Arrays of normal forces of contacts, in tiles.
        step_length: Length of the next step, in tiles; of size 0 unless the method is "adaptive".
        parameters: Physical parameters of each robot, in tiles; of size 0 without.
        failures: How many times each robot has diverged and been reset, shape (num_envs,).
    """

    zero: tuple[NDArray[Any], ...]
    load: tuple[NDArray[Any], ...]
    step_length: NDArray[Any]
    parameters: NDArray[Any]
    failures: NDArray[np.int64]


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
        memory: What `set_state` resets.
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
    memory: Memory

    def __repr__(self) -> str:
        return f"Robots({self.num_envs} robots, nq={self.q.shape[1]}, nv={self.v.shape[1]}, {self.q.dtype})"


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
    resting = tuple(state[field.name] for field in simulator._memory if field.reset == "resting_load")
    zero = [field.name for field in simulator._memory if field.reset == "zero"]
    zero += [name for name in ("diverged", "step_error", "step_change") if name in state]
    memory = Memory(
        zero=tuple(state[name] for name in zero),
        load=resting or (nothing,),
        step_length=arrays.get("step_length", nothing),
        parameters=arrays.get("parameters", nothing),
        failures=state["failures"],
    )
    changes = simulator._batch.n_changes
    robots = Robots(simulator.num_envs, **views, arrays=passed, scratch=scratch, n_changes=changes, memory=memory)
    call, lanes = kernel_call(kernel), kernel.lanes

    @njit(nogil=True)
    def step(robots, n_substeps):
        """Advance all robots by `n_substeps` sub-steps of length `dt`."""
        robots.n_changes[:] += 1
        n_tiles = -(-robots.num_envs // lanes)
        for made in range(0, n_substeps, LONGEST):
            call(robots.arrays, robots.scratch, min(LONGEST, n_substeps - made), 0, n_tiles, robots.num_envs)

    return robots, step


def set_state(simulator: Simulator) -> Callable[[Robots, int, Any, Any], None]:
    """Return the `@njit` function `set_state(robots, k, q, v)`, which puts robot k into a state.

    The function does what `Simulator.set_state` does for robot k, with the same bits: it sets positions, shape (nq,),
    and velocities, shape (nv,), resets the memory of contacts and motors, and clears divergence. It raises a ValueError
    if a number is not finite or the norm of a quaternion is not within 1e-3 of 1. Threads may set different robots.

    Args:
        simulator: The simulator of `stepper`, or another one of the same robot and scene.

    Raises:
        ValueError: If the simulator has terrain, contacts that roll, or loops that no formula closes.
    """
    model, chosen = simulator.model, [simulator.model.contact_names.index(name) for name in simulator.contact_names]
    spheres = [model.robot.contacts[i] for i in chosen]
    if simulator.terrain is not None or any(sphere.rim for sphere in spheres) or model.guess.size:
        limits = "level ground, contacts that do not roll, and loops that a formula closes"
        raise ValueError(f"set_state of {model.robot.name}: expected {limits}; call Simulator.set_state from Python")
    contact_points, contacts = quantity(model, "contact_points"), np.array(chosen, dtype=np.int64)
    radius, rest = np.array([sphere.radius for sphere in spheres]), np.zeros(model.nv)
    stiffness, column = simulator.options.material.stiffness, simulator._columns.get("stiffness", slice(-1, 0)).start
    turns = np.array([i for i, _ in model.robot.layout.turns], dtype=np.int64)
    schema = simulator._batch.schema
    length = np.asarray(schema["step_length"].reset if "step_length" in schema else 0.0).item()
    dtype = np.dtype(simulator.dtype)
    largest, rounding = float(np.finfo(dtype).max), UNIT_ROUNDING * float(np.finfo(dtype).eps)

    @njit(nogil=True)
    def set_robot(robots, k, q, v):
        """Put robot k into a state."""
        tile, lane, unit = k // robots.q.shape[2], k % robots.q.shape[2], q.astype(np.float64)
        if unit.size != robots.q.shape[1] or v.size != robots.v.shape[1] or not 0 <= k < robots.num_envs:
            raise ValueError("set_state: expected the number of a robot, q of shape (nq,) and v of shape (nv,)")
        if not ((np.abs(unit) <= largest).all() and (np.abs(v) <= largest).all()):
            raise ValueError("set_state: q or v holds a number that is not finite")
        for i in turns:
            norm = np.sqrt((unit[i : i + 4] * unit[i : i + 4]).sum())
            if abs(norm - 1) > UNIT_TOLERANCE:
                raise ValueError("set_state: the norm of a quaternion is not 1; divide the quaternion by its norm")
            if abs(norm - 1) > rounding:
                unit[i : i + 4] /= norm
        memory, positions = robots.memory, contact_points(unit, rest)[0]
        memory.failures[k] += robots.diverged[tile, 0, lane] > 0.5
        for array in memory.zero:
            array[tile, :, lane] = 0
        for array in memory.load:
            array[tile, :, lane] = 0
            for i in range(min(len(contacts), array.shape[1])):
                of_robot = memory.parameters[tile, column, lane] if column >= 0 else stiffness
                array[tile, i, lane] = of_robot * max(radius[i] - positions[contacts[i], 2], 0.0)
        memory.step_length[tile, :, lane] = length
        robots.q[tile, :, lane] = unit
        robots.v[tile, :, lane] = v
        robots.n_changes[k] += 1

    return set_robot
