"""What the transmissions of a robot are, and what each transmission level loses of them, in figures.

Everything comes from the public quantities of `Model`: the constraint Jacobian `G` from spanning velocities, the
reflected inertia `G_r^T J G_r` from it, and the price of a level from its accelerations beside the exact ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.model.clusters import Cluster
from ce_gym.model.mechanism import LEVELS, EliminatedRotor, is_axisymmetric

Array = NDArray[np.float64]

POSITION_SPREAD = 0.3
"""Sampled joint positions differ from the standing pose by up to this [rad or m]."""
SPEED_SPREAD = 3.0
"""Standard deviation of sampled velocities [rad/s or m/s]."""
ACCELERATION_SPREAD = 30.0
"""Standard deviation of the accelerations whose inverse dynamics gives sampled forces [rad/s^2 or m/s^2]."""

LEAST_NEARNESS = 0.1
"""Sampled positions of closed loops are at least this far from singularities; the standing pose is at 1."""
LARGEST_GAP = 1e-9
"""Sampled positions close all loops to this [m]."""


@dataclass(frozen=True)
class RotorFigures:
    """One rotor.

    Attributes:
        name: Name of the rotor.
        carrier: Name of the body it is mounted on; None is the world.
        inertia: Moment of inertia about its spin axis [kg m^2].
        ratios: Speed of the rotor for unit speed of each independent joint that turns it, by joint.
        symmetric: Whether its inertia is symmetric about its spin axis.
        known: Whether the robot's file says the gear ratio; if not, `inertia` and `ratios` are placeholders.
    """

    name: str
    carrier: str | None
    inertia: float
    ratios: Mapping[str, float]
    symmetric: bool
    known: bool = True


@dataclass(frozen=True)
class ClusterFigures:
    """The joints of one cluster that has rotors.

    Attributes:
        joints: Its independent joints.
        rotors: Its rotors.
        reflected: Reflected inertia `sum(G_r^T J G_r)` [kg m^2], shape (d, d).
        inertia: The joints' block of the mass matrix, rotors included [kg m^2], shape (d, d).
    """

    joints: tuple[str, ...]
    rotors: tuple[RotorFigures, ...]
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
    """What a transmission level gets wrong.

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
    """The transmissions of a robot and what the levels make of them.

    Attributes:
        robot: Name of the robot.
        clusters: Clusters with rotors, base to tip. Ratios and inertias are those of the standing pose.
        without_rotors: Independent joints that no rotor turns with.
        errors: One for each approximate level; empty if no states were sampled or there are no rotors.
        states: Number of random states that the errors are over.
    """

    robot: str
    clusters: tuple[ClusterFigures, ...]
    without_rotors: tuple[str, ...]
    errors: tuple[LevelError, ...]
    states: int


def report_transmissions(model: Model, states: int = 200, seed: int = 0) -> TransmissionReport:
    """Work out the transmission report of a model's robot; the level of the model itself does not matter.

    Args:
        model: Any model of the robot.
        states: Number of random states to compare the levels in; zero leaves that out.
        seed: Seed of the random states.
    """
    return report_levels({level: Model(model.robot, level) for level in LEVELS}, states, seed)


def report_levels(models: Mapping[str, Model], states: int = 200, seed: int = 0) -> TransmissionReport:
    """Work out the transmission report of a robot from its models at all levels; see `report_transmissions`."""
    clusters = cluster_figures(models["exact"], models["coupled"])
    turned = {joint for cluster in clusters for joint in cluster.joints}
    q, v, tau = random_states(models["exact"], states if clusters else 0, np.random.default_rng(seed))
    return TransmissionReport(
        robot=models["exact"].robot.name,
        clusters=clusters,
        without_rotors=tuple(joint for joint in models["exact"].joint_links if joint not in turned),
        errors=level_errors(models, q, v, tau) if len(q) else (),
        states=len(q),
    )


def cluster_figures(exact: Model, coupled: Model) -> tuple[ClusterFigures, ...]:
    """Return the figures of every cluster with rotors, base to tip; the coupled model eliminates every rotor."""
    G = jacobian(exact)
    M = exact.mass_matrix(exact.standing_q)
    pairs = zip(coupled.cluster_tree.clusters, coupled.mechanism.eliminated_rotors, strict=True)
    return tuple(_figures(exact, cluster, eliminated, G, M) for cluster, eliminated in pairs if eliminated)


def jacobian(model: Model) -> dict[str, Array]:
    """Return the row of `G` of every one-degree-of-freedom joint at the standing pose, by body, shape (nv,) each."""
    _, v_span = model.spanning(model.standing_q, np.eye(model.nv))  # v_span = G v, one independent velocity a row
    rows = {name: rows for name, (_, rows) in model.robot.spanning_rows.items() if len(rows) == 1}
    return {name: v_span[:, row] for name, (row,) in rows.items()}


def level_errors(models: Mapping[str, Model], q: Array, v: Array, tau: Array) -> tuple[LevelError, ...]:
    """Compare accelerations at the approximate levels with exact ones, in the same states under the same forces.

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
        on_base = _spread(error[:, :base], reference[:, :base]) if base else None
        errors.append(LevelError(level, _spread(error[:, base:], reference[:, base:]), on_base))
    return tuple(errors)


def random_states(model: Model, count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return random positions (n, nq), velocities (n, nv) and generalised forces (n, nv).

    Joints are near the standing pose and inside their limits; positions at which closed loops would come apart or be
    near a singularity are left out, so `n` may be less than `count`. Forces are those that random accelerations would
    take, but with no wrench on a floating base.
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


def _closes(model: Model, q: Array) -> bool:
    """Whether closed loops can be assembled at a position (nq,), well away from singularities."""
    try:
        return bool(model.loop_gap(q) < LARGEST_GAP and model.nearness(q) > LEAST_NEARNESS)  # a gap may be NaN
    except ValueError:
        return False


def _figures(
    model: Model, cluster: Cluster, eliminated: tuple[EliminatedRotor, ...], G: dict[str, Array], M: Array
) -> ClusterFigures:
    first = model.nv - len(model.joint_links)
    columns = [first + model.joint_links.index(joint) for joint in cluster.independent]
    rows = np.array([G[rotor.name][columns] for rotor in eliminated])
    rotors = tuple(
        RotorFigures(
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
    return ClusterFigures(cluster.independent, rotors, rows.T @ inertias @ rows, M[np.ix_(columns, columns)])


def _spread(error: Array, reference: Array) -> Spread:
    relative = np.linalg.norm(error, axis=1) / np.linalg.norm(reference, axis=1)
    return Spread(float(np.median(relative)), float(relative.max()))
