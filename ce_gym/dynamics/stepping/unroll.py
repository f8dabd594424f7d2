"""A plan as one expression: every stage with all iterations that it may need.

Explicit stages work on positions and on the momentum of the base in the world. Unit quaternions are advanced in the
four-dimensional space around them, by a vector field that keeps their length, and scaled back at the end of the step,
which does not lower the order.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, quaternion_product, quaternion_to_rotation
from ce_gym.dynamics.forces.scene import Scene
from ce_gym.dynamics.integrators.plan import AFTER, Plan, Rates, combined, error_estimate
from ce_gym.dynamics.laws.scene_laws import iterations_needed
from ce_gym.dynamics.recursion.derived import guessed_coordinates
from ce_gym.dynamics.state import State
from ce_gym.dynamics.stepping.conservation import Balance, combined_balance
from ce_gym.dynamics.stepping.step import (
    Solved,
    Stepped,
    conserved,
    external_wrenches,
    finished,
    first_iterate,
    iteration,
    looked_up_from,
)
from ce_gym.model.coordinates import Layout
from ce_gym.model.frames import added


def unrolled(plan: Plan, scene: Scene, before: State, target: SX, dt: float) -> dict[str, Stepped]:
    """Make one step of a robot.

    Args:
        plan: The method.
        scene: The robot and its surroundings.
        before: State before the step.
        target: Constant over the step, see `solve`.
        dt: Length of the step [s].

    Returns:
        Result of each stage by name, and of the whole step as `AFTER`.
    """
    parts: dict[str, Stepped] = {}
    layout = scene.mechanism.robot.layout
    for stage in plan.stages:
        if isinstance(stage.start, Rates):
            start = _moved(stage.start, before, list(parts.values()), dt, layout)
        else:
            start = parts[stage.start].state if stage.start else before.replaced(load=before[stage.load])
        if parts and stage.start and not scene.looked_up.numel():  # looked up at the start of the step only
            scene = looked_up_from(scene, parts[plan.stages[0].name].solved.kinematics)
        length = stage.length * dt if stage.length else 0.0  # a number even if dt is a symbol, see `solve`
        parts[stage.name] = iterated(scene, start, target, length, stage.iterations)
    first = parts[plan.stages[0].name]
    if isinstance(plan.end, Rates):
        moved = _moved(plan.end, before, list(parts.values()), dt, layout)
        integrated = {name: moved[name] for name in ("q", "v", "dependent", *rates_of(first.solved))}
        after = conserved(
            scene.mechanism, first.state.replaced(**integrated), _balance(plan.end, list(parts.values()), dt)
        )
    else:
        after = combined(plan, {name: part.state for name, part in parts.items()}, layout)
        if not plan.single:
            balances = {name: part.balance for name, part in parts.items()}
            after = conserved(scene.mechanism, after, combined_balance(plan, balances))
    error = error_estimate(plan, {name: part.state for name, part in parts.items()})
    return parts | {AFTER: replace(first, state=after, error=error)}


def _moved(rates: Rates, before: State, parts: list[Stepped], dt: float, layout: Layout) -> State:
    """Return the state before a step, moved along the rates of stages."""
    terms = [weight * _rate(part.solved, layout) for weight, part in zip(rates.weights, parts, strict=False) if weight]
    names = list(rates_of(parts[0].solved)) if parts else []
    moved = _from_flat(_flat(before, names, layout) + dt * sum(terms, SX(0)), before, names, layout)
    if rates.weights:
        first = parts[0].solved
        moved = moved.replaced(dependent=guessed_coordinates(first.kinematics, first.vdot, dt * added(rates.weights)))
    return moved


def _balance(rates: Rates, parts: list[Stepped], dt: float) -> Balance:
    """Return the momentum after a step from the forces at its stages; the energy is left to the method."""
    first = parts[0].solved.system.start
    balance = Balance.of(first.scene.mechanism, first.kinematics)
    for weight, part in zip(rates.weights, parts, strict=False):
        if weight:
            wrenches = external_wrenches(part.solved)
            balance = balance.pushed(first.scene.mechanism, part.solved.kinematics, wrenches, weight * dt)
    return replace(balance, touching=SX(1))


def rates_of(solved: Solved) -> dict[str, SX]:
    """Return time derivatives of the fields of force laws that explicit methods integrate."""
    return {name: rate for force in solved.system.forces for name, rate in force.rates().items()}


def iterated(scene: Scene, state: State, target: SX, dt: float, most: int) -> Stepped:
    """Advance one robot by a linearly implicit Euler step with all its iterations, at most `most` after the first."""
    iterate, needed = first_iterate(scene), min(most, iterations_needed(scene.mechanism, scene.options))
    if needed:  # one traced iteration, substituted into itself: faster than tracing each
        symbol = SX.sym("iterate", iterate.numel())
        following = ca.cse(ca.densify(iteration(scene, state, target, dt, symbol).iterate))
        for _ in range(needed):
            iterate = ca.substitute(following, symbol, ca.densify(iterate))
    return finished(iteration(scene, state, target, dt, iterate))


def _flat(state: State, names: list[str], layout: Layout) -> SX:
    """Stack positions, velocities with the linear velocity of the base in world axes, and some fields."""
    v = state.v
    if layout.floating:
        v = ca.vertcat(v[:3], quaternion_to_rotation(state.q[3:7]) @ v[3:6], v[6:])
    return ca.vertcat(state.q, v, *[state[name] for name in names])


def _from_flat(flat: SX, like: State, names: list[str], layout: Layout) -> State:
    sizes = [like.q.numel(), like.v.numel(), *[like[name].numel() for name in names]]
    q, v, *others = ca.vertsplit(flat, [sum(sizes[:i]) for i in range(len(sizes) + 1)])
    for i, _ in layout.turns:
        q[i : i + 4] = q[i : i + 4] / ca.norm_2(q[i : i + 4])
    if layout.floating:
        v = ca.vertcat(v[:3], quaternion_to_rotation(q[3:7]).T @ v[3:6], v[6:])
    return like.replaced(q=q, v=v, **dict(zip(names, others, strict=True)))


def _rate(solved: Solved, layout: Layout) -> SX:
    """Return the time derivative of the stack of `_flat`."""
    state, vdot = solved.system.start.state, solved.vdot
    q, v, others = state.q, state.v, list(rates_of(solved).values())
    turning = [quaternion_product(q[i : i + 4], ca.vertcat(0, v[j : j + 3])) / 2 for i, j in layout.turns]
    joints = ca.vertcat(*turning, v[layout.joints_v :])
    if not layout.floating:
        return ca.vertcat(joints, vdot, *others)
    R, w, u = quaternion_to_rotation(q[3:7]), v[:3], v[3:6]
    u_world = R @ (vdot[3:6] + cross(w, u))
    return ca.vertcat(R @ u, joints, vdot[:3], u_world, vdot[6:], *others)
