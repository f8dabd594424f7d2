"""How far a device is from the CPU's kernels after one step from random states: every robot, level and type."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.console import progress
from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator
from ce_gym.sim.devices import Device, to_numpy

BOUND = {"float64": 1e-11, "float32": 1e-5}
"""Largest difference allowed, relative to a robot's largest position or velocity, or to 1. There should be none."""
State = dict[str, NDArray]


def stepped(model: Model, dtype: str, device: str | Device, num_envs: int) -> State:
    """State after one sub-step from random states about the standing pose, all contacts, by name, rows of robots.

    Feet are up to 5 mm in the ground and up to 20 mm above; velocities are normal with 0.5 rad/s or m/s, targets
    uniform within 0.2 rad. States are rounded to single precision first, so that all types start alike.
    """
    rng = np.random.default_rng(3)
    sim = Simulator(model, num_envs, dtype=dtype, device=device)
    q, v = np.tile(model.standing_q, (num_envs, 1)), 0.5 * rng.normal(size=(num_envs, model.nv))
    if model.robot.floating:
        q[:, 2] += rng.uniform(-0.005, 0.02, num_envs)
    joints = len(model.joint_links)
    targets = model.standing_q[-joints:] + rng.uniform(-0.2, 0.2, (num_envs, joints))
    sim.set_state(q.astype(np.float32), v.astype(np.float32))
    sim.step(targets.astype(np.float32))
    return {"q": to_numpy(sim.q), "v": to_numpy(sim.v)}


def difference(one: State, other: State) -> NDArray:
    """Return the largest difference of each robot, relative to its largest number or 1, shape (num_envs,)."""
    each = [np.abs(one[k] - other[k]).max(1) / np.maximum(1, np.abs(one[k]).max(1)) for k in one]
    return np.max(each, axis=0)


def measure(
    names: Sequence[str], levels: Sequence[str], num_envs: int, device: Device, where: str, report: Report
) -> None:
    """Add the table, and what was required.

    Args:
        names: Of robots.
        levels: Transmission levels.
        num_envs: Robots in a batch.
        device: What is compared with the CPU.
        where: Its name, for the title.
        report: Gets the table and the requirements.

    Raises:
        RuntimeError: If the device cannot run kernels at all.
    """
    rows: list[tuple[Cell, ...]] = []
    worst = dict.fromkeys(BOUND, 0.0)
    for name in progress(names, "robots"):
        for level in levels:
            model = Model(name, level)
            for dtype in BOUND:
                apart = difference(*(stepped(model, dtype, one, num_envs) for one in ("cpu", device)))
                rows.append((name, level, dtype, float(apart.max()), 100 * float((apart == 0).mean())))
                worst[dtype] = max(worst[dtype], float(apart.max()))
    columns = ("robot", "level", "dtype", "largest difference", "robots with the same numbers [%]")
    title = f"One step from {num_envs} random states: difference from the CPU's kernel, {where}"
    report.tables.append(Table(title, columns, tuple(rows)))
    for dtype, bound in BOUND.items():
        claim = f"{dtype}: every robot within {bound:g} of the CPU's kernel"
        report.requirements.append(Requirement(claim, f"largest {worst[dtype]:.1e}", worst[dtype] <= bound))
