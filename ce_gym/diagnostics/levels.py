"""Errors of the simplified transmission levels of a robot, from its mass matrices: `inspect ROBOT --levels`.

All errors are relative to level `exact`, over random poses near the standing pose. With a floating base, `H` is the
inertia of the joints in flight, `H = M_jj - M_jb M_bb^-1 M_bj`; with a fixed base, `H = M`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.diagnostics.transmission import random_states
from ce_gym.dynamics.model import Model
from ce_gym.model.mechanism import LEVELS
from ce_gym.model.table import table_text

Array = NDArray[np.float64]
FOOT = "foot"
"""Group of the contacts whose effective mass is compared; all contacts if the group is empty."""
LIMIT = 0.05
"""A level with errors below this is good enough for most purposes; docs/exactness.md."""
COLUMNS = ("level", "joint torque, worst", "joint frequency, worst", "base turn [deg/rad]", "mass at a foot, worst")


@dataclass(frozen=True)
class Range:
    """Percentiles 5, 50 and 95 over poses."""

    low: float
    median: float
    high: float


@dataclass(frozen=True)
class LevelRow:
    """Errors of one level.

    Attributes:
        level: Transmission level.
        torque: Worst case over all accelerations of the joints: the largest eigenvalue of `H^-1 (H_level - H)` [-].
        frequency: Worst natural frequency of the joints on springs as stiff as the position gains [-].
        base_turn: Rotation of the floating base in flight per rotation of the joints, worst case [-]; a fixed base
            has no such error.
        foot_mass: Effective mass against a vertical impact, worst foot [-]; None without contacts.
    """

    level: str
    torque: Range
    frequency: Range
    base_turn: Range | None
    foot_mass: Range | None


@dataclass(frozen=True)
class LevelReport:
    """Errors of all simplified levels of a robot.

    Attributes:
        robot: Name of the robot.
        carrier_coupling: Largest entry of the exact mass matrix that is the reaction of a spinning rotor on its
            carrier, over the root of the two diagonal entries [-].
        joint_coupling: Largest off-diagonal entry of the reflected inertia, over the same root [-].
        rows: One for each simplified level; none for a robot without rotors.
        poses: Number of poses; 0 for a robot without rotors.
        unknown_ratios: Rotors whose gear ratio is not in the robot's file; their reaction on carriers is not counted.
    """

    robot: str
    carrier_coupling: Range
    joint_coupling: Range
    rows: tuple[LevelRow, ...]
    poses: int
    unknown_ratios: tuple[str, ...] = ()


def levels_report(model: Model, poses: int = 200) -> str:
    """Return the errors of the simplified levels of a robot as plain text.

    Args:
        model: Any model of the robot; its level does not matter.
        poses: Number of random poses.
    """
    return as_text(compare_levels(model, poses))


def compare_levels(model: Model, poses: int = 200, seed: int = 0) -> LevelReport:
    """Compute the errors of the simplified levels of a robot.

    Args:
        model: Any model of the robot; its level does not matter.
        poses: Number of random poses.
        seed: Seed of the poses.
    """
    models = {level: Model(model.robot, level) for level in LEVELS}
    zero = Range(0.0, 0.0, 0.0)
    if not any(True for _ in model.robot.rotors()):
        return LevelReport(model.robot.name, zero, zero, (), 0)
    q, _, _ = random_states(models["exact"], poses, np.random.default_rng(seed))
    M = {level: at_level.mass_matrix(q) for level, at_level in models.items()}
    roots = np.sqrt(np.diagonal(M["exact"], axis1=1, axis2=2))
    scale = roots[:, :, None] * roots[:, None, :]
    dropped = M["exact"] - M["coupled"], M["coupled"] - M["armature"]
    carrier_coupling, joint_coupling = (_range(np.abs(entries / scale).max((1, 2))) for entries in dropped)
    feet = foot_jacobian(models["exact"], q)
    rows = tuple(level_row(models["exact"], level, M, feet) for level in LEVELS[1:])
    return LevelReport(model.robot.name, carrier_coupling, joint_coupling, rows, len(q), model.robot.unknown_ratios)


def level_row(model: Model, level: str, M: Mapping[str, Array], feet: Array) -> LevelRow:
    """Compare a level with the exact one.

    Args:
        model: Exact model of the robot.
        level: Level to compare.
        M: Mass matrices at every level, shape (n, nv, nv).
        feet: Jacobian of the heights of the feet, shape (n, n_feet, nv).
    """
    base = model.robot.layout.joints_v
    (H, turn), (H_level, turn_level) = (flight_inertia(M[name], base) for name in ("exact", level))
    kp = dict(model.robot.gains.kp) | {name: model.robot.body(name).joint.stiffness for name in model.robot.passive}
    springs = np.array([kp.get(name, 0.0) for name in model.joint_links])
    springs = springs if (springs > 0).all() else np.diagonal(H, axis1=1, axis2=2).mean(0)
    torque = np.abs(np.linalg.eigvals(np.linalg.solve(H, H_level - H)).real).max(-1)
    frequency = np.abs(natural_frequencies(H_level, springs) / natural_frequencies(H, springs) - 1).max(-1)
    base_turn, foot_mass = None, None
    if model.robot.floating:
        base_turn = _range(np.linalg.norm((turn_level - turn)[:, :3], ord=2, axis=(1, 2)))
    if feet.shape[1]:
        foot_mass = _range(np.abs(foot_masses(M[level], feet) / foot_masses(M["exact"], feet) - 1).max(-1))
    return LevelRow(level, _range(torque), _range(frequency), base_turn, foot_mass)


def flight_inertia(M: Array, base: int) -> tuple[Array, Array]:
    """Return the inertia of the joints in flight, and the velocity of the base per velocity of the joints.

    Args:
        M: Mass matrices, shape (n, nv, nv).
        base: Number of velocities of a floating base and of ball joints, which come first and are free.

    Returns:
        Shapes (n, nj, nj) and (n, base, nj).
    """
    if not base:
        return M, np.zeros((len(M), 0, M.shape[-1]))
    turn = -np.asarray(np.linalg.solve(M[:, :base, :base], M[:, :base, base:]), dtype=float)
    return M[:, base:, base:] + M[:, base:, :base] @ turn, turn


def natural_frequencies(H: Array, springs: Array) -> Array:
    """Return the natural frequencies of joints on springs, ascending, shape (n, nj) [rad/s]."""
    root = np.sqrt(springs)
    return 1.0 / np.sqrt(np.linalg.eigvalsh(H / (root[:, None] * root))[:, ::-1])


def foot_masses(M: Array, feet: Array) -> Array:
    """Return the effective mass of each foot alone against a vertical impact, shape (n, n_feet) [kg]."""
    return 1.0 / np.einsum("nfi,nif->nf", feet, np.linalg.solve(M, np.swapaxes(feet, 1, 2)))


def foot_jacobian(model: Model, q: Array) -> Array:
    """Return the Jacobian of the heights of the feet at positions (n, nq), shape (n, n_feet, nv)."""
    unit = np.broadcast_to(np.eye(model.nv), (len(q), model.nv, model.nv))
    if not model.robot.contacts:
        return np.zeros((len(q), 0, model.nv))
    velocities = model.contact_points(np.broadcast_to(q[:, None], (*unit.shape[:2], q.shape[1])), unit)[1]
    feet = [i for i, contact in enumerate(model.robot.contacts) if contact.group == FOOT]
    return np.swapaxes(velocities[..., feet or slice(None), 2], 1, 2)


def as_text(report: LevelReport) -> str:
    """Return a report as plain text."""
    if not report.rows:
        return f"{report.robot} has no rotors: all transmission levels are the same."
    rows = [
        (row.level, _percents(row.torque), _percents(row.frequency), _degrees(row.base_turn), _percents(row.foot_mass))
        for row in report.rows
    ]
    return "\n".join(
        [
            f"Errors of the simplified levels of {report.robot}, over {report.poses} poses: percentiles 5 to 95",
            table_text(COLUMNS, rows),
            f"  Reaction of rotors on their carriers: {_percents(report.carrier_coupling)} of the coupled inertias;",
            f"  reflected inertia between joints: {_percents(report.joint_coupling)}.",
            f"  Is armature enough (torque errors below {LIMIT:.0%} in any direction)? {verdict(report)}",
        ]
    )


def verdict(report: LevelReport) -> str:
    """Return whether level `armature` is enough for the torques of this robot."""
    if report.unknown_ratios:
        names = ", ".join(report.unknown_ratios[:3]) + (" and more" if len(report.unknown_ratios) > 3 else "")
        return f"Unknown: the robot's file does not give the gear ratio of {names}."
    torque = next(row.torque for row in report.rows if row.level == "armature")
    if torque.high < LIMIT:
        return "Yes."
    return "No." if torque.low > LIMIT else "In some poses."


def _percents(errors: Range | None) -> str:
    return "" if errors is None else f"{100 * errors.low:.2g} to {100 * errors.high:.2g} %"


def _degrees(errors: Range | None) -> str:
    return "" if errors is None else f"{57.29578 * errors.low:.2g} to {57.29578 * errors.high:.2g}"


def _range(values: Array) -> Range:
    return Range(*(float(x) for x in np.percentile(values, (5, 50, 95))))
