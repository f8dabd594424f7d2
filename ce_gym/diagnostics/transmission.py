"""Rotors, gear ratios and reflected inertias of a robot, and the acceleration errors of the simplified levels.

All values come from public quantities of `Model`: the constraint Jacobian `G` from spanning velocities, the reflected
inertia `G_r^T J G_r` from `G`, and the error of a level from its accelerations and the exact ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.model.clusters import Cluster
from ce_gym.model.mechanism import LEVELS, EliminatedRotor, is_axisymmetric
from ce_gym.model.table import Cell, table_text

Array = NDArray[np.float64]

POSITION_SPREAD = 0.3
"""Sampled joint positions differ from the standing pose by up to this [rad or m]."""
SPEED_SPREAD = 3.0
"""Standard deviation of sampled velocities [rad/s or m/s]."""
ACCELERATION_SPREAD = 30.0
"""Standard deviation of the accelerations whose inverse dynamics gives sampled forces [rad/s^2 or m/s^2]."""

LEAST_NEARNESS = 0.1
"""Smallest distance of sampled closed loops from singularities, relative to the standing pose [-]."""
LARGEST_GAP = 1e-9
"""Sampled positions close all loops to this [m]."""
DROPPED = {
    "exact": "nothing",
    "coupled": "reaction of spinning rotors on their carriers, gyroscopic torque",
    "armature": "that, and the off-diagonal reflected inertia",
    "none": "that, and the diagonal reflected inertia",
}
"""What each level neglects."""


@dataclass(frozen=True)
class RotorRow:
    """One rotor.

    Attributes:
        name: Name of the rotor.
        carrier: Name of the body that carries the rotor; None for the world.
        inertia: Moment of inertia about the spin axis [kg m^2].
        ratios: Speed of the rotor per speed of each independent joint that turns the rotor, by joint.
        symmetric: Whether the inertia is symmetric about the spin axis.
        known: Whether the robot's file gives the gear ratio; if not, `inertia` and `ratios` are placeholders.
    """

    name: str
    carrier: str | None
    inertia: float
    ratios: Mapping[str, float]
    symmetric: bool
    known: bool = True


@dataclass(frozen=True)
class ClusterInertia:
    """The joints of one cluster with rotors.

    Attributes:
        joints: Independent joints.
        rotors: Rotors.
        reflected: Reflected inertia `sum(G_r^T J G_r)` [kg m^2], shape (d, d).
        inertia: The joints' block of the mass matrix, rotors included [kg m^2], shape (d, d).
    """

    joints: tuple[str, ...]
    rotors: tuple[RotorRow, ...]
    reflected: Array
    inertia: Array

    @property
    def share(self) -> Array:
        """Part of each joint's inertia that is reflected by rotors [-], shape (d,)."""
        return np.diag(self.reflected) / np.diag(self.inertia)


@dataclass(frozen=True)
class Spread:
    """Relative error over random states: `|vdot - vdot_exact| / |vdot_exact|` [-]."""

    median: float
    max: float


@dataclass(frozen=True)
class LevelError:
    """Acceleration errors of a transmission level.

    Attributes:
        level: Transmission level.
        joints: Error of the joints' accelerations.
        base: Error of the floating base's acceleration; None for a fixed base.
    """

    level: str
    joints: Spread
    base: Spread | None


@dataclass(frozen=True)
class TransmissionReport:
    """The transmissions of a robot and the errors of the simplified levels.

    Attributes:
        robot: Name of the robot.
        clusters: Clusters with rotors, base to tip, in the standing pose.
        without_rotors: Independent joints that turn no rotor.
        errors: One for each simplified level; empty if no states were sampled or there are no rotors.
        states: Number of random states of the comparison.
    """

    robot: str
    clusters: tuple[ClusterInertia, ...]
    without_rotors: tuple[str, ...]
    errors: tuple[LevelError, ...]
    states: int


def transmission_report(model: Model, states: int = 200) -> str:
    """Return the transmissions of a robot and the errors of the simplified levels as plain text.

    Args:
        model: Any model of the robot; its level does not matter.
        states: Number of random states in which the levels are compared; zero omits the comparison.
    """
    return as_text(analyse_transmissions(model, states))


def analyse_transmissions(model: Model, states: int = 200, seed: int = 0) -> TransmissionReport:
    """Compute the transmission report of a robot.

    Args:
        model: Any model of the robot; its level does not matter.
        states: Number of random states in which the levels are compared; zero omits the comparison.
        seed: Seed of the random states.
    """
    return analyse_models({level: Model(model.robot, level) for level in LEVELS}, states, seed)


def analyse_models(models: Mapping[str, Model], states: int = 200, seed: int = 0) -> TransmissionReport:
    """Compute the transmission report of a robot from its models at all levels; see `analyse_transmissions`."""
    exact = models["exact"]
    clusters = cluster_inertias(exact, models["coupled"])
    geared = {joint for cluster in clusters for joint in cluster.joints}
    q, v, tau = random_states(exact, states if clusters else 0, np.random.default_rng(seed))
    return TransmissionReport(
        robot=exact.robot.name,
        clusters=clusters,
        without_rotors=tuple(joint for joint in exact.joint_links if joint not in geared),
        errors=level_errors(models, q, v, tau) if len(q) else (),
        states=len(q),
    )


def cluster_inertias(exact: Model, coupled: Model) -> tuple[ClusterInertia, ...]:
    """Return all clusters with rotors, base to tip, from models at two levels: `coupled` eliminates every rotor."""
    G = rotor_jacobian(exact)
    M = exact.mass_matrix(exact.standing_q)
    pairs = zip(coupled.cluster_tree.clusters, coupled.mechanism.eliminated_rotors, strict=True)
    return tuple(_cluster_inertia(exact, cluster, spins, G, M) for cluster, spins in pairs if spins)


def rotor_jacobian(model: Model) -> dict[str, Array]:
    """Return the row of `G` of every one-degree-of-freedom joint at the standing pose, by body, shape (nv,) each."""
    _, v_span = model.spanning(model.standing_q, np.eye(model.nv))  # v_span = G v, one independent velocity a row
    rows = {name: rows for name, (_, rows) in model.robot.spanning_rows.items() if len(rows) == 1}
    return {name: v_span[:, row] for name, (row,) in rows.items()}


def level_errors(models: Mapping[str, Model], q: Array, v: Array, tau: Array) -> tuple[LevelError, ...]:
    """Compare accelerations of the simplified levels with exact ones, in the same states under the same forces.

    Args:
        models: A model of each level.
        q: Positions, shape (n, nq).
        v: Velocities, shape (n, nv).
        tau: Generalised forces [N m or N], shape (n, nv).
    """
    exact = models["exact"]
    reference = exact.forward_dynamics(q, v, tau)
    base = exact.robot.layout.base_nv
    errors = []
    for level in LEVELS[1:]:
        error = models[level].forward_dynamics(q, v, tau) - reference
        base_error = _spread(error[:, :base], reference[:, :base]) if base else None
        errors.append(LevelError(level, _spread(error[:, base:], reference[:, base:]), base_error))
    return tuple(errors)


def random_states(model: Model, count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return random positions (n, nq), velocities (n, nv) and generalised forces (n, nv).

    Joints are near the standing pose and inside their limits. Positions at which loops cannot close, or are close to a
    singularity, are rejected, so `n` may be less than `count`. Forces are the inverse dynamics of random accelerations,
    without the wrench on a floating base.
    """
    limits = np.array([model.robot.body(name).joint.position for name in model.joint_links])
    base = model.nq - len(limits)
    q = np.tile(model.standing_q, (count, 1))
    q[:, base:] += rng.uniform(-POSITION_SPREAD, POSITION_SPREAD, (count, len(limits)))
    q[:, base:] = np.clip(q[:, base:], limits[:, 0], limits[:, 1])
    if not all(constraint.linear for constraint in model.robot.constraints):
        q = q[[_closes(model, row) for row in q]]
    v = rng.normal(0.0, SPEED_SPREAD, (len(q), model.nv))
    tau = model.inverse_dynamics(q, v, rng.normal(0.0, ACCELERATION_SPREAD, v.shape))
    if model.robot.floating:
        tau[:, :6] = 0.0
    return q, v, tau


def as_text(report: TransmissionReport) -> str:
    """Return a report as plain text."""
    if not report.clusters:
        return f"{report.robot} has no rotors: all transmission levels are the same."
    rotors = [rotor for cluster in report.clusters for rotor in cluster.rotors]
    columns = ("rotor", "carried by", "ratio", "inertia [kg m^2]", "symmetric")
    lines = ["Rotors: speed per speed of the joints", table_text(columns, [_rotor_cells(rotor) for rotor in rotors])]
    if not all(rotor.known for rotor in rotors):
        lines += [
            "  unknown: the robot's file gives the reflected inertia but no gear ratio, so `exact` equals `coupled`;",
            "  `gears:` in a YAML file gives the ratio.",
        ]
    lines += [
        "",
        "Reflected inertia G_r^T J G_r [kg m^2], and its share of the joint's whole inertia",
        _reflected_table(report.clusters),
    ]
    if report.without_rotors:
        lines += ["", f"Without rotors: {', '.join(report.without_rotors)}"]
    return "\n".join([*lines, "", *_level_lines(report)])


def _closes(model: Model, q: Array) -> bool:
    """Whether closed loops can be assembled at a position (nq,), far enough from singularities."""
    try:
        return bool(model.loop_gap(q) < LARGEST_GAP and model.nearness(q) > LEAST_NEARNESS)  # a gap may be NaN
    except ValueError:
        return False


def _cluster_inertia(
    model: Model, cluster: Cluster, eliminated: tuple[EliminatedRotor, ...], G: dict[str, Array], M: Array
) -> ClusterInertia:
    first = model.nv - len(model.joint_links)
    columns = [first + model.joint_links.index(joint) for joint in cluster.independent]
    rows = np.array([G[rotor.name][columns] for rotor in eliminated])
    rotors = tuple(
        RotorRow(
            rotor.name,
            rotor.carrier,
            rotor.inertia,
            {joint: float(ratio) for joint, ratio in zip(cluster.independent, row, strict=True) if ratio != 0.0},
            is_axisymmetric(model.robot.body(rotor.name)),
            rotor.name not in model.robot.unknown_ratios,
        )
        for rotor, row in zip(eliminated, rows, strict=True)
    )
    inertias = np.diag([rotor.inertia for rotor in eliminated])
    return ClusterInertia(cluster.independent, rotors, rows.T @ inertias @ rows, M[np.ix_(columns, columns)])


def _spread(error: Array, reference: Array) -> Spread:
    relative = np.linalg.norm(error, axis=1) / np.linalg.norm(reference, axis=1)
    return Spread(float(np.median(relative)), float(relative.max()))


def _rotor_cells(rotor: RotorRow) -> tuple[Cell, ...]:
    symmetric, carrier = "yes" if rotor.symmetric else "no", rotor.carrier or "world"
    if not rotor.known:
        return rotor.name, carrier, "unknown", "unknown", symmetric
    terms = [f"{'-' if ratio < 0 else '+'} {abs(ratio):.4g} {joint}" for joint, ratio in rotor.ratios.items()]
    return rotor.name, carrier, " ".join(terms).removeprefix("+ "), rotor.inertia, symmetric


def _reflected_table(clusters: tuple[ClusterInertia, ...]) -> str:
    width = max(len(cluster.joints) for cluster in clusters)
    rows: list[tuple[Cell, ...]] = []
    for cluster in clusters:
        for joint, line, share in zip(cluster.joints, cluster.reflected, cluster.share, strict=True):
            cells = [f"{x:.7f}" for x in line] + [None] * (width - len(line))
            rows.append((joint, f"{100 * share:.1f} %", *cells))
    blanks = [""] * (width - 1)
    return table_text(("joint", "share", "row of the matrix", *blanks), rows)


def _level_lines(report: TransmissionReport) -> list[str]:
    if not report.errors:
        return ["What each level drops", table_text(("level", "drops"), list(DROPPED.items()))]
    zero = Spread(0.0, 0.0)
    floating = report.errors[0].base is not None
    columns = ["level", "drops", "joints, median", "max", *(["base, median", "max"] if floating else [])]
    rows: list[list[Cell]] = []
    for error in (LevelError("exact", zero, zero if floating else None), *report.errors):
        spreads = [spread for spread in (error.joints, error.base) if spread]
        percents = [_percent(value) for spread in spreads for value in (spread.median, spread.max)]
        rows.append([error.level, DROPPED[error.level], *percents])
    return [
        f"What each level drops, and its error |vdot - vdot_exact| / |vdot_exact| over {report.states} random states",
        table_text(columns, rows),
        f"  States: joints within {POSITION_SPREAD} of the standing pose, velocities N(0, {SPEED_SPREAD}), forces for",
        f"  accelerations N(0, {ACCELERATION_SPREAD}), no wrench on a floating base.",
    ]


def _percent(value: float) -> str:
    return f"{100 * value:.0f} %" if value >= 1.0 else f"{100 * value:.3g} %"
