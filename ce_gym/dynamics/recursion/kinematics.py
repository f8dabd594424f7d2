"""Positions and velocities of the bodies of a mechanism: the outward velocity pass.

`ce_gym.model.coordinates` defines the coordinates. A ball joint is a cluster of its own: its position is a quaternion,
and its velocity is the angular velocity of the body relative to the parent, in the body's axes.

Accelerations of bodies are classical in this folder: [angular; acceleration of the material point at the origin]. They
differ from Featherstone's spatial accelerations by `[0; w x v_origin]` (2008, section 2.11). Both transform by `X`, so
the recursions are the same; classical ones need no linear velocities, which saves 5 to 10 % of all instructions.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import (
    SX,
    Transform,
    axis_rotation,
    cross,
    quaternion_to_rotation,
)
from ce_gym.dynamics.constraints.closure import closures, reference_guess
from ce_gym.dynamics.constraints.cluster_constraints import (
    ClusterCoordinates,
    ball_coordinates,
    cluster_coordinates,
    loop_coordinates,
    with_gear_factor,
)
from ce_gym.model.clusters import Cluster
from ce_gym.model.drives import stretch_of
from ce_gym.model.mechanism import Mechanism, MovingBody


@dataclass
class BodyState:
    """Kinematics of one body.

    Attributes:
        X: Motion transform from its parent body.
        S: Motion subspace of the body's joint, shape (6, 1); (6, 3) for a ball joint, (6, 6) for a free base.
        v: Spatial velocity in body coordinates, shape (6,).
        c: Velocity-product acceleration, centripetal and Coriolis, relative to the parent, `a = X a_parent + S qdd
            + c`, shape (6,). Constraint terms `S g` not included.
        drift: Acceleration for `vdot = 0`, at constant linear velocity of the base in the world, shape (6,).
        R: Rotation, body to world, shape (3, 3). Unused entries cost no instructions.
        p: Origin in the world [m], shape (3,).
    """

    X: Transform
    S: SX
    v: SX
    c: SX
    drift: SX
    R: SX
    p: SX

    def point_velocity(self, r: SX) -> SX:
        """Return the velocity of body-fixed point `r` [m], in body axes [m/s]."""
        return self.v[3:] + cross(self.v[:3], r)

    def point_position(self, r: SX) -> SX:
        """Return body-fixed point `r` [m] in the world [m]."""
        return self.p + self.R @ r


@dataclass
class Kinematics:
    """Kinematics of a mechanism at one state.

    Attributes:
        bodies: State of every moving body, by name.
        coordinates: Spanning coordinates of every cluster; None for a floating base.
        rows: Rows of each cluster's independent coordinates inside `v`.
    """

    bodies: dict[str, BodyState] = field(default_factory=dict)
    coordinates: list[ClusterCoordinates | None] = field(default_factory=list)
    rows: list[list[int]] = field(default_factory=list)


def independent_rows(mechanism: Mechanism) -> list[list[int]]:
    """Return the rows of each cluster in `v` and tau."""
    rows = mechanism.robot.rows
    return [[row for name in moved_by(cluster) for row in rows[name][1]] for cluster in mechanism.tree.clusters]


def moved_by(cluster: Cluster) -> tuple[str, ...]:
    """Return the joints of a cluster that have rows in `q` and `v`: the independent ones, or a free or ball joint."""
    return cluster.independent or cluster.bodies


def is_free(mechanism: Mechanism, cluster: Cluster) -> bool:
    """Whether a cluster is the floating base."""
    return mechanism.robot.floating and cluster.bodies[0] == mechanism.robot.bodies[0].name


def outward_velocity_pass(mechanism: Mechanism, q: SX, v: SX, guess: SX | None = None) -> Kinematics:
    """Compute transforms, velocities and world poses of all bodies, base to tip (paper Alg. 1, outward pass 1).

    Args:
        mechanism: The mechanism.
        q: Positions, shape (nq,).
        v: Velocities, shape (nv,).
        guess: Guess of the dependent coordinates that are found by iteration, shape (n_guess,); at the reference pose
            if None.
    """
    guess = SX(reference_guess(mechanism)) if guess is None else guess
    used = 0
    kinematics = Kinematics(rows=independent_rows(mechanism))
    positions = mechanism.robot.rows
    for k in mechanism.tree.base_to_tip():
        cluster, rows = mechanism.tree.clusters[k], kinematics.rows[k]
        if is_free(mechanism, cluster):
            kinematics.coordinates.append(None)
            kinematics.bodies[cluster.bodies[0]] = _free_base(q, v)
            continue
        y, yd = q[[row for name in moved_by(cluster) for row in positions[name][0]]], v[rows]
        closure = closures(mechanism)[k]
        if not cluster.independent:
            coordinates = ball_coordinates(cluster, y, yd)
        elif closure is None:
            coordinates = cluster_coordinates(cluster, y, yd)
        else:
            first, used = used, used + len(closure.guessed)
            coordinates = loop_coordinates(cluster, closure, y, yd, guess[first:used])
        if mechanism.ratio is not None and cluster.independent:
            rotors = {name: stretch_of(name) for name in cluster.bodies if mechanism.robot.body(name).kind == "rotor"}
            coordinates = with_gear_factor(coordinates, rotors, mechanism.ratio)
        kinematics.coordinates.append(coordinates)
        for body in mechanism.moving(cluster):
            i = coordinates.index[body.name]
            parent = kinematics.bodies[body.parent] if body.parent is not None else None
            at = coordinates.position(body.name)
            kinematics.bodies[body.name] = _outward(body, parent, at, coordinates.qd[i], coordinates.g[i])
    return kinematics


def _free_base(q: SX, v: SX) -> BodyState:
    R = quaternion_to_rotation(q[3:7])
    return BodyState(X=Transform(R.T, q[:3]), S=SX.eye(6), v=v[:6], c=SX(6, 1), drift=SX(6, 1), R=R, p=q[:3])


def _outward(body: MovingBody, parent: BodyState | None, q: SX, qd: SX, g: SX) -> BodyState:
    X, S = joint_transform(body, q)
    still = SX(6, 1)
    R, p, v, a = (parent.R, parent.p, parent.v, parent.drift) if parent else (SX.eye(3), SX(3, 1), still, still)
    vJ = S @ qd
    velocity = X.motion(v) + vJ
    centripetal = X.E @ cross(v[:3], cross(v[:3], X.p))
    c = ca.vertcat(cross(velocity[:3], vJ[:3]), centripetal + 2 * cross(velocity[:3], vJ[3:]))
    return BodyState(X=X, S=S, v=velocity, c=c, drift=X.motion(a) + S @ g + c, R=R @ X.E.T, p=p + R @ X.p)


def joint_transform(body: MovingBody, q: SX) -> tuple[Transform, SX]:
    """Return the transform of a joint with one coordinate or a quaternion, and its motion subspace (6, 1) or (6, 3)."""
    if body.joint.type == "ball":
        E = quaternion_to_rotation(q).T @ constant(body.rotation.T)
        return Transform(E, constant(body.position)), constant(np.eye(6, 3))
    turn, slide = body.joint.turn, body.joint.slide
    axis, E, p, still = constant(body.axis), constant(body.rotation.T), constant(body.position), SX(3, 1)
    if slide:
        p = p + E.T @ axis * (slide * q)
    if turn:
        E = axis_rotation(axis, turn * q) @ E
    return Transform(E, p), ca.vertcat(turn * axis if turn else still, slide * axis if slide else still)


def constant(x: np.ndarray | SX) -> SX:
    """Return an array as SX; an array of numbers becomes sparse, so that its zeros are structural."""
    return x if isinstance(x, SX) else SX(ca.sparsify(ca.DM(x)))
