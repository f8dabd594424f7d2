"""Time-stepping methods as data: stages that evaluate the physics, and their combination.

`unroll` turns a plan into one expression, `ce_gym.sim.substeps` into the calls of a compiled program. Both use the
functions of this file to combine stages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca

from ce_gym.dynamics.algebra.integration import rotate_quaternion, rotation_between
from ce_gym.dynamics.algebra.spatial import SX, quaternion_to_rotation
from ce_gym.dynamics.state import State
from ce_gym.model.coordinates import Layout

MOVED = "moved"
"""Name of the output with the distance of the fastest joint in a step, at its final speed [rad or m]."""
OFF = "off"
"""Name of the output with the estimated errors of a step, shape (nv + 1,), see `step_errors`."""
TOUCHES = ("load", "pair_force")
"""Parts of a state that are positive where bodies touch."""
LANDING, CONTACT = 0.02, 0.005
"""Times that convert an error of velocity to one of position: where a contact begins or ends, and otherwise [s]."""
STOPPED = 0.1
"""Fraction of the velocity that a step may change where a contact begins."""
LOAD = "load"
"""Part of a state with the normal forces of the previous step, unless a stage has another."""
AFTER = "after"
"""Name of the whole step, for outputs that are evaluated at its end and not combined from stages."""


@dataclass(frozen=True)
class Rates:
    """The state before the step, moved by `dt` times a weighted sum of the stages' rates of change.

    Attributes:
        weights: Weights of the stages, in order; 0 for stages that are left out.
    """

    weights: tuple[float, ...] = ()


@dataclass(frozen=True)
class Ends:
    """A weighted sum of the states at the ends of stages, on the group of orientations.

    Memory of contacts and guesses of dependent coordinates are taken from the last stage.

    Attributes:
        weights: Weight of each stage, by name, the last stage first; the sum is 1.
        means: Weight of each stage in outputs that are means over the step; the sum is 1.
        error: The two stages whose difference in `v` estimates the error of the step; empty without an estimate.
    """

    weights: Mapping[str, float]
    means: Mapping[str, float]
    error: tuple[str, str] | tuple[()] = ()


@dataclass(frozen=True)
class Stage:
    """One evaluation of the physics.

    A stage with a length is a linearly implicit Euler step, iterated until the active set is the assumed one. A stage
    of length 0 evaluates forces and accelerations at its start. The ground is looked up again at each new start.

    Attributes:
        name: Name in variables and weights.
        start: Name of the stage at whose end this one starts, "" for the state before the step; or `Rates` of earlier
            stages.
        length: Length as a fraction of the step.
        iterations: Most iterations after the first; fewer if the forces of the scene need fewer.
        load: Part of the state with the normal forces of contacts for a stage that starts before the step. The forces
            at the end of the stage are stored in that part after the step.
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
        order: Order of the global error in the step length, for smooth motion.
        stages: In the order of evaluation; the first stage starts from the state before the step.
        end: Combination of the stages to the state after the step.
        controlled: Whether kernels choose the step length from the error estimate, see `step_size.py`.
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
        """Whether the only stage is a whole linearly implicit Euler step."""
        return self.single and self.stages[0].length == 1

    @property
    def estimates(self) -> bool:
        """Whether the method estimates its error."""
        return isinstance(self.end, Ends) and bool(self.end.error)

    def shares(self, moment: Literal["start", "end", "mean"]) -> Mapping[str, float]:
        """Return the weight of each stage in an output that belongs to a moment of the step, or is a mean over it."""
        if isinstance(self.end, Rates):
            return {AFTER: 1.0}
        if moment == "start":
            return {self.stages[0].name: 1.0}
        return self.end.means if moment == "mean" else self.end.weights


def combined(plan: Plan, ends: Mapping[str, State], layout: Layout) -> State:
    """Return the state after a step from the states at the ends of its stages, for a plan whose `end` is `Ends`."""
    assert isinstance(plan.end, Ends)
    weights, last = plan.end.weights, ends[plan.stages[-1].name]
    if plan.single:
        return last
    q = sum((weight * ends[name].q for name, weight in weights.items()), SX(0))
    v = sum((weight * ends[name].v for name, weight in weights.items()), SX(0))
    for i, _ in layout.turns:
        others = [(weight, ends[name].q[i : i + 4]) for name, weight in weights.items() if ends[name] is not last]
        turned = sum((-weight * rotation_between(other, last.q[i : i + 4]) for weight, other in others), SX(0))
        q[i : i + 4] = rotate_quaternion(last.q[i : i + 4], turned)
    if layout.floating:
        world = [w * (quaternion_to_rotation(ends[s].q[3:7]) @ ends[s].v[3:6]) for s, w in weights.items()]
        v[3:6] = quaternion_to_rotation(q[3:7]).T @ sum(world, SX(0))
    loads = {stage.load: ends[stage.name][LOAD] for stage in plan.stages if stage.load != LOAD}
    return last.replaced(q=q, v=v, **loads)


def error_estimate(plan: Plan, ends: Mapping[str, State]) -> SX:
    """Return the estimated error of a step in `v` [rad/s or m/s]; 0 for a plan without an estimate."""
    if isinstance(plan.end, Rates) or not plan.end.error:
        return SX(0)
    one, other = plan.end.error
    return ca.norm_2(ends[one].v - ends[other].v)


def step_errors(plan: Plan, before: State, ends: Mapping[str, State], layout: Layout) -> SX:
    """Return estimated errors after a step of a plan with an estimate [rad or m], shape (nv + 1,).

    The first nv entries are errors of positions: first rotation vectors of orientations, then all others. The last
    entry is 0 without contact. In contact it is the error of the velocities, or of the base velocity of a floating
    robot, times `LANDING` if a contact begins or ends in any stage and times `CONTACT` otherwise. If the beginning of a
    contact takes more than `STOPPED` of the velocity, the whole change of the velocity counts as its error: the whole
    step and its halves may agree on a wrong end there, because neither rebounds.

    Args:
        plan: The method.
        before: State before the step.
        ends: States at the ends of stages, by name.
        layout: Layout of the coordinates.
    """
    assert isinstance(plan.end, Ends)
    one, other = (ends[name] for name in plan.end.error)
    turns = {i for i, _ in layout.turns}
    turned = [rotation_between(one.q[i : i + 4], other.q[i : i + 4]) for i in sorted(turns)]
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
