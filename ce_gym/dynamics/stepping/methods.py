"""Time-stepping methods: how a step is made of evaluations of the physics. One small class each, one contract.

`LinearlyImplicitEuler` is the default: order 1, stable for stiff contact, friction and gains. `Extrapolated` makes one
such step and two of half the length and combines them: order 2 in smooth motion, as stable, with an estimate of its
error. `RungeKutta` methods are explicit and meant for smooth scenes and for references; stiff contact limits their
steps. May know the step and its parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Protocol

import casadi as ca

from ce_gym.dynamics.algebra.integration import between, turned_by
from ce_gym.dynamics.algebra.spatial import SX, cross, quaternion_product, quaternion_to_rotation
from ce_gym.dynamics.forces.scene import Scene, State
from ce_gym.dynamics.functions import guessed_coordinates
from ce_gym.dynamics.stepping.step import Solved, Stepped, implicit_step, looked_up_from, no_hints, solve, stacked


class Method(Protocol):
    """A time-stepping method.

    Attributes:
        order: Its global error is of this order in the step length, where the motion is smooth.
    """

    @property
    def order(self) -> int:
        """See above."""
        ...

    def step(self, scene: Scene, state: State, target: SX, dt: float) -> Stepped:
        """Advance one robot by `dt` [s], the target held constant."""
        ...


class LinearlyImplicitEuler:
    """One linearly implicit Euler step."""

    order = 1

    def step(self, scene: Scene, state: State, target: SX, dt: float) -> Stepped:
        """Advance one robot by `dt` [s]."""
        return implicit_step(scene, state, target, dt)


class Extrapolated:
    """Richardson's extrapolation of linearly implicit Euler: `2 fine - coarse`, on the group of orientations.

    What contacts remember is taken from the fine steps.
    """

    order = 2

    def step(self, scene: Scene, state: State, target: SX, dt: float) -> Stepped:
        """Advance one robot by `dt` [s]; the error estimate is the distance of the two results in `v`."""
        coarse = implicit_step(scene, state, target, dt)
        half = implicit_step(scene, state, target, dt / 2)
        fine = implicit_step(looked_up_from(scene, coarse.solved.kinematics), half.state, target, dt / 2)
        fine.error = ca.norm_2(fine.state.v - coarse.state.v)
        floating = scene.mechanism.robot.floating
        fine.state.q, fine.state.v = beyond(coarse.state, fine.state, floating)
        fine.torque = (half.torque + fine.torque) / 2
        fine.contact_forces = (half.contact_forces + fine.contact_forces) / 2
        fine.solved = coarse.solved
        return fine


def beyond(coarse: State, fine: State, floating: bool) -> tuple[SX, SX]:
    """Return the positions and velocities as far beyond `fine` as that is from `coarse`."""
    q, v = 2 * fine.q - coarse.q, 2 * fine.v - coarse.v
    if not floating:
        return q, v
    a, b = coarse.q[3:7], fine.q[3:7]
    quaternion = turned_by(b, between(a, b))
    u = 2 * quaternion_to_rotation(b) @ fine.v[3:6] - quaternion_to_rotation(a) @ coarse.v[3:6]
    q[3:7], v[3:6] = quaternion, quaternion_to_rotation(quaternion).T @ u
    return q, v


@dataclass(frozen=True)
class RungeKutta:
    """An explicit Runge-Kutta method, on the positions and momenta of the base in the world.

    The unit quaternion is advanced in the four-dimensional space around it, by a vector field that keeps its length,
    and scaled back at the end of the step, which does not lower the order.

    Attributes:
        order: Of the method.
        a: Coefficients of the stages after the first, one row each.
        b: Weights of the stages.
    """

    order: int
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]

    def step(self, scene: Scene, state: State, target: SX, dt: float) -> Stepped:
        """Advance one robot by `dt` [s]; forces are those at the start."""
        start, floating = _flat(state, scene.mechanism.robot.floating), scene.mechanism.robot.floating
        rates: list[SX] = []
        first: Solved | None = None
        for row in ((), *self.a):
            stage = start + dt * sum((w * rate for w, rate in zip(row, rates, strict=True) if w), SX(0))
            here = _from_flat(stage, state, floating)
            if first is not None:
                here.dependent = guessed_coordinates(first.kinematics, first.vdot, dt * sum(row))
            solved = solve(scene, here, target, 0.0, no_hints(scene))
            if first is None:
                first, scene = solved, looked_up_from(scene, solved.kinematics)
            rates.append(_rate(here, solved, floating))
        end = start + dt * sum((w * rate for w, rate in zip(self.b, rates, strict=True) if w), SX(0))
        after = _from_flat(end, state, floating)
        assert first is not None
        after.dependent = guessed_coordinates(first.kinematics, first.vdot, dt)
        after.load = stacked([ca.fmax(contact.normal_after(SX(3, 1)), 0) for contact in first.contacts])
        forces = [
            first.kinematics.bodies[c.body].R @ r.force for c, r in zip(first.contacts, first.responses, strict=True)
        ]
        return Stepped(after, first, first.motors.tau, ca.horzcat(SX(3, 0), *forces), SX(0), SX(0), SX(0))


def _flat(state: State, floating: bool) -> SX:
    """Stack positions, velocities with the base's linear one in the world, and anchors."""
    v = state.v
    if floating:
        v = ca.vertcat(v[:3], quaternion_to_rotation(state.q[3:7]) @ v[3:6], v[6:])
    return ca.vertcat(state.q, v, state.anchor)


def _from_flat(flat: SX, like: State, floating: bool) -> State:
    q, v, anchor = ca.vertsplit(flat, [0, like.q.numel(), like.q.numel() + like.v.numel(), flat.numel()])
    if floating:
        quaternion = q[3:7] / ca.norm_2(q[3:7])
        q = ca.vertcat(q[:3], quaternion, q[7:])
        v = ca.vertcat(v[:3], quaternion_to_rotation(quaternion).T @ v[3:6], v[6:])
    return State(q=q, v=v, load=like.load, anchor=anchor, dependent=like.dependent)


def _rate(state: State, solved: Solved, floating: bool) -> SX:
    """Time derivative of what `_flat` stacks."""
    q, v, vdot = state.q, state.v, solved.vdot
    slides = [
        ca.if_else(c.normal_slope > 0, (solved.kinematics.bodies[c.body].R @ c.sliding)[:2], 0) for c in solved.contacts
    ]
    anchor = stacked(slides) if state.anchor.numel() else state.anchor
    if not floating:
        return ca.vertcat(v, vdot, anchor)
    R, w, u = quaternion_to_rotation(q[3:7]), v[:3], v[3:6]
    turning = quaternion_product(q[3:7], ca.vertcat(0, w)) / 2
    u_world = R @ (vdot[3:6] + cross(w, u))
    return ca.vertcat(R @ u, turning, v[6:], vdot[:3], u_world, vdot[6:], anchor)


RK4 = RungeKutta(4, ((1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6))
"""The classical method."""

_s = sqrt(21.0)
RK8 = RungeKutta(
    8,
    (
        (1 / 2,),
        (1 / 4, 1 / 4),
        (1 / 7, (-7 - 3 * _s) / 98, (21 + 5 * _s) / 49),
        ((11 + _s) / 84, 0.0, (18 + 4 * _s) / 63, (21 - _s) / 252),
        ((5 + _s) / 48, 0.0, (9 + _s) / 36, (-231 + 14 * _s) / 360, (63 - 7 * _s) / 80),
        (
            (10 - _s) / 42,
            0.0,
            (-432 + 92 * _s) / 315,
            (633 - 145 * _s) / 90,
            (-504 + 115 * _s) / 70,
            (63 - 13 * _s) / 35,
        ),
        (1 / 14, 0.0, 0.0, 0.0, (14 - 3 * _s) / 126, (13 - 3 * _s) / 63, 1 / 9),
        (1 / 32, 0.0, 0.0, 0.0, (91 - 21 * _s) / 576, 11 / 72, (-385 - 75 * _s) / 1152, (63 + 13 * _s) / 128),
        (
            *(1 / 14, 0.0, 0.0, 0.0, 1 / 9, (-733 - 147 * _s) / 2205, (515 + 111 * _s) / 504),
            *((-51 - 11 * _s) / 56, (132 + 28 * _s) / 245),
        ),
        (
            *(0.0, 0.0, 0.0, 0.0, (-42 + 7 * _s) / 18, (-18 + 28 * _s) / 45, (-273 - 53 * _s) / 72),
            *((301 + 53 * _s) / 72, (28 - 28 * _s) / 45, (49 - 7 * _s) / 18),
        ),
    ),
    (1 / 20, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 49 / 180, 16 / 45, 49 / 180, 1 / 20),
)
"""Cooper and Verner (1972), eleven stages: the reference for smooth motion."""

METHODS: dict[str, Method] = {"euler": LinearlyImplicitEuler(), "extrapolated": Extrapolated(), "rk4": RK4, "rk8": RK8}
