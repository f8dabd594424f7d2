"""What a robot of a batch carries from call to call: a schema with one row for each state buffer.

Arrays on a device, the buffers of kernels, resets, snapshots and copies are made from the rows and from nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ce_gym.compile import Buffer
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import Rates
from ce_gym.dynamics.laws.scene_laws import output_sizes, state_fields
from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.step_size import control_sizes
from ce_gym.model.arguments import check
from ce_gym.sim.devices import Array
from ce_gym.sim.substeps import DT, FRAME

Writer = Literal["physics", "task", "term", "drift", "host", "scene"]

TOLERANCE = 1e-3
"""What is asked for where nothing is said [rad or m]."""
TOLERATED = "tolerance"
"""Name of the buffer with that of each robot."""
FIRST = 10
"""The first step that a robot tries is so many times shorter than a sub-step."""


@dataclass(frozen=True)
class Row:
    """One state buffer.

    Attributes:
        name: Of the buffer.
        size: Numbers that one robot has there; 0 for a plain array of one number for each robot.
        writer: Who changes it: "physics" (the sub-steps), "task" (what an environment does around them), "term" (a
            reward, observation, termination or metric with memory), "drift" (a sensor's error, drawn by resets), "host"
            (Python only; no reset touches it) or "scene" (constant: how it is stepped, and no part of a snapshot).
        reset: With what a robot begins, a number or shape (size,).
        dtype: Of a plain array, shape (num_envs, size), or (num_envs,) for size 0; "" for one in lanes.
        quaternions: Places at which quaternions of unit length begin.
    """

    name: str
    size: int
    writer: Writer
    reset: ArrayLike = 0.0
    dtype: str = ""
    quaternions: tuple[int, ...] = ()


def physics_rows(
    model: Model, options: StepOptions, outputs: Sequence[str], dt: float, tolerance: float | None = None
) -> list[Row]:
    """Return the rows of what the sub-steps of a scene read and write.

    Args:
        model: The robot at a transmission level.
        options: The scene.
        outputs: What is computed besides the state.
        dt: Length of a sub-step [s].
        tolerance: Of a method with steps of its own [rad or m]; `TOLERANCE` if None.
    """
    start = {"q": model.standing_q, "dependent": model.guess}
    fields = state_fields(model.mechanism, options)
    if isinstance(METHODS[options.method].end, Rates):
        for field in fields:
            check("method", options.method, field.explicit, f"an implicit one: the state has the {field.meaning}")
    turns = {"q": tuple(i for i, _ in model.robot.layout.turns)}
    rows = [
        Row(field.name, field.size, "physics", start.get(field.name, 0.0), quaternions=turns.get(field.name, ()))
        for field in fields
    ]
    rows += [Row("diverged", 1, "physics"), Row("retries", 1, "physics")]
    sizes = output_sizes(model.mechanism, options)
    rows += [Row(name, size, "physics") for name in outputs if (size := sizes.get(name, 1))]
    if options.parameters:
        defaults = parameter_defaults(model.robot, options.material, options.parameters)
        values = np.concatenate(list(defaults.values()))
        rows.append(Row("parameters", len(values), "host", values))
    if METHODS[options.method].controlled:
        first = {"step_length": dt / FIRST}
        sizes = control_sizes(model.robot.layout)
        rows += [Row(name, size, "physics", first.get(name, 0.0)) for name, size in sizes.items() if name != TOLERATED]
        rows.append(Row(TOLERATED, 1, "scene", TOLERANCE if tolerance is None else tolerance))
    rows.append(Row(DT, 1, "scene", dt))
    return rows + ([Row(FRAME, 3, "host")] if options.ground == "field" else [])


def state_buffers(rows: Iterable[Row]) -> list[Buffer]:
    """Return the buffers of a kernel that rows in its lanes are."""
    return [Buffer(row.name, row.size, "tiles") for row in rows if not row.dtype]


@dataclass(frozen=True)
class Steps:
    """Steps that robots have made at lengths of their own, shape (num_envs,) each.

    Attributes:
        taken: How many.
        refused: How many were tried again, shorter.
        missed: How many of those taken missed the tolerance: they were as short as can be.
        length: What is tried next, unless the end of an interval is nearer [s].
        error: Estimated error of the last one that was taken [rad or m].
    """

    taken: Array
    refused: Array
    missed: Array
    length: Array
    error: Array
