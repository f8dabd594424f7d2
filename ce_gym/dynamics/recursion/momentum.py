"""Momentum, kinetic energy and mass distribution of a mechanism, collected from the tips to the root.

An eliminated rotor has the inertia J about its axis u and the speed thd, on a carrier that turns at w. It adds the
angular momentum `J thd u` and the energy `J thd^2 / 2 + J thd u^T w` to those from the inertia of the carrier. Its
transverse inertia adds further terms, see rotors.py. A level without these terms in its equations of motion has none
of them here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, Transform, cross, mirrored, skew
from ce_gym.dynamics.constraints.cluster_constraints import ClusterCoordinates
from ce_gym.dynamics.recursion.ce_aba import gravity_acceleration
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant
from ce_gym.dynamics.recursion.rotors import transverse_inertia
from ce_gym.model.mechanism import EliminatedRotor, Mechanism, MovingBody


@dataclass
class Composite:
    """Mass distribution of a robot frozen in its pose, in the axes of its root: the floating base, or the world.

    Attributes:
        mass: [kg].
        moment: Mass times centre of mass [kg m], shape (3,).
        inertia: About the origin of the root [kg m^2], shape (3, 3).
    """

    mass: SX | float
    moment: SX
    inertia: SX

    @property
    def center(self) -> SX:
        """Centre of mass [m], shape (3,)."""
        return self.moment / self.mass

    @property
    def inertia_about_center(self) -> SX:
        """Inertia about the centre of mass [kg m^2], shape (3, 3)."""
        return mirrored(self.inertia + skew(self.moment) @ skew(self.center))


@dataclass
class Momentum:
    """Momentum and kinetic energy of a robot, in the axes of its root.

    Attributes:
        angular: About the origin of the root [kg m^2/s], shape (3,).
        linear: [kg m/s], shape (3,).
        energy: Kinetic energy [J].
    """

    angular: SX
    linear: SX
    energy: SX

    def about(self, center: SX) -> SX:
        """Return the angular momentum about a point in the axes of the root [m]."""
        return self.angular - cross(center, self.linear)


def composite_of(mechanism: Mechanism, kinematics: Kinematics) -> Composite:
    """Return the mass distribution of the moving bodies of a robot."""
    parts: dict[str | None, Composite] = {None: Composite(SX(0), SX(3, 1), SX(3, 3))}
    for name, body in mechanism.bodies.items():
        parts[name] = Composite(body.inertia[3, 3], first_moment(body), constant(body.inertia[:3, :3]))
    for rotor, row, coordinates in _spinning(mechanism, kinematics):
        if rotor.carrier is not None:
            turned = transverse_inertia(rotor, coordinates.q[row], SX(0), SX(3, 1)).inertia
            parts[rotor.carrier].inertia = parts[rotor.carrier].inertia + turned
    for name in reversed(mechanism.bodies):
        parent, X = _to_parent(mechanism, kinematics, name)
        part, total = parts[name], parts[parent]
        moment, P = X.E.T @ part.moment, skew(X.p)
        across = P @ skew(moment)
        inertia = mirrored(mirrored(X.E.T @ part.inertia @ X.E) - across - across.T - part.mass * (P @ P))
        total.mass = total.mass + part.mass
        total.moment = total.moment + moment + part.mass * X.p
        total.inertia = mirrored(total.inertia + inertia)
    return parts[None]


def momentum_of(mechanism: Mechanism, kinematics: Kinematics) -> Momentum:
    """Return momentum and kinetic energy of a robot."""
    momentum: dict[str | None, SX] = {None: SX(6, 1)}
    energy = SX(0)
    for name, body in mechanism.bodies.items():
        v = kinematics.bodies[name].v
        momentum[name] = constant(body.inertia) @ v
        energy += ca.dot(v, momentum[name]) / 2
    for rotor, row, coordinates in _spinning(mechanism, kinematics):
        spin = constant(rotor.axis) * (rotor.inertia * coordinates.qd[row])
        if rotor.carrier is not None:
            w = kinematics.bodies[rotor.carrier].v[:3]
            turned = transverse_inertia(rotor, coordinates.q[row], coordinates.qd[row], w).inertia @ w
            energy, spin = energy + ca.dot(w, spin + turned / 2), spin + turned
        momentum[rotor.carrier] = momentum[rotor.carrier] + ca.vertcat(spin, SX(3, 1))
    energy += _spin_energy(mechanism, kinematics)
    for name in reversed(mechanism.bodies):
        parent, X = _to_parent(mechanism, kinematics, name)
        momentum[parent] = momentum[parent] + X.force_to_parent(momentum[name])
    return Momentum(momentum[None][:3], momentum[None][3:], energy)


def potential_energy(mechanism: Mechanism, kinematics: Kinematics) -> SX:
    """Return the potential energy in gravity [J]."""
    energy, gravity = SX(0), gravity_acceleration(mechanism)
    for name, body in mechanism.bodies.items():
        state = kinematics.bodies[name]
        energy -= ca.dot(gravity, body.inertia[3, 3] * state.p + state.R @ first_moment(body))
    return energy


def first_moment(body: MovingBody) -> SX:
    """Return mass times centre of mass of a body, in its axes [kg m], shape (3,)."""
    return ca.sparsify(ca.vertcat(SX(body.inertia[2, 4]), body.inertia[0, 5], body.inertia[1, 3]))


def _to_parent(mechanism: Mechanism, kinematics: Kinematics, name: str) -> tuple[str | None, Transform]:
    """Return the parent of a body and the transform from it; a floating base is the root itself."""
    parent = mechanism.bodies[name].parent
    if parent is None and mechanism.robot.floating:
        return None, Transform.identity()
    return parent, kinematics.bodies[name].X


def _spinning(
    mechanism: Mechanism, kinematics: Kinematics
) -> Iterator[tuple[EliminatedRotor, int, ClusterCoordinates]]:
    """Yield the eliminated rotors whose momentum acts on a carrier, with their rows and coordinates."""
    for k, rotors in enumerate(mechanism.eliminated_rotors if mechanism.exact else ()):
        coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        yield from ((rotor, coordinates.index[rotor.name], coordinates) for rotor in rotors)


def _spin_energy(mechanism: Mechanism, kinematics: Kinematics) -> SX:
    """Return the kinetic energy of the eliminated rotors about their axes, as the level has it [J]."""
    energy = SX(0)
    for k, rotors in enumerate(mechanism.eliminated_rotors if mechanism.level != "none" else ()):
        coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        for rotor in rotors:
            row = coordinates.index[rotor.name]
            speeds = coordinates.qd[row]
            if mechanism.level == "armature":
                names = mechanism.tree.clusters[k].independent
                yd = coordinates.qd[[coordinates.index[name] for name in names]]
                speeds = ca.vec(coordinates.G[row, :]) * yd
            energy += rotor.inertia * ca.sumsqr(speeds) / 2
    return energy
