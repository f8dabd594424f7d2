"""The stability map: every time step with every ground stiffness and slip speed, standing and collapsing.

Robots of one kernel differ in stiffness, damping and slip speed, which are declared parameters, so that one kernel
serves a whole time step.
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
"""Normal stiffnesses of the ground [N/m]; its damping keeps the ratio that the robot's own ground has."""
SLIP_SPEEDS = (1e-1, 1e-2, 1e-3, 1e-4)
"""Slip speeds [m/s]."""
STARTS = 2
"""Starts of each cell, different in attitude, joints and velocities."""
SHAPE = (len(STIFFNESSES), len(SLIP_SPEEDS))
"""Of what is known of one time step."""

DROP = 0.02
"""Height from which robots that stand are let go [m]."""
FALL = 0.1
"""Height from which robots without motors are let go [m]."""
SILENCE = 1e-6
"""Root mean square speed that counts as rest [m/s and rad/s]."""
WATCHED = 100
"""Steps over which it is taken, every one of them."""
ROUNDING = 1e-9
"""Gain of energy that counts as rounding, as a share of all the energy there was to lose."""


@dataclass(frozen=True)
class Map:
    """What became of one robot at one time step; every array has shape SHAPE, worst of all starts.

    Attributes:
        dt: Time step [s].
        finite: Whether no robot diverged, standing or collapsing.
        chatter: Root mean square speed at rest, every step counted [m/s and rad/s].
        gain: Largest rise of the mechanical energy above its lowest value so far, springs included, while robots
            collapse without motors, as a share of all they lose [-].
        excess: Highest sum of kinetic and potential energy above that at the start, same unit [-].
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
        dt: [s].
        patience: How long robots may take to come to rest [s].
        collapse: How long they are watched while they collapse [s].
    """
    upright, chatter = stand(model, dt, patience)
    lasting, *energies = fall(model, dt, collapse)
    return Map(dt, upright & lasting, chatter, *energies)


def stand(model: Model, dt: float, patience: float) -> tuple[Array, Array]:
    """Drop robots that hold their standing pose; return whether they stay finite, and their speed at rest.

    On ground too soft for them humanoids topple; lying robots have to come to rest as well.
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
    """Return robots of all cells, STARTS of each, on their grounds."""
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
    """Return positions near the standing pose, `height` [m] above it, and random velocities; the same in every cell."""
    rng, cells = np.random.default_rng(0), SHAPE[0] * SHAPE[1]
    q = np.tile(model.standing_q, (STARTS, 1))
    q[:, 2] += height
    q[:, 4:7] = rng.uniform(-0.02, 0.02, (STARTS, 3))
    q[:, 3] = np.sqrt(1.0 - np.sum(q[:, 4:7] ** 2, axis=1))
    q[:, 7:] += rng.uniform(-0.02, 0.02, q[:, 7:].shape)
    return q.repeat(cells, axis=0), rng.normal(0.0, speed, (STARTS, model.nv)).repeat(cells, axis=0)


def worst(x: Array) -> Array:
    """Return the largest value of each cell over its starts, shape SHAPE."""
    return np.asarray(x).reshape(STARTS, *SHAPE).max(axis=0)
