"""The schema of the state of a batch: one row for each buffer that lasts from call to call.

Arrays on a device, buffers of kernels, resets, snapshots and copies follow from the rows alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.compile import Buffer
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import Rates
from ce_gym.dynamics.laws.scene_laws import output_sizes, state_fields
from ce_gym.dynamics.laws.scene_parameters import check_parameter, parameter_defaults
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.step_size import control_sizes
from ce_gym.model.arguments import check
from ce_gym.sim.devices import Array
from ce_gym.sim.substeps import DT, FRAME

Writer = Literal["physics", "task", "term", "drift", "host", "scene"]

TOLERANCE = 1e-3
"""Default tolerance of adaptive steps [rad or m]."""
TOLERATED = "tolerance"
"""Name of the buffer with the tolerance of each robot."""
FIRST = 10
"""Length of a sub-step over the length of the first step that a robot tries."""


LARGEST = float(np.finfo(float).max)
FINITE = (-LARGEST, LARGEST)
"""Bounds of rows that hold any finite number."""
COUNT = (0.0, LARGEST)
"""Bounds of rows that count."""


@dataclass(frozen=True)
class Row:
    """One state buffer.

    Attributes:
        name: Of the buffer.
        size: Numbers of each robot; 0 for a plain array with one number for each robot.
        writer: The part that changes the buffer: "physics" (the sub-steps), "task" (the environment around them),
            "term" (a reward, observation, termination or metric with memory), "drift" (resets draw a sensor's error),
            "host" (Python; resets leave it) or "scene" (nobody: an option of the scene, left out of snapshots).
        reset: Value after a reset, a number or shape (size,).
        dtype: Of a plain array, shape (num_envs, size), or (num_envs,) for size 0; "" for an array in lanes.
        quaternions: Rows at which unit quaternions begin.
        bounds: Smallest and largest number that a snapshot may hold; None for rows that no step reads.
        check: Further check of the rows in a snapshot, shape (num_envs, size); raises ValueError.
    """

    name: str
    size: int
    writer: Writer
    reset: ArrayLike = 0.0
    dtype: str = ""
    quaternions: tuple[int, ...] = ()
    bounds: tuple[float, float] | None = None
    check: Callable[[NDArray], None] | None = None

    def check_values(self, values: NDArray) -> None:
        """Check the numbers of a snapshot, shape (num_envs, size).

        Raises:
            ValueError: A number is out of bounds.
        """
        if self.bounds is not None:
            low, high = self.bounds
            if wrong := values[~((values >= low) & (values <= high))].tolist():
                expected = "a finite number" if self.bounds == FINITE else f"a number from {low:g} to {high:g}"
                raise ValueError(f"snapshot: {self.name!r} holds {wrong[0]:g}; expected {expected}")
        if self.check is not None:
            self.check(values)


def physics_rows(
    model: Model, options: StepOptions, outputs: Sequence[str], dt: float, tolerance: float | None = None
) -> list[Row]:
    """Return the rows of the buffers that the sub-steps of a scene read and write.

    Args:
        model: The robot at a transmission level.
        options: The scene.
        outputs: Names of outputs to compute.
        dt: Length of a sub-step [s].
        tolerance: Of adaptive steps [rad or m]; `TOLERANCE` if None.
    """
    start = {"q": model.standing_q, "dependent": model.guess}
    fields = state_fields(model.mechanism, options)
    if isinstance(METHODS[options.method].end, Rates):
        for field in fields:
            check("method", options.method, field.explicit, f"an implicit one: the state has the {field.meaning}")
    turns = {"q": tuple(i for i, _ in model.robot.layout.turns)}
    rows = [
        Row(
            field.name,
            field.size,
            "physics",
            start.get(field.name, 0.0),
            quaternions=turns.get(field.name, ()),
            bounds=FINITE,
        )
        for field in fields
    ]
    rows += [Row("diverged", 1, "physics", bounds=(0.0, 1.0)), Row("retries", 1, "physics", bounds=COUNT)]
    sizes = output_sizes(model.mechanism, options)
    rows += [Row(name, size, "physics") for name in outputs if (size := sizes.get(name, 1))]
    if options.parameters:
        defaults = parameter_defaults(model.robot, options.material, options.parameters)
        values = np.concatenate(list(defaults.values()))

        def check_values(rows: NDArray) -> None:
            parts = np.split(rows, np.cumsum([len(value) for value in defaults.values()])[:-1], axis=1)
            for name, part in zip(defaults, parts, strict=True):
                check_parameter(model.robot, name, part)

        rows.append(Row("parameters", len(values), "host", values, check=check_values))
    if METHODS[options.method].controlled:
        first = {"step_length": dt / FIRST}
        sizes = control_sizes(model.robot.layout)
        rows += [
            Row(name, size, "physics", first.get(name, 0.0), bounds=FINITE)
            for name, size in sizes.items()
            if name != TOLERATED
        ]
        rows.append(Row(TOLERATED, 1, "scene", TOLERANCE if tolerance is None else tolerance))
    rows.append(Row(DT, 1, "scene", dt))
    return rows + ([Row(FRAME, 3, "host", bounds=FINITE)] if options.ground == "field" else [])


def state_buffers(rows: Iterable[Row]) -> list[Buffer]:
    """Return the kernel buffers of the rows that are in lanes."""
    return [Buffer(row.name, row.size, "tiles") for row in rows if not row.dtype]


@dataclass(frozen=True)
class Steps:
    """Adaptive steps of each robot, shape (num_envs,) each.

    Attributes:
        taken: Number of accepted steps.
        refused: Number of steps that were tried again with a shorter length.
        missed: Number of accepted steps that missed the tolerance, at the shortest length.
        length: Length of the next step, unless the end of the interval is nearer [s].
        error: Estimated error of the last accepted step [rad or m].
    """

    taken: Array
    refused: Array
    missed: Array
    length: Array
    error: Array
