"""The stability map: all combinations of time step, ground stiffness and slip speed, standing and collapsing.

Stiffness, damping and slip speed are declared parameters, so that one kernel computes all cells of a time step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator

Array = NDArray[Any]

STEPS = (1e-4, 5e-4, 2e-3, 5e-3, 1e-2, 2e-2)
"""Time steps [s]."""
STIFFNESSES = (1e3, 1e4, 1e5, 1e6, 1e7)
"""Normal stiffnesses of the ground [N/m]; the damping ratio is the same as for the robot's own ground."""
SLIP_SPEEDS = (1e-1, 1e-2, 1e-3, 1e-4)
"""Slip speeds [m/s]."""
STARTS = 2
"""Initial states of each cell, with different orientations, joint positions and velocities."""
SHAPE = (len(STIFFNESSES), len(SLIP_SPEEDS))
"""Shape of the results of one time step."""

DROP = 0.02
"""Initial height of standing robots [m]."""
FALL = 0.1
"""Initial height of robots without motors [m]."""
SILENCE = 1e-6
"""Root mean square speed below which a robot is at rest [m/s and rad/s]."""
WATCHED = 100
"""Number of steps in the mean of this speed."""
ROUNDING = 1e-9
"""Gain of energy that counts as rounding, as a fraction of the initial energy."""


@dataclass(frozen=True)
class Map:
    """Results of one robot at one time step; every array has shape SHAPE, with the worst initial state of each cell.

    Attributes:
        dt: Time step [s].
        finite: Whether no robot diverged, standing or collapsing.
        chatter: Root mean square speed at rest, over all steps [m/s and rad/s].
        gain: Largest rise of the mechanical energy, with springs, above its lowest value so far while robots collapse
            without motors, as a fraction of the energy that they lose [-].
        excess: Largest excess of kinetic and potential energy over the initial value, same unit [-].
    """

    dt: float
    finite: Array
    chatter: Array
    gain: Array
    excess: Array


def measure(model: Model, dt: float, patience: float, collapse: float) -> Map:
    """Measure one time step of one robot.

    Args:
        model: A robot with a floating base.
        dt: Time step [s].
        patience: Longest time to come to rest [s].
        collapse: Simulated time of a collapse [s].
    """
    upright, chatter = stand(model, dt, patience)
    lasting, *energies = fall(model, dt, collapse)
    return Map(dt, upright & lasting, chatter, *energies)


def stand(model: Model, dt: float, patience: float) -> tuple[Array, Array]:
    """Drop robots in their standing pose; return whether they stay finite, and their speed at rest.

    Humanoids fall on very soft ground; robots on the ground must come to rest, too.
    """
    sim = scene(model, dt, "position", ())
    q, v = starts(model, DROP, 0.0)
    sim.set_state(q, v)
    target, time, speed = model.standing_q[7:], 0.0, np.full(sim.num_envs, np.inf)
    while time < patience and (speed > SILENCE).any():
        sim.step(target, n_substeps=max(1, round(1.0 / dt) - WATCHED))
        squares = np.zeros(sim.num_envs)
        for _ in range(WATCHED):
            sim.step(target)
            squares += np.mean(np.square(sim.v), axis=1)
        speed = np.where(sim.diverged, np.inf, np.sqrt(squares / WATCHED))
        time += max(1.0, (WATCHED + 1) * dt)
    return worst(sim.diverged) == 0, worst(speed)


def fall(model: Model, dt: float, time: float) -> tuple[Array, Array, Array]:
    """Let robots collapse without motors; return whether they stay finite, gain and excess, see `Map`."""
    sim = scene(model, dt, "torque", ("energy",))
    q, v = starts(model, FALL, 0.5)
    sim.set_state(q, v)
    nothing = np.zeros(len(model.joint_links))
    start = np.sum(model.energy(sim.q, sim.v), axis=0)
    lowest, gain, excess = start.copy(), np.zeros_like(start), np.full_like(start, -np.inf)
    every = max(1, round(0.01 / dt))
    for i in range(round(time / dt)):
        sim.step(nothing)
        energy = sim.energy.copy()
        gain = np.maximum(gain, energy - lowest)
        lowest = np.minimum(lowest, energy)
        if i % every == 0:
            excess = np.maximum(excess, np.sum(model.energy(sim.q, sim.v), axis=0) - start)
    lost = start - lowest
    bad = np.where(sim.diverged, np.inf, 0.0)
    return worst(sim.diverged) == 0, worst(gain / lost + bad), worst(excess / lost + bad)


def scene(model: Model, dt: float, control: str, outputs: tuple[str, ...]) -> Simulator:
    """Return a simulator with STARTS robots for each cell, on the ground of the cell."""
    own = model.robot.material
    sim = Simulator(
        model, STARTS * SHAPE[0] * SHAPE[1], dt, control=control, outputs=outputs,
        parameters=("stiffness", "damping", "slip_speed"),
    )  # fmt: skip
    k, v_s = (grid.ravel() for grid in np.meshgrid(STIFFNESSES, SLIP_SPEEDS, indexing="ij"))
    for name, value in (("stiffness", k), ("damping", k * own.damping / own.stiffness), ("slip_speed", v_s)):
        sim.set_parameter(name, np.tile(value, STARTS)[:, None])
    return sim


def starts(model: Model, height: float, speed: float) -> tuple[Array, Array]:
    """Return positions near the standing pose, raised by `height` [m], and random velocities; equal in all cells."""
    rng, cells = np.random.default_rng(0), SHAPE[0] * SHAPE[1]
    q = np.tile(model.standing_q, (STARTS, 1))
    q[:, 2] += height
    q[:, 4:7] = rng.uniform(-0.02, 0.02, (STARTS, 3))
    q[:, 3] = np.sqrt(1.0 - np.sum(q[:, 4:7] ** 2, axis=1))
    q[:, 7:] += rng.uniform(-0.02, 0.02, q[:, 7:].shape)
    return q.repeat(cells, axis=0), rng.normal(0.0, speed, (STARTS, model.nv)).repeat(cells, axis=0)


def worst(x: Array) -> Array:
    """Return the largest value of each cell over its initial states, shape SHAPE."""
    return np.asarray(x).reshape(STARTS, *SHAPE).max(axis=0)
