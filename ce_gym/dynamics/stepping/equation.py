"""The equation of motion over one step, and what changes in it along directions: expressions.

The residual is inverse dynamics less the forces of motors, joints and contacts, at a given acceleration. The
derivatives of a contact's force with respect to its place and velocity are computed first, and all directions share
them. The damping of joints on turning bodies contains inertias of clusters from the recursion; reverse mode finds their
changes.

A direction is a change of one entry of an input of the step; of positions in their tangent space.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cached_property
from typing import TypeAlias

import casadi as ca

from ce_gym.dynamics.algebra.integration import tangent_basis
from ce_gym.dynamics.algebra.spatial import SX, cross, quaternion_to_rotation
from ce_gym.dynamics.forces.contact import LinearContact
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.laws.scene_laws import iterate_size
from ce_gym.dynamics.recursion.ce_rnea import force_on_coordinates, inward_force_pass, net_forces, outward_acceleration
from ce_gym.dynamics.recursion.gyroscopic import TurningDamping
from ce_gym.dynamics.recursion.joint_space import composite_inertia, point_jacobian
from ce_gym.dynamics.stepping.step import finish_step, finished, first_loads, linearise, solve_system, stacked
from ce_gym.dynamics.stepping.trace import Given
from ce_gym.model.mechanism import Mechanism

GAIN = 3
"""Of the iterate of a contact, what its force depends on smoothly: the gain in velocity. The rest only decides."""
Direction: TypeAlias = tuple[str, int]
"""Name of an input of the step, and a place in it."""


class Equation:
    """The equation of motion of one robot over one iteration of a step.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.

    Attributes:
        given: Symbols of the inputs of a step.
        iterate: Symbols of the iterate.
        vdot: Symbols of the acceleration, shape (nv,).
        local: Of each contact, what its force depends on, the force (3,), and its derivative with respect to that.
        forces: Symbols of the forces of contacts, shape (3, n_contacts).
        slopes: Symbols of those derivatives.
        inertia: Symbols of the inertias of clusters whose joints are damped, shape (d, d) each.
        order: Rows of `v`, from the base to the tips.
        wrt: Inputs that directions change, by name; "gains" are changes of velocities in the iteration before.
        remembered: Sizes of the memory in the state after the step, by name.
    """

    def __init__(self, mechanism: Mechanism, options: StepOptions) -> None:
        self.given = given = Given(mechanism, options, follows=True)
        self.mechanism, self.layout = given.scene.mechanism, mechanism.robot.layout
        self.iterate = SX.sym("iterate", iterate_size(mechanism, options))
        self.vdot = SX.sym("vdot", given.state.v.numel())
        self.system = linearise(given.scene, given.state, given.target, given.dt, self.iterate)
        self.a, self.qdd = outward_acceleration(self.mechanism, self.system.start.kinematics, self.vdot)
        self.solved = self.system.solved(self.vdot, self.a)
        self.local = [self.local_force(contact) for contact in self.system.contacts]
        self.forces = SX.sym("forces", 3, len(self.local))
        self.slopes = [SX.sym("slopes", slope.sparsity()) for _, _, slope in self.local]
        rows, clusters = self.system.start.kinematics.rows, self.mechanism.tree.clusters
        self.order = [row for k in self.mechanism.tree.base_to_tip() for row in rows[k]]
        self.turned = {k: rows[k] for k in range(len(clusters)) if clusters[k].output_body is not None}
        self.inertia = {k: SX.sym("inertia", len(rows), len(rows)) for k, rows in self.turned.items()}
        gains = stacked([contact.iterate.gain for contact in self.system.contacts])
        every = {**dict(given.state.items()), "target": given.target, "gains": gains}
        self.wrt = {name: value for name, value in every.items() if value.numel()}
        self.remembered: dict[str, int] = {}

    @property
    def nv(self) -> int:
        """Number of velocities."""
        return self.vdot.numel()

    @property
    def x(self) -> SX:
        """Inputs that directions change, stacked."""
        return ca.vertcat(*self.wrt.values())

    @property
    def inputs(self) -> dict[str, SX]:
        """Inputs of an iteration, and its acceleration."""
        return there(self.given.inputs() | {"iterate": self.iterate, "vdot": self.vdot})

    @property
    def frozen(self) -> dict[str, SX]:
        """Inputs of an iteration, and quantities that all directions share."""
        more = {"inertia": self.stacked_inertias(self.inertia), "forces": ca.vec(self.forces)}
        more |= {"slopes": ca.vertcat(SX(0, 1), *map(packed, self.slopes))}
        return self.inputs | there(more | {"drift": packed(self.drift)})

    def to_own_axes(self, group: list[Direction], columns: SX) -> SX:
        """Take columns along positions of the base from the axes of the world to its own."""
        if self.layout.floating and ("q", 3) in group:
            columns[:, 3:6] = columns[:, 3:6] @ quaternion_to_rotation(self.wrt["q"][3:7])
        return columns

    def change(self, seeds: SX) -> SX:
        """Return the changes of the equation without contacts along directions, for an unchanged acceleration."""
        change = ca.jtimes(self._motion, self.x, seeds)
        damped = [row for rows in self.turned.values() for row in rows]
        change[damped, :] += self.drift @ seeds
        return ca.sparsify(change)

    def pressing(self, seeds: SX) -> SX:
        """Return the changes of the contacts' part along directions."""
        x = self.x
        forces = [slope @ ca.jtimes(at, x, seeds) for slope, (at, _, _) in zip(self.slopes, self.local, strict=True)]
        return ca.sparsify(ca.jtimes(self._pressed, ca.vertcat(x, ca.vec(self.forces)), ca.vertcat(seeds, *forces)))

    def seeds(self, group: list[Direction]) -> SX:
        """Return directions as columns; along positions of the base in the axes of the world."""
        columns = []
        for name, i in group:
            parts = {name: SX(value.numel(), 1) for name, value in self.wrt.items()}
            basis = tangent_basis(self.wrt["q"], self.layout) if name == "q" else SX.eye(parts[name].numel())
            if self.layout.floating and name == "q":
                basis[:3, 3:6] = SX.eye(3)
            parts[name] = basis[:, i]
            columns.append(ca.vertcat(*parts.values()))
        return ca.horzcat(*columns)

    def implicit(self) -> SX:
        """Return how the equation of motion changes with the acceleration, shape (nv, nv)."""
        kinematics, dt = self.system.start.kinematics, self.given.dt
        whole = composite_inertia(self.mechanism, kinematics) + self.system.joints.slope
        for k, rows in self.turned.items():
            whole[rows, rows] += self._damped(k, self.articulated[k])[0]
        for contact, (_, _, slope) in zip(self.system.contacts, self.local, strict=True):
            J = point_jacobian(self.mechanism, kinematics, contact.body, contact.law.touch.point)
            if self.layout.floating:
                J[:, :6] = J[:, :6] @ ca.diagcat(*[next(iter(kinematics.bodies.values())).R] * 2)
            whole -= J.T @ (dt * slope[:, -GAIN:]) @ J
        return ca.sparsify(whole)

    @cached_property
    def force_values(self) -> SX:
        """Forces of contacts at the given acceleration, shape (3, n_contacts)."""
        return ca.horzcat(SX(3, 0), *[force for _, force, _ in self.local])

    def stacked_inertias(self, inertia: dict[int, SX]) -> SX:
        """Return inertias of clusters as a column."""
        return ca.vertcat(SX(0, 1), *[ca.vec(ca.densify(D)) for D in inertia.values()])

    @cached_property
    def drift(self) -> SX:
        """Symbol of the result of `drift_function`."""
        return SX.sym("drift", self.drift_of(self.articulated).sparsity())

    def drift_of(self, articulated: dict[int, SX]) -> SX:
        """Return how the damping of joints changes because these inertias do, shape (joints, size of `x`)."""
        x, rows = self.x, []
        for k, inertia in self.inertia.items():
            torque = self._damping(k, inertia)
            for i in range(torque.numel()):
                weights = ca.jtimes(torque[i], ca.vec(inertia), SX(1), True)
                rows.append(ca.jtimes(ca.vec(ca.densify(articulated[k])), x, weights, True).T)
        return ca.sparsify(ca.vertcat(*rows)) if rows else SX(0, x.numel())

    @cached_property
    def articulated(self) -> dict[int, SX]:
        """Inertias of clusters on the way of the recursion, without what acts on their joints, shape (d, d) each."""
        return self.inertias(self.system.contacts)

    def inertias(self, contacts: list[LinearContact]) -> dict[int, SX]:
        """Return such inertias where only some contacts act."""
        loads = replace(self.system.loads, contacts=contacts)
        articulation = solve_system(replace(self.system, loads=loads)).motion.articulation
        return {k: articulation.inertia[k] for k in self.turned}  # type: ignore[union-attr]

    def local_force(self, contact: LinearContact) -> tuple[SX, SX, SX]:
        """Return the arguments of a contact's force, the force (3,), and its derivative."""
        law, touch, iterate = contact.law, contact.law.touch, contact.iterate
        values = {f.name: getattr(touch, f.name) for f in fields(touch) if f.name not in ("R", "point", "drift")}
        values = {name: value for name, value in values.items() if not value.is_constant()}
        symbols = {name: SX.sym(name, value.nnz()) for name, value in values.items()}
        changed = {name: SX(value.sparsity(), symbols[name]) for name, value in values.items()}
        before, gain = SX.sym("before", GAIN), SX.sym("gain", GAIN)
        about = LinearContact(replace(law, touch=replace(touch, **changed)), replace(iterate, gain=before))
        force, wrt = about.force_after(gain), ca.vertcat(*symbols.values(), before, gain)
        at = ca.vertcat(*map(packed, values.values()), iterate.gain, contact.gain(self.solved.motion))
        force, slope = ca.substitute([force, ca.jacobian(force, wrt)], [wrt], [at])
        return at, force, ca.sparsify(slope)

    @cached_property
    def _motion(self) -> SX:
        """Residual of the equation without contacts, shape (nv,), given inertias of clusters."""
        kinematics = self.system.start.kinematics
        f = net_forces(self.mechanism, kinematics, self.a)
        for name, terms in first_loads(self.system.start).bodies.items():
            f[name] = f[name] - terms.force
        left = inward_force_pass(self.mechanism, kinematics, self.a, f, self.qdd)
        left += self.system.joints.slope @ self.vdot - self.system.joints.tau
        for k, rows in self.turned.items():
            left[rows] += self._damping(k, self.inertia[k])
        return left

    @cached_property
    def _pressed(self) -> SX:
        """Contacts' part of the residual, shape (nv,), given their forces."""
        kinematics, still = self.system.start.kinematics, SX(6, 1)
        f = dict.fromkeys(self.mechanism.bodies, still)
        for i, contact in enumerate(self.system.contacts):
            touch = contact.law.touch
            force = touch.R.T @ self.forces[:, i]
            f[contact.body] = f[contact.body] - ca.vertcat(cross(touch.point, force), force)
        return force_on_coordinates(self.mechanism, kinematics, f)

    def _damping(self, k: int, inertia: SX) -> SX:
        """Return the torque that damps the joints of a cluster because its carrier turns, shape (d,)."""
        more, drag = self._damped(k, inertia)
        return more @ self.vdot[self.turned[k]] - drag

    def _damped(self, k: int, inertia: SX) -> tuple[SX, SX]:
        """Return what that damping adds to the inertia of a cluster, shape (d, d), and its force, shape (d,)."""
        carrier = self.mechanism.tree.clusters[k].output_body
        turning = TurningDamping(self.given.state.v, self.given.dt)
        return turning.on(inertia, self.turned[k], self.system.start.kinematics.bodies[carrier].v[:3])  # type: ignore[index]

    @cached_property
    def _slope(self) -> SX:
        return self.tangent_after(ca.jacobian(self.end_values, self.vdot))

    @cached_property
    def end_values(self) -> SX:
        """The state after the step at the given acceleration."""
        after = finished(finish_step(self.solved)).state
        return ca.vertcat(after.q, after.v, *[after[name] for name in self.remembered])

    def tangent_after(self, columns: SX) -> SX:
        """Take changes of positions in the state after the step to their tangent space."""
        nq = self.given.state.q.numel()
        tangent = tangent_basis(self.end_values[:nq], self.layout).T
        for _, row in self.layout.turns:  # rows of rotations have length 1/2
            tangent[row : row + 3, :] *= 4
        return ca.sparsify(ca.vertcat(tangent @ columns[:nq, :], columns[nq:, :]))


def acts(contacts: list[LinearContact]) -> SX:
    """Return 1 if a contact acts, else 0."""
    return SX(ca.sum1(ca.vertcat(*[contact.active for contact in contacts])) > 0)


def packed(x: SX) -> SX:
    """Return the entries that are not zero by structure, as a column."""
    return ca.vertcat(SX(0, 1), *x.nonzeros())  # type: ignore[arg-type]


def there(named: dict[str, SX]) -> dict[str, SX]:
    """Return the entries that are not empty."""
    return {name: value for name, value in named.items() if value.numel()}
