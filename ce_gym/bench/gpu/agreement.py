"""Compare a device with the CPU after one step from random states, for every robot, level and precision."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.console import progress
from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator
from ce_gym.sim.devices import Cpu, Device, to_numpy

BOUND = {"float64": 1e-11, "float32": 1e-5}
"""Largest allowed difference, relative to a robot's largest position or velocity, or to 1."""
State = dict[str, NDArray]


def stepped(model: Model, dtype: str, device: str | Device, num_envs: int) -> State:
    """Return states after one sub-step from random states near the standing pose with all contacts, by name.

    Feet are from 5 mm below to 20 mm above the ground. Velocities are normal with 0.5 rad/s or m/s, targets are uniform
    within 0.2 rad. Initial states are rounded to single precision, so that they are equal in both precisions.
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
    """Return the largest difference of each robot, relative to its largest value or 1, shape (num_envs,)."""
    each = [np.abs(one[k] - other[k]).max(1) / np.maximum(1, np.abs(one[k]).max(1)) for k in one]
    return np.max(each, axis=0)


def measure(
    names: Sequence[str], levels: Sequence[str], num_envs: int, device: Device, where: str, report: Report
) -> None:
    """Add a table of differences and the requirements to a report.

    Args:
        names: Names of robots.
        levels: Transmission levels.
        num_envs: Robots in a batch.
        device: Device that is compared with the CPU.
        where: Name of the device in the title.
        report: The report.

    Raises:
        RuntimeError: If the device cannot run kernels.
    """
    rows: list[tuple[Cell, ...]] = []
    worst = dict.fromkeys(BOUND, 0.0)
    for name in progress(names, "robots"):
        for level in levels:
            model = Model(name, level)
            for dtype in BOUND:
                apart = difference(*(stepped(model, dtype, one, num_envs) for one in (Cpu(joint_space=False), device)))
                rows.append((name, level, dtype, float(apart.max()), 100 * float((apart == 0).mean())))
                worst[dtype] = max(worst[dtype], float(apart.max()))
    columns = ("robot", "level", "dtype", "largest difference", "robots with the same numbers [%]")
    title = f"One step from {num_envs} random states: difference from the CPU's kernel, {where}"
    report.tables.append(Table(title, columns, tuple(rows)))
    for dtype, bound in BOUND.items():
        claim = f"{dtype}: every robot within {bound:g} of the CPU's kernel"
        report.requirements.append(Requirement(claim, f"largest {worst[dtype]:.1e}", worst[dtype] <= bound))
