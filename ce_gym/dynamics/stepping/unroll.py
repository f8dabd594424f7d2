"""A plan as one expression: every stage with all the iterations it may need, one after the other.

Explicit stages work on positions and on the momentum of the base in the world. Unit quaternions are advanced in the
four-dimensional space around them, by a vector field that keeps their length, and scaled back at the end of the step,
which does not lower the order.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, quaternion_product, quaternion_to_rotation
from ce_gym.dynamics.forces.scene import Scene, State
from ce_gym.dynamics.recursion.derived import guessed_coordinates
from ce_gym.dynamics.stepping.plan import AFTER, Plan, Rates, combined, error_estimate
from ce_gym.dynamics.stepping.step import (
    Solved,
    Stepped,
    first_iterate,
    iteration,
    iterations_needed,
    looked_up_from,
    stacked,
)
from ce_gym.model.coordinates import Layout
from ce_gym.model.frames import added


def unrolled(plan: Plan, scene: Scene, before: State, target: SX, dt: float) -> dict[str, Stepped]:
    """Make one step of a robot.

    Args:
        plan: How.
        scene: The robot and what surrounds it.
        before: State before the step.
        target: Held constant over it, see `solve`.
        dt: Length of the step [s].

    Returns:
        What each stage left, by its name, and the step as a whole as `AFTER`.
    """
    parts: dict[str, Stepped] = {}
    layout = scene.mechanism.robot.layout
    for stage in plan.stages:
        if isinstance(stage.start, Rates):
            start = _moved(stage.start, before, list(parts.values()), dt, layout)
        else:
            start = parts[stage.start].state if stage.start else replace(before, load=getattr(before, stage.load))
        if parts and stage.start and not scene.looked_up.numel():  # the ground is known as it is around the start
            scene = looked_up_from(scene, parts[plan.stages[0].name].solved.kinematics)
        length = stage.length * dt if stage.length else 0.0  # a number also where dt is a symbol, see `solve`
        parts[stage.name] = iterated(scene, start, target, length, stage.iterations)
    first = parts[plan.stages[0].name]
    if isinstance(plan.end, Rates):
        after = replace(
            _moved(plan.end, before, list(parts.values()), dt, layout),
            load=first.state.load,
            pressed=first.state.pressed,
            carried=first.state.carried,
            winding=first.state.winding,
            supply=first.state.supply,
            held=first.state.held,
        )
    else:
        after = combined(plan, {name: part.state for name, part in parts.items()}, layout)
    error = error_estimate(plan, {name: part.state for name, part in parts.items()})
    return parts | {AFTER: replace(first, state=after, error=error)}


def _moved(rates: Rates, before: State, parts: list[Stepped], dt: float, layout: Layout) -> State:
    """Return the state before a step, moved along rates of its stages."""
    terms = [
        weight * _rate(part.before, part.solved, layout)
        for weight, part in zip(rates.weights, parts, strict=False)
        if weight
    ]
    moved = _from_flat(_flat(before, layout) + dt * sum(terms, SX(0)), before, layout)
    if rates.weights:
        first = parts[0].solved
        moved.dependent = guessed_coordinates(first.kinematics, first.vdot, dt * added(rates.weights))
    return moved


def iterated(scene: Scene, state: State, target: SX, dt: float, most: int) -> Stepped:
    """Advance one robot by one linearly implicit Euler step with all its iterations, `most` after the first."""
    iterate, needed = first_iterate(scene), min(most, iterations_needed(scene.mechanism, scene.options))
    if needed:  # traced once and put into itself, which is faster than to trace every iteration
        symbol = SX.sym("iterate", iterate.numel())
        following = ca.cse(ca.densify(iteration(scene, state, target, dt, symbol).iterate))
        for _ in range(needed):
            iterate = ca.substitute(following, symbol, ca.densify(iterate))
    return iteration(scene, state, target, dt, iterate)


def _flat(state: State, layout: Layout) -> SX:
    """Stack positions, velocities with the base's linear one in the world, and anchors."""
    v = state.v
    if layout.floating:
        v = ca.vertcat(v[:3], quaternion_to_rotation(state.q[3:7]) @ v[3:6], v[6:])
    return ca.vertcat(state.q, v, state.anchor)


def _from_flat(flat: SX, like: State, layout: Layout) -> State:
    q, v, anchor = ca.vertsplit(flat, [0, like.q.numel(), like.q.numel() + like.v.numel(), flat.numel()])
    for i, _ in layout.turns:
        q[i : i + 4] = q[i : i + 4] / ca.norm_2(q[i : i + 4])
    if layout.floating:
        v = ca.vertcat(v[:3], quaternion_to_rotation(q[3:7]).T @ v[3:6], v[6:])
    return replace(like, q=q, v=v, anchor=anchor)


def _rate(state: State, solved: Solved, layout: Layout) -> SX:
    """Time derivative of what `_flat` stacks."""
    q, v, vdot = state.q, state.v, solved.vdot
    slides = [
        ca.if_else(c.normal_slope > 0, (solved.kinematics.bodies[c.body].R @ c.sliding)[:2], 0) for c in solved.contacts
    ]
    anchor = stacked(slides) if state.anchor.numel() else state.anchor
    turning = [quaternion_product(q[i : i + 4], ca.vertcat(0, v[j : j + 3])) / 2 for i, j in layout.turns]
    joints = ca.vertcat(*turning, v[layout.joints_v :])
    if not layout.floating:
        return ca.vertcat(joints, vdot, anchor)
    R, w, u = quaternion_to_rotation(q[3:7]), v[:3], v[3:6]
    u_world = R @ (vdot[3:6] + cross(w, u))
    return ca.vertcat(R @ u, joints, vdot[:3], u_world, vdot[6:], anchor)
