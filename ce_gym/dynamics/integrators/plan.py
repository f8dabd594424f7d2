"""What a time step consists of, as data: stages that evaluate the physics, and how they are combined.

A plan has two readers: `unroll` makes one expression of it, `ce_gym.sim.substeps` calls of a compiled program. Both
leave the arithmetic of combining stages to this file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca

from ce_gym.dynamics.algebra.integration import between, turned_by
from ce_gym.dynamics.algebra.spatial import SX, quaternion_to_rotation
from ce_gym.dynamics.state import State
from ce_gym.model.coordinates import Layout

MOVED = "moved"
"""Name of the output that says how far a step moves its fastest joint, at the speed of its end [rad or m]."""
OFF = "off"
"""Name of the output that estimates the errors of a step, shape (nv + 1,), see `step_errors`."""
TOUCHES = ("load", "pair_force")
"""Parts of a state that are above 0 where something touches."""
LANDING, CONTACT = 0.02, 0.005
"""What an error of velocity counts as: how far it moves in this time, where a contact begins or ends, and else [s]."""
STOPPED = 0.1
"""Part of the velocity that a step may change where a contact begins."""
LOAD = "load"
"""Part of a state that says what contacts carried, unless a stage has another."""
AFTER = "after"
"""Name of the step as a whole, where outputs are evaluated at its end and not combined from stages."""


@dataclass(frozen=True)
class Rates:
    """The state before the step, moved by `dt` times a weighted sum of the stages' rates of change.

    Attributes:
        weights: Of the stages, in their order; those left out count as 0.
    """

    weights: tuple[float, ...] = ()


@dataclass(frozen=True)
class Ends:
    """A weighted sum of the states at the ends of stages, on the group of orientations.

    What contacts remember and guesses of dependent coordinates are taken from the last stage.

    Attributes:
        weights: Of each stage, by name, the last one first; they sum to 1.
        means: Of each stage in what is a mean over the step; they sum to 1.
        error: The two stages whose distance in `v` estimates the error of the step; empty if there is no estimate.
    """

    weights: Mapping[str, float]
    means: Mapping[str, float]
    error: tuple[str, str] | tuple[()] = ()


@dataclass(frozen=True)
class Stage:
    """One evaluation of the physics.

    A stage with a length is a linearly implicit Euler step, iterated until its active set is the one it assumed. One of
    length 0 evaluates forces and accelerations of the moment. Where it does not start from the state before the step,
    the ground is looked up again.

    Attributes:
        name: In buffers and weights.
        start: Name of the stage at whose end it starts, "" for the state before the step; or `Rates` of earlier stages.
        length: As a fraction of the step.
        iterations: How many iterations may follow the first; fewer if the forces of the scene never need as many.
        load: Part of the state before the step that says what contacts carried, for one that starts there; what they
            carry at its end is that part of the state after the step.
    """

    name: str
    start: str | Rates = ""
    length: float = 1.0
    iterations: int = 8
    load: str = LOAD


@dataclass(frozen=True)
class Plan:
    """A time-stepping method.

    Attributes:
        order: Its global error is of this order in the step length, where the motion is smooth.
        stages: In the order in which they are evaluated; the first starts from the state before the step.
        end: How the state after the step follows from them.
        controlled: Whether kernels make steps as long as the estimate of their error allows, see `step_size.py`.
    """

    order: int
    stages: tuple[Stage, ...]
    end: Ends | Rates = field(default_factory=Rates)
    controlled: bool = False

    @property
    def single(self) -> bool:
        """Whether the step is its only stage."""
        return isinstance(self.end, Ends) and len(self.stages) == 1

    @property
    def is_euler(self) -> bool:
        """Whether that stage is a whole linearly implicit Euler step."""
        return self.single and self.stages[0].length == 1

    @property
    def estimates(self) -> bool:
        """Whether it estimates its error."""
        return isinstance(self.end, Ends) and bool(self.end.error)

    def shares(self, moment: Literal["start", "end", "mean"]) -> Mapping[str, float]:
        """Return the weight of each stage in an output that belongs to a moment of the step, or is a mean over it."""
        if isinstance(self.end, Rates):
            return {AFTER: 1.0}
        if moment == "start":
            return {self.stages[0].name: 1.0}
        return self.end.means if moment == "mean" else self.end.weights


def combined(plan: Plan, ends: Mapping[str, State], layout: Layout) -> State:
    """Return the state after a step, given the states at the ends of its stages; of a plan whose `end` is `Ends`."""
    assert isinstance(plan.end, Ends)
    weights, last = plan.end.weights, ends[plan.stages[-1].name]
    if plan.single:
        return last
    q = sum((weight * ends[name].q for name, weight in weights.items()), SX(0))
    v = sum((weight * ends[name].v for name, weight in weights.items()), SX(0))
    for i, _ in layout.turns:
        others = [(weight, ends[name].q[i : i + 4]) for name, weight in weights.items() if ends[name] is not last]
        turned = sum((-weight * between(other, last.q[i : i + 4]) for weight, other in others), SX(0))
        q[i : i + 4] = turned_by(last.q[i : i + 4], turned)
    if layout.floating:
        world = [w * (quaternion_to_rotation(ends[s].q[3:7]) @ ends[s].v[3:6]) for s, w in weights.items()]
        v[3:6] = quaternion_to_rotation(q[3:7]).T @ sum(world, SX(0))
    loads = {stage.load: ends[stage.name][LOAD] for stage in plan.stages if stage.load != LOAD}
    return last.replaced(q=q, v=v, **loads)


def error_estimate(plan: Plan, ends: Mapping[str, State]) -> SX:
    """Return the estimated error of a step in `v` [rad/s or m/s]; 0 for a plan that has none."""
    if isinstance(plan.end, Rates) or not plan.end.error:
        return SX(0)
    one, other = plan.end.error
    return ca.norm_2(ends[one].v - ends[other].v)


def step_errors(plan: Plan, before: State, ends: Mapping[str, State], layout: Layout) -> SX:
    """Return estimated errors after a step of a plan that has an estimate [rad or m], shape (nv + 1,).

    Those of positions, rotation vectors for orientations, which come first; last that of velocities while anything
    touches, of a floating base those of the base, times `LANDING` if a contact begins or ends in any stage, else times
    `CONTACT`. Where the beginning of a contact takes more than `STOPPED` of the velocity at once, the whole step and
    its halves may agree on a wrong end, because neither rebounds. The whole change of the velocity counts there.

    Args:
        plan: The method.
        before: State before the step.
        ends: At the ends of stages, by name.
        layout: Which rows of `q` are what.
    """
    assert isinstance(plan.end, Ends)
    one, other = (ends[name] for name in plan.end.error)
    turns = {i for i, _ in layout.turns}
    turned = [between(one.q[i : i + 4], other.q[i : i + 4]) for i in sorted(turns)]
    others = [i for i in range(one.q.numel()) if not any(start <= i < start + 4 for start in turns)]
    touches = [[state[name] > 0 for name in TOUCHES] for state in (before, *ends.values())]
    first, *others_touch = [ca.vertcat(SX(0), *each) for each in touches]
    touching = ca.norm_inf(ca.vertcat(first, *others_touch))
    changes = ca.vertcat(*[each - first for each in others_touch])
    begins = ca.mmax(changes) > 0
    moving = layout.base_nv or layout.nv
    v, fine, coarse = (state.v[:moving] for state in (before, one, other))
    difference, change = ca.norm_inf(fine - coarse), ca.norm_inf(fine - v)
    jump = ca.fmax(difference, ca.if_else(ca.logic_and(begins, change > STOPPED * ca.norm_inf(v)), change, 0))
    velocity_error = ca.if_else(
        ca.norm_inf(changes) > 0, LANDING * jump, ca.if_else(touching > 0, CONTACT * difference, 0)
    )
    return ca.vertcat(*turned, (one.q - other.q)[others], velocity_error)
