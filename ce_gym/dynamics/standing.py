"""Numerical checks of a mechanism in its standing pose, before its functions are traced.

The mass matrix is the sum `J^T I J` over bodies, each body's Jacobian `J` computed from its parent's, plus the inertia
of eliminated rotors (see recursion/rotors.py). It is independent of the mass matrix that `Model` traces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.constraints.closure import Closure, closures
from ce_gym.dynamics.constraints.cluster_constraints import linear_solution
from ce_gym.model.clusters import Cluster
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, invalid_value
from ce_gym.model.frames import rotation_matrix
from ce_gym.model.mechanism import EliminatedRotor, Mechanism, MovingBody, skew

Array = NDArray[np.float64]

SMALLEST_EIGENVALUE = 1e-12
"""Smallest allowed eigenvalue of the mass matrix scaled to ones on its diagonal; below, accelerations are noise [-]."""
LARGEST_CONDITION = 1e14
"""Largest allowed condition number of the mass matrix; above, accelerations have less than two digits [-]."""
DEEPEST_CONTACT = 0.01
"""Largest allowed depth of contacts below ground in the standing pose [m]."""
FURTHEST_BEYOND = 0.01
"""Tolerance of limits of dependent joints, because loops are assembled from rounded numbers [rad or m]."""


@dataclass
class Standing:
    """A mechanism in its standing pose.

    Attributes:
        q: Joint coordinates by body [rad or m], without floating base and ball joints.
        G: Rows of the constraint Jacobian by body, shape (nv,) each, without floating base and ball joints.
        R: Rotations, body to world, by body.
        p: Origins in the world [m], by body.
        J: Spatial velocities in body axes for unit independent velocities, shape (6, nv), by body.
    """

    q: dict[str, float]
    G: dict[str, Array]
    R: dict[str | None, Array]
    p: dict[str | None, Array]
    J: dict[str | None, Array]


def check_standing(mechanism: Mechanism) -> None:
    """Check that the standing pose is possible and that every motion from it moves some mass.

    Raises:
        RobotError: The mass matrix is not positive definite, a dependent joint is beyond its limits, or contacts are
            far below ground.
    """
    standing = standing_pose(mechanism)
    file = mechanism.robot.source or mechanism.robot.name
    for body in mechanism.robot.bodies:
        (lower, upper), angle = body.joint.position, standing.q.get(body.name, 0.0)
        if not lower - FURTHEST_BEYOND <= angle <= upper + FURTHEST_BEYOND:
            expected = f"a standing pose that keeps every joint within its limits, here {lower:g} to {upper:g}"
            raise invalid_value(file, f"joint {body.name!r} in the standing pose", angle, expected)
    _check_mass_matrix(mechanism, mass_matrix(mechanism, standing), file)
    placed = mechanism.robot.floating and mechanism.robot.pose.height != 0.0  # 0 is the default height
    heights = contact_heights(mechanism.robot, standing)
    lowest = min(heights, key=heights.__getitem__, default="")
    if placed and heights and heights[lowest] < -DEEPEST_CONTACT:
        height = mechanism.robot.pose.height
        expected = f"{height - heights[lowest]:.4f}, at which contact {lowest!r} touches the ground"
        raise invalid_value(file, "pose.height", height, expected)


def contact_heights(robot: Robot, standing: Standing) -> dict[str, float]:
    """Return the height of the lowest point of each contact above flat ground in the standing pose [m], by name."""
    return {c.name: c.lowest_point(standing.p[c.body], standing.R[c.body]) for c in robot.contacts}


def _check_mass_matrix(mechanism: Mechanism, M: Array, file: str) -> None:
    joints = mechanism.robot.rows.items()
    free = mechanism.robot.layout.base_nv  # rows of the base come first
    names = ["the floating base" if row < free else name for name, (_, rows) in joints for row in rows]
    scale = np.sqrt(np.diag(M).clip(1e-300))
    if np.isfinite(M).all():
        values, vectors = np.linalg.eigh(M / scale[:, None] / scale)
        if values[0] > SMALLEST_EIGENVALUE and (np.diag(M) > 0.0).all():
            _check_condition(M, names, file)
            return
        moving = np.abs(vectors[:, 0])
    else:
        moving = (~np.isfinite(M)).any(axis=0).astype(float)
    joints = dict.fromkeys(name for name, x in zip(names, moving, strict=True) if x > 0.1 * moving.max())
    raise RobotError(
        f"{file}: the mass matrix at the standing pose is not positive definite in {', '.join(list(joints)[:6])}: "
        f"expected mass or inertia that every motion of the joints moves, and gear ratios that leave it visible"
    )


def _check_condition(M: Array, names: list[str], file: str) -> None:
    values, vectors = np.linalg.eigh(M)
    if not values[-1] <= LARGEST_CONDITION * values[0]:
        light, heavy = (names[int(np.abs(vectors[:, i]).argmax())] for i in (0, -1))
        raise RobotError(
            f"{file}: the mass matrix at the standing pose has eigenvalues from {values[0]:.1e} ({light}) to "
            f"{values[-1]:.1e} ({heavy}): expected a ratio of at most {LARGEST_CONDITION:g}; check the units "
            f"of masses, inertias and gear ratios"
        )


def standing_pose(mechanism: Mechanism) -> Standing:
    """Place all bodies of a mechanism in its standing pose, base to tip."""
    rows, nv = {name: list(rows) for name, (_, rows) in mechanism.robot.rows.items()}, mechanism.robot.layout.nv
    standing = Standing({}, {}, {None: np.eye(3)}, {None: np.zeros(3)}, {None: np.zeros((6, nv))})
    for cluster, closure in zip(mechanism.tree.clusters, closures(mechanism), strict=True):
        first = cluster.bodies[0]
        if mechanism.robot.floating and first == mechanism.robot.bodies[0].name:
            standing.R[first], standing.p[first] = np.eye(3), np.array([0.0, 0.0, mechanism.robot.pose.height])
            standing.J[first] = np.eye(6, nv)
            continue
        if not cluster.independent:
            _place_ball(standing, mechanism, first, np.eye(nv)[rows[first]])
            continue
        q, G = _coordinates(mechanism, cluster, closure)
        for i, name in enumerate(cluster.bodies):
            standing.q[name], standing.G[name] = float(q[i]), np.zeros(nv)
            standing.G[name][[row for joint in cluster.independent for row in rows[joint]]] = G[i]
        for body in mechanism.moving(cluster):
            _place(standing, mechanism, body.name)
    return standing


def _coordinates(mechanism: Mechanism, cluster: Cluster, closure: Closure | None) -> tuple[Array, Array]:
    """Return spanning coordinates (n,) of a cluster and their derivatives by the independent ones (n, d)."""
    pose = dict(mechanism.robot.pose.joints)
    y = np.array([pose.get(name, 0.0) for name in cluster.independent])
    if closure is None:
        G, q0 = linear_solution(cluster)
        return G @ y + q0, G
    z = closure.reference[len(y) :]
    return closure.assembly.q, np.array(closure.rates(y, z, np.zeros(len(y)))[0].full())


def _place(standing: Standing, mechanism: Mechanism, name: str) -> None:
    """Place one body on its parent."""
    body, q = mechanism.bodies[name], standing.q[name]
    axis, turn, slide = body.axis, body.joint.turn, body.joint.slide
    _attach(standing, body, axis * (slide * q), turned(axis, turn * q))
    standing.J[name] += np.outer(np.concatenate([turn * axis, slide * axis]), standing.G[name])


def _place_ball(standing: Standing, mechanism: Mechanism, name: str, rows: Array) -> None:
    """Place the body of a ball joint, given its rows of the identity, shape (3, nv)."""
    quaternion = np.array(mechanism.robot.standing_balls[name])
    _attach(standing, mechanism.bodies[name], np.zeros(3), rotation_matrix(quaternion))
    standing.J[name][:3] += rows


def _attach(standing: Standing, body: MovingBody, shift: Array, turn: Array) -> None:
    """Place a body whose joint has the given translation and rotation; its Jacobian is the parent's motion."""
    position, rotation, parent = body.position + body.rotation @ shift, body.rotation @ turn, body.parent
    standing.R[body.name] = standing.R[parent] @ rotation
    standing.p[body.name] = standing.p[parent] + standing.R[parent] @ position
    w, v = standing.J[parent][:3], standing.J[parent][3:]
    standing.J[body.name] = np.vstack([rotation.T @ w, rotation.T @ (v - skew(position) @ w)])


def turned(axis: Array, angle: float) -> Array:
    """Return the rotation by an angle [rad] about a unit axis, shape (3, 3) (Rodrigues)."""
    u = skew(axis)
    return np.eye(3) + np.sin(angle) * u + (1.0 - np.cos(angle)) * u @ u


def mass_matrix(mechanism: Mechanism, standing: Standing) -> Array:
    """Return the mass matrix of the independent coordinates in the standing pose, shape (nv, nv)."""
    with np.errstate(all="ignore"):
        bodies = [standing.J[name].T @ body.inertia @ standing.J[name] for name, body in mechanism.bodies.items()]
        M = np.sum(bodies, axis=0)
        for rotors in mechanism.eliminated_rotors:
            M = M + _reflected(mechanism, rotors, standing)
    return M


def _reflected(mechanism: Mechanism, rotors: tuple[EliminatedRotor, ...], standing: Standing) -> Array:
    """Return the mass matrix of a cluster's eliminated rotors at the level of the mechanism, shape (nv, nv)."""
    nv = len(standing.J[None][0])
    if mechanism.level == "none" or not rotors:
        return np.zeros((nv, nv))
    G = np.array([standing.G[rotor.name] for rotor in rotors])
    reflected = G.T @ (np.array([[rotor.inertia] for rotor in rotors]) * G)
    if not mechanism.exact:
        return np.diag(np.diag(reflected)) if mechanism.level == "armature" else reflected
    for rotor, row in zip(rotors, G, strict=True):
        w = standing.J[rotor.carrier][:3]
        coupling = rotor.inertia * np.outer(row, rotor.axis @ w)
        e = turned(rotor.axis, standing.q[rotor.name]) @ rotor.heavy_axis
        n = np.cross(rotor.axis, e)
        transverse = rotor.transverse * (np.outer(e, e) - np.outer(n, n))
        reflected = reflected + coupling + coupling.T + w.T @ transverse @ w
    return reflected
