"""What each simplified level gets wrong of one robot, from its mass matrices alone: the row of any robot.

All errors are relative to the exact level, in random poses near the standing one. With the base free, what counts for
the joints is their inertia in flight, `H = M_jj - M_jb M_bb^-1 M_bj`; a fixed base has `H = M`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.diagnostics.transmission import random_states
from ce_gym.dynamics.model import Model
from ce_gym.model.mechanism import LEVELS

Array = NDArray[np.float64]
FOOT = "foot"
"""Group of the contacts whose effective mass is compared; all contacts if it is empty."""


@dataclass(frozen=True)
class Range:
    """Percentiles 5, 50 and 95 over poses."""

    low: float
    middle: float
    high: float


@dataclass(frozen=True)
class LevelRow:
    """What a level gets wrong of a robot.

    Attributes:
        level: Transmission level.
        torque: Worst case over all accelerations of the joints: the largest eigenvalue of `H^-1 (H_level - H)` [-].
        frequency: Worst natural frequency of the joints on springs, the robot's position gains [-].
        turn: Turn of the floating base in flight per turn of the joints, worst case [-]; None for a fixed base.
        mass: Effective mass against a vertical impact, worst foot [-]; None without contacts.
    """

    level: str
    torque: Range
    frequency: Range
    turn: Range | None
    mass: Range | None


@dataclass(frozen=True)
class LevelReport:
    """What every simplified level gets wrong of a robot.

    Attributes:
        robot: Its name.
        carried: Largest entry of the exact mass matrix that is reaction of a spinning rotor on what carries it, over
            the root of the two diagonal entries [-].
        shared: The same of reflected inertia off the diagonal, where a rotor turns with several joints [-].
        rows: One for each simplified level.
        poses: How many poses the figures are over; 0 for a robot without rotors, which has no rows.
        unknown: Rotors whose gear ratio the robot's file does not say; what they do to what carries them is left out.
    """

    robot: str
    carried: Range
    shared: Range
    rows: tuple[LevelRow, ...]
    poses: int
    unknown: tuple[str, ...] = ()


def report_levels(model: Model, poses: int = 200, seed: int = 0) -> LevelReport:
    """Work out the report of a model's robot; the level of the model itself does not matter.

    Args:
        model: Any model of the robot.
        poses: Number of random poses.
        seed: Of the poses.
    """
    models = {level: Model(model.robot, level) for level in LEVELS}
    nothing = Range(0.0, 0.0, 0.0)
    if not any(True for _ in model.robot.rotors()):
        return LevelReport(model.robot.name, nothing, nothing, (), 0)
    q, _, _ = random_states(models["exact"], poses, np.random.default_rng(seed))
    M = {level: one.mass_matrix(q) for level, one in models.items()}
    size = np.sqrt(np.diagonal(M["exact"], axis1=1, axis2=2))
    relative = size[:, :, None] * size[:, None, :]
    off_level = M["exact"] - M["coupled"], M["coupled"] - M["armature"]
    carried, shared = (_range(np.abs(x / relative).max((1, 2))) for x in off_level)
    feet = foot_rows(models["exact"], q)
    rows = tuple(level_row(models["exact"], level, M, feet) for level in LEVELS[1:])
    return LevelReport(model.robot.name, carried, shared, rows, len(q), model.robot.unknown_ratios)


def level_row(model: Model, level: str, M: Mapping[str, Array], feet: Array) -> LevelRow:
    """Compare a level with the exact one.

    Args:
        model: Of the robot.
        level: To compare.
        M: Mass matrices at every level, shape (n, nv, nv).
        feet: Jacobian of the heights of the feet, shape (n, n_feet, nv).
    """
    base = model.robot.layout.joints_v
    (H, turn), (H_level, turn_level) = (in_flight(M[one], base) for one in ("exact", level))
    kp = dict(model.robot.gains.kp) | {name: model.robot.body(name).joint.stiffness for name in model.robot.passive}
    springs = np.array([kp.get(name, 0.0) for name in model.joint_links])
    springs = springs if (springs > 0).all() else np.diagonal(H, axis1=1, axis2=2).mean(0)
    torque = np.abs(np.linalg.eigvals(np.linalg.solve(H, H_level - H)).real).max(-1)
    frequency = np.abs(frequencies(H_level, springs) / frequencies(H, springs) - 1).max(-1)
    turned = np.linalg.norm((turn_level - turn)[:, :3], ord=2, axis=(1, 2)) if model.robot.floating else None
    mass = np.abs(masses(M[level], feet) / masses(M["exact"], feet) - 1).max(-1) if feet.shape[1] else None
    optional = (None if x is None else _range(x) for x in (turned, mass))
    return LevelRow(level, _range(torque), _range(frequency), *optional)


def in_flight(M: Array, base: int) -> tuple[Array, Array]:
    """Return the inertia of the joints with the first `base` coordinates free, and how these move with them.

    Shapes (n, nj, nj) and (n, base, nj): of a floating base and of ball joints.
    """
    if not base:
        return M, np.zeros((len(M), 0, M.shape[-1]))
    turn = -np.asarray(np.linalg.solve(M[:, :base, :base], M[:, :base, base:]), dtype=float)
    return M[:, base:, base:] + M[:, base:, :base] @ turn, turn


def frequencies(H: Array, springs: Array) -> Array:
    """Return the natural frequencies of joints on springs, ascending, shape (n, nj) [rad/s]."""
    root = np.sqrt(springs)
    return 1.0 / np.sqrt(np.linalg.eigvalsh(H / (root[:, None] * root))[:, ::-1])


def masses(M: Array, feet: Array) -> Array:
    """Return the mass that each foot alone opposes to a vertical impact, shape (n, n_feet) [kg]."""
    return 1.0 / np.einsum("nfi,nif->nf", feet, np.linalg.solve(M, np.swapaxes(feet, 1, 2)))


def foot_rows(model: Model, q: Array) -> Array:
    """Return the Jacobian of the heights of the feet, shape (n, n_feet, nv)."""
    unit = np.broadcast_to(np.eye(model.nv), (len(q), model.nv, model.nv))
    if not model.robot.contacts:
        return np.zeros((len(q), 0, model.nv))
    velocities = model.contact_points(np.broadcast_to(q[:, None], (*unit.shape[:2], q.shape[1])), unit)[1]
    feet = [i for i, contact in enumerate(model.robot.contacts) if contact.group == FOOT]
    return np.swapaxes(velocities[..., feet or slice(None), 2], 1, 2)


def _range(values: Array) -> Range:
    return Range(*(float(x) for x in np.percentile(values, (5, 50, 95))))
