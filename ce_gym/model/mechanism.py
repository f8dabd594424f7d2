"""`Mechanism`: a robot at one transmission level, ready for the recursions.

The levels differ only in the effects of a *spinning* rotor. A rotor's mass and inertia at rest always stay with its
carrier, so total mass and limits are the same at every level, and so are coordinates at all levels but the first:

| level      | effects of the spin                                                                          |
|------------|----------------------------------------------------------------------------------------------|
| `elastic`  | everything, and the stretch of its transmission: one more coordinate for each                |
| `exact`    | everything: kinetic energy, coupling to the carrier, gyroscopic torque                       |
| `coupled`  | the reflected inertia `G_r^T J G_r` of each cluster, with its off-diagonal terms             |
| `armature` | the diagonal of that matrix                                                                  |
| `none`     | nothing                                                                                      |

At `exact`, a rotor that spins about a principal axis through its centre of mass never has to become a body of the
recursion: its mass, its axial and its mean transverse inertia are constant in its carrier's frame. Its spin, and the
difference of its transverse moments if it is not symmetric, enter as an `EliminatedRotor`. Any other rotor stays a body
of its cluster. `build_mechanism` decides rotor by rotor.

An elastic transmission has the constraint `rotor = sum(ratio * joint) + stretch`. The stretch is the coordinate of a
massless joint, so recursions and constraints need no special case.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.clusters import Cluster, ClusterTree, cluster_tree
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Body, Inertial, Joint, Robot
from ce_gym.model.errors import RobotError, invalid_value
from ce_gym.model.frames import ZERO

Level = Literal["exact", "coupled", "armature", "none"]
LEVELS: tuple[Level, ...] = get_args(Level)
"""Transmission levels that share all coordinates, the exact one first."""
ELASTIC = "elastic"
"""The exact level with one more coordinate for each elastic transmission."""
Array = NDArray[np.float64]

AXISYMMETRY_TOLERANCE = 1e-9
"""Largest relative asymmetry of a rotor that still counts as symmetric about its spin axis."""


@dataclass(frozen=True)
class EliminatedRotor:
    """A rotor that is no body of the recursion: its inertia at rest is merged into its carrier, all but `transverse`.

    Attributes:
        name: Name of the rotor.
        carrier: Name of the body on which the rotor is mounted; None for the world.
        axis: Unit spin axis in the carrier's frame, shape (3,).
        inertia: Moment of inertia about the axis [kg m^2].
        transverse: Half the difference of the two transverse principal moments [kg m^2], where it has not been merged
            because it turns with the rotor: at the exact level, if the rotor is not symmetric. Otherwise 0.
        heavy_axis: Unit transverse principal axis of the larger moment at rotor angle zero, in the carrier's frame,
            shape (3,); any transverse axis if `transverse` is 0.
    """

    name: str
    carrier: str | None
    axis: Array
    inertia: float
    transverse: float
    heavy_axis: Array


@dataclass(frozen=True)
class MovingBody:
    """A body that takes part in the recursion.

    Attributes:
        name: Name of the body.
        parent: Parent body; None for the world.
        rotation: Columns are the body's axes in the parent frame at joint coordinate zero, shape (3, 3).
        position: The body's origin in the parent frame at joint coordinate zero [m], shape (3,).
        joint: The body's joint.
        axis: Unit joint axis in the body frame, shape (3,).
        inertia: Spatial inertia about the body's origin, angular part first, shape (6, 6).
    """

    name: str
    parent: str | None
    rotation: Array
    position: Array
    joint: Joint
    axis: Array
    inertia: Array


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A robot at one transmission level, ready for the recursions.

    Attributes:
        robot: The description.
        level: Transmission level.
        tree: Clusters of the robot, including eliminated rotors.
        bodies: The bodies that take part in the recursion, by name, parents first.
        eliminated_rotors: For each cluster, its rotors that are no bodies of the recursion.
        gravity: Acceleration of free fall in the world [m/s^2], shape (3,).
        ratio: Factor on all gear ratios; None for the robot's own ratios.
        locked_rotors: Whether approximated rotors leave their mass and inertia at rest with their carrier.
    """

    robot: Robot
    level: str
    tree: ClusterTree
    bodies: dict[str, MovingBody]
    eliminated_rotors: tuple[tuple[EliminatedRotor, ...], ...]
    gravity: Array
    ratio: float | None = None
    locked_rotors: bool = True

    @property
    def exact(self) -> bool:
        """Whether the level keeps all effects of spinning rotors."""
        return self.level in (ELASTIC, "exact")

    def moving(self, cluster: Cluster) -> list[MovingBody]:
        """Return the bodies of a cluster that take part in the recursion, parents first."""
        return [self.bodies[name] for name in cluster.bodies if name in self.bodies]


def build_mechanism(
    robot: Robot, level: str = "exact", *, locked_rotors: bool = True, eliminate: bool = True
) -> Mechanism:
    """Prepare a robot for the recursions at a transmission level.

    Args:
        robot: The description.
        level: "elastic", "exact", "coupled", "armature" or "none".
        locked_rotors: Whether the mass and inertia at rest of an approximated rotor stay with its carrier. False
            deletes them, as in the "unconstrained" and "approximate" systems of the paper's figures.
        eliminate: Whether rotors that spin about a principal axis are eliminated at the exact level; False keeps every
            rotor as a body, the general algorithm that tests compare with the elimination.

    Raises:
        RobotError: If the level does not exist, or the robot has no elastic transmission at the elastic level.
    """
    if level not in (ELASTIC, *LEVELS):
        known = ", ".join((ELASTIC, *LEVELS))
        raise RobotError(f"{robot.name}: transmission {level!r} does not exist; expected one of {known}")
    exact, robot = level in (ELASTIC, "exact"), without_stretches(robot)
    if level == ELASTIC:
        robot = with_stretches(robot)
    tree = cluster_tree(robot)
    kept = {
        body.name
        for body in robot.bodies
        if body.kind == "link" or (body.kind == "rotor" and exact and not (eliminate and has_principal_axis(body)))
    }
    carriers = {body.parent for body in robot.bodies}
    for body in robot.bodies:
        if body.kind == "rotor" and body.name not in kept and body.name in carriers:
            raise RobotError(f"{robot.name}: rotor {body.name!r} carries another body; only links can")
    merged = {b.name: _averaged(b) if exact else b for b in robot.rotors() if b.name not in kept}
    inertias = {name: spatial_inertia(robot.body(name)) for name in kept}
    for rotor in merged.values():
        if rotor.parent is not None and (locked_rotors or exact):
            inertias[rotor.parent] = inertias[rotor.parent] + seen_from_parent(rotor)
    bodies = {b.name: _moving_body(b, inertias[b.name]) for b in robot.bodies if b.name in kept}
    rotors = tuple(
        tuple(_eliminated_rotor(robot.body(name), merged[name]) for name in cluster.bodies if name in merged)
        for cluster in tree.clusters
    )
    return Mechanism(robot, level, tree, bodies, rotors, np.array(robot.gravity), locked_rotors=locked_rotors)


def with_stretches(robot: Robot) -> Robot:
    """Return a robot with a massless joint for the stretch of each elastic transmission, after the independent joints.

    Raises:
        RobotError: The robot has no elastic transmission.
    """
    if not robot.elastic:
        expected = f"the stiffness of at least one transmission, for transmission {ELASTIC!r}"
        raise invalid_value(robot.source or robot.name, "elastic", None, expected)
    stretches = {elastic.rotor: elastic.stretch for elastic in robot.elastic}
    massless = Inertial(0.0, ZERO, (ZERO, ZERO, ZERO))
    bodies = []
    for body in robot.bodies:
        bodies.append(body)
        if body.name in stretches:
            joint = Joint("revolute", body.joint.axis)
            bodies.append(Body(stretches[body.name], "stretch", body.parent, body.placement, joint, massless))
    ties = []
    for tie in robot.constraints:
        if isinstance(tie, LinearConstraint):
            pairs = tuple((stretches[name], -x) for name, x in tie.coefficients if name in stretches)
            tie = replace(tie, coefficients=(*tie.coefficients, *pairs))
        ties.append(tie)
    independent = (*robot.independent, *stretches.values())
    return replace(robot, bodies=tuple(bodies), constraints=tuple(ties), independent=independent)


def without_stretches(robot: Robot) -> Robot:
    """Return a robot as it was before `with_stretches`."""
    stretches = {body.name for body in robot.bodies if body.kind == "stretch"}
    if not stretches:
        return robot
    ties = []
    for tie in robot.constraints:
        if isinstance(tie, LinearConstraint):
            tie = replace(tie, coefficients=tuple(pair for pair in tie.coefficients if pair[0] not in stretches))
        ties.append(tie)
    bodies = tuple(body for body in robot.bodies if body.name not in stretches)
    return replace(robot, bodies=bodies, constraints=tuple(ties), independent=robot.commanded)


def has_principal_axis(rotor: Body) -> bool:
    """Whether a rotor spins about a principal axis of its inertia, with its centre of mass on that axis."""
    u = np.array(rotor.joint.axis)
    inertia = np.array(rotor.inertial.inertia)
    tilt = float(np.abs(np.cross(u, inertia @ u)).max())
    offset = rotor.inertial.mass * float(np.linalg.norm(np.cross(u, np.array(rotor.inertial.com)))) ** 2
    tolerance = AXISYMMETRY_TOLERANCE * float(np.abs(inertia).max())
    return rotor.joint.type == "revolute" and tilt <= tolerance and offset <= tolerance


def is_axisymmetric(rotor: Body) -> bool:
    """Whether a rotor's inertia is symmetric about its spin axis and its centre of mass lies on it."""
    cross_axis, inertia = skew(np.array(rotor.joint.axis)), np.array(rotor.inertial.inertia)
    asymmetry = float(np.abs(cross_axis @ inertia - inertia @ cross_axis).max())
    return has_principal_axis(rotor) and asymmetry <= AXISYMMETRY_TOLERANCE * float(np.abs(inertia).max())


def spin_inertia(rotor: Body) -> float:
    """Return the moment of inertia of a rotor about its spin axis [kg m^2]."""
    axis = np.array(rotor.joint.axis)
    moment = float(axis @ np.array(rotor.inertial.inertia) @ axis)
    com_offset = math.fsum(np.cross(axis, np.array(rotor.inertial.com)) ** 2)
    return moment + rotor.inertial.mass * com_offset


def smallest_spin_factor(rotor: Body) -> float:
    """Return the smallest factor on the spin inertia of a rotor that a rigid body can have [-].

    The factor is 0 for a rotor about a principal axis. With products of inertia between spin and transverse motion, or
    with the centre of mass off the axis, `I + (factor - 1) J u u^T` is positive semidefinite for factors of at least
    `1 - 1 / (J u^T I^-1 u)`.
    """
    if has_principal_axis(rotor):
        return 0.0
    axis, inertia, J = np.array(rotor.joint.axis), np.array(rotor.inertial.inertia), spin_inertia(rotor)
    inverse = np.linalg.pinv(inertia, rcond=AXISYMMETRY_TOLERANCE, hermitian=True)
    if np.abs(inertia @ inverse @ axis - axis).max() > AXISYMMETRY_TOLERANCE:
        return 1.0
    return float(1.0 - 1.0 / (J * (axis @ inverse @ axis)))


def skew(x: Array) -> Array:
    """Return the matrix of the cross product, `skew(x) @ y = cross(x, y)`."""
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def spatial_inertia(body: Body) -> Array:
    """Return the spatial inertia of a body about its own origin, shape (6, 6). Featherstone 2008, eq. 2.63."""
    m, c = body.inertial.mass, skew(np.array(body.inertial.com))
    inertia = np.array(body.inertial.inertia)
    return np.block([[inertia + m * c @ c.T, m * c], [m * c.T, m * np.eye(3)]])


def snapped(x: Array) -> Array:
    """Round entries that differ from an integer by rounding only, so that symbolic code can drop them."""
    nearest = np.round(x)
    return np.where(np.abs(x - nearest) < 1e-12, nearest, x)


def seen_from_parent(body: Body) -> Array:
    """Return the spatial inertia of a body at joint coordinate zero about its parent's origin, in the parent's axes."""
    rotation, position = np.array(body.placement.rotation), np.array(body.placement.position)
    to_body = np.block([[rotation.T, np.zeros((3, 3))], [-rotation.T @ skew(position), rotation.T]])
    inertia = to_body.T @ spatial_inertia(body) @ to_body
    return np.where(np.abs(inertia) < 1e-15 * np.abs(inertia).max(), 0.0, inertia)


def _moving_body(body: Body, inertia: Array) -> MovingBody:
    return MovingBody(
        name=body.name,
        parent=body.parent,
        rotation=snapped(np.array(body.placement.rotation)),
        position=np.array(body.placement.position),
        joint=body.joint,
        axis=snapped(np.array(body.joint.axis)),
        inertia=inertia,
    )


def _averaged(rotor: Body) -> Body:
    """Return a rotor with the mean of its inertia over all angles: the mean of two angles a right angle apart."""
    if is_axisymmetric(rotor):
        return rotor
    u, inertia = np.array(rotor.joint.axis), np.array(rotor.inertial.inertia)
    quarter_turn = skew(u) + np.outer(u, u)
    mean = (inertia + quarter_turn @ inertia @ quarter_turn.T) / 2
    return replace(rotor, inertial=replace(rotor.inertial, inertia=tuple(map(tuple, mean.tolist()))))


def _eliminated_rotor(rotor: Body, merged: Body) -> EliminatedRotor:
    """Return a rotor for the recursion; `merged` is the part of its inertia that stays with the carrier."""
    axis = np.array(rotor.joint.axis)
    moments, axes = np.linalg.eigh(np.array(rotor.inertial.inertia) - np.array(merged.inertial.inertia))
    to_carrier = np.array(rotor.placement.rotation)
    return EliminatedRotor(
        name=rotor.name,
        carrier=rotor.parent,
        axis=snapped(to_carrier @ axis),
        inertia=spin_inertia(rotor),
        transverse=float(moments[-1]),
        heavy_axis=snapped(to_carrier @ axes[:, -1]),
    )
