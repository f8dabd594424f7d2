"""The explicit constraints `q = gamma(y)` of a cluster and their derivatives `G` and `g`.

Each cluster has spanning coordinates `q` (one per body, eliminated rotors included), and independent coordinates `y`
among them. The recursions need

    q = gamma(y),   qd = G yd,   qdd = G ydd + g        (constraint-embedding paper, eq. explicit_constraints)

`G` and `g` are derived by automatic differentiation. This file treats clusters with linear constraints only, closure.py
the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ce_gym.dynamics.constraints.closure import Closure
from ce_gym.dynamics.constraints.elimination import eliminate
from ce_gym.model.clusters import Cluster
from ce_gym.model.errors import RobotError

SX = ca.SX


@dataclass(frozen=True)
class LoopState:
    """The accuracy of a cluster's closed loops at one state.

    Attributes:
        guessed: Rows of the dependent coordinates that were computed from a guess.
        gap: Largest residual of the rows that were solved by iteration; 0 if all were solved by formulas.
        nearness: 1 at the reference pose, 0 at a singularity, negative beyond: the smallest determinant of the blocks
            of the constraint Jacobian, relative to the reference pose.
    """

    guessed: tuple[int, ...]
    gap: SX
    nearness: SX


@dataclass(frozen=True)
class ClusterCoordinates:
    """The coordinates of one cluster at one state.

    Attributes:
        index: Row of each body in the spanning quantities, by name; the three rows of a ball joint.
        q: Spanning positions, shape (n,); a quaternion for a ball joint.
        qd: Spanning velocities, shape (n,).
        G: Constraint Jacobian, shape (n, d).
        g: Velocity-product acceleration of the constraint, shape (n,).
        loop: State of the closed loops; None if all constraints are linear.
        second_derivative: Function of a row -> second derivative of that coordinate by y, shape (d, d); None if all
            constraints are linear.
    """

    index: dict[str, Any]
    q: SX
    qd: SX
    G: SX
    g: SX
    loop: LoopState | None = None
    second_derivative: Callable[[int], SX] | None = None

    def position(self, body: str) -> SX:
        """Return the position of the joint that moves a body, a number or a quaternion."""
        row = self.index[body]
        return self.q[row] if isinstance(row, int) else self.q


def ball_coordinates(cluster: Cluster, quaternion: SX, w: SX) -> ClusterCoordinates:
    """Return the coordinates of a ball joint, which is a cluster of its own."""
    return ClusterCoordinates({cluster.bodies[0]: [0, 1, 2]}, quaternion, w, SX.eye(3), SX(3, 1))


def cluster_coordinates(cluster: Cluster, y: SX, yd: SX) -> ClusterCoordinates:
    """Evaluate a cluster's constraint at independent positions `y` (d,) and velocities `yd` (d,)."""
    symbol, rate = SX.sym("y", y.shape[0]), SX.sym("yd", y.shape[0])
    gamma = explicit_constraint(cluster, symbol)
    G = ca.jacobian(gamma, symbol)
    g = ca.jtimes(G @ rate, symbol, rate)
    evaluate = ca.Function("constraint", [symbol, rate], [gamma, ca.densify(G), ca.densify(g)])
    q, G_at, g_at = evaluate(y, yd)
    G_at, g_at = ca.sparsify(G_at), ca.sparsify(g_at)
    return ClusterCoordinates({name: i for i, name in enumerate(cluster.bodies)}, q, G_at @ yd, G_at, g_at)


def loop_coordinates(cluster: Cluster, closure: Closure, y: SX, yd: SX, guess: SX) -> ClusterCoordinates:
    """Evaluate a cluster with closed loops at `y` (d,), `yd` (d,) and a guess of dependent coordinates (n_guess,)."""
    z, gap = closure.locate(y, guess)
    G, g, nearness = closure.rates(y, z, yd)
    G, g = ca.sparsify(G), ca.sparsify(g)
    q, qd = closure.spanning(y, z), G @ yd
    guessed = tuple(closure.assembly.unknown[j] for j in closure.guessed)
    loop = LoopState(guessed, gap, nearness)
    index = {name: i for i, name in enumerate(cluster.bodies)}
    return ClusterCoordinates(index, q, qd, G, g, loop, lambda row: closure.second_derivative(y, z, row))


def with_gear_factor(coordinates: ClusterCoordinates, rotors: dict[str, str], factor: SX | float) -> ClusterCoordinates:
    """Return coordinates with rotor angles, less stretches, scaled by `factor`; no other body depends on rotors."""
    scale = SX.eye(coordinates.q.numel())
    for rotor, stretch in rotors.items():
        row = coordinates.index[rotor]
        scale[row, row] = factor
        if stretch in coordinates.index:
            scale[row, coordinates.index[stretch]] = 1 - factor
    q, qd, g = scale @ coordinates.q, scale @ coordinates.qd, scale @ coordinates.g
    scaled = replace(coordinates, q=q, qd=qd, G=ca.sparsify(scale @ coordinates.G), g=g)
    second = coordinates.second_derivative
    return scaled if second is None else replace(scaled, second_derivative=lambda row: scale[row, row] * second(row))


def explicit_constraint(cluster: Cluster, y: SX) -> SX:
    """Return `gamma(y)`, the spanning coordinates of a cluster, shape (n,)."""
    G, offset = linear_solution(cluster)
    return ca.sparsify(SX(G)) @ y + offset


def linear_solution(cluster: Cluster) -> tuple[np.ndarray, np.ndarray]:
    """Solve the linear constraints of a cluster, `K q = b`, for `q = G y + q0`.

    Returns:
        G, shape (n, d), and q0, shape (n,).

    Raises:
        RobotError: If the independent coordinates do not determine the others.
    """
    solved = eliminate(cluster)
    if solved.unknown or solved.left:
        dependent = ", ".join(name for name in cluster.bodies if name not in cluster.independent)
        raise RobotError(f"cluster of {cluster.bodies[0]!r}: its constraints do not determine {dependent}")
    return solved.B, solved.q0
