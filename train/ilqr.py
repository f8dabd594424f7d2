"""Iterative LQR through the steps of a simulator: targets and feedback that make one robot's motion cheap.

The state is all that a step hands on to the next, loads of contacts included, so that linearised steps can be chained
where feet land and slide. All sub-steps of a motion are linearised in one call, each as a robot of its own; all step
lengths of the line search are robots side by side. Knows no robot and no task.

Source: Tassa, Erez, Todorov, "Synthesis and Stabilization of Complex Behaviors through Online Trajectory
Optimization", IROS 2012, with Gauss-Newton costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

import ce_gym

Array = NDArray[Any]
State = dict[str, Array]

LENGTHS = 0.6 ** np.arange(16)
"""Shares of the full step that a line search tries, all at once."""
DAMPING = 1e-6, 1e10
"""Least and largest number added to the curvature by targets."""


class Cost(Protocol):
    """Half the sum of squares of residuals at the ends of control steps, and of changes of targets."""

    def residuals(self, i: int, q: Array, v: Array) -> Array:
        """Return those at the start of control step i, of robots (n, nq), (n, nv): shape (n, n_residuals)."""
        ...

    def slopes(self, i: int, q: Array, v: Array) -> Array:
        """Return their derivatives by [q; v] of one robot, shape (n_residuals, 2 nv)."""
        ...

    def target_residuals(self, i: int, targets: Array) -> Array:
        """Return those of targets (n, n_targets), in which they are linear: shape (n, n_targets)."""
        ...

    target_slope: float


@dataclass(frozen=True)
class Plan:
    """A motion, and what to do where a robot is beside it.

    Attributes:
        states: Of the robot at the start of each sub-step and at the end of the last, (n_substeps + 1, size) by part.
        targets: Of each control step, shape (n, n_targets).
        gains: By how much targets change with the state, shape (n, n_targets, n_state).
        cost: See `Cost`.
    """

    states: State
    targets: Array
    gains: Array
    cost: float


class ILQR:
    """Iterative LQR of one robot's motion.

    Args:
        make: Makes a simulator of so many robots.
        cost: What is to be small.
        start: State of one robot, see `StepDerivatives.state`.
        hold: Sub-steps for which a target is held.
    """

    def __init__(self, make: Callable[[int], ce_gym.Simulator], cost: Cost, start: State, hold: int) -> None:
        self.make, self.cost, self.start, self.hold = make, cost, start, hold
        self.candidates = ce_gym.StepDerivatives(make(len(LENGTHS)))
        self.along: ce_gym.StepDerivatives | None = None
        self.damping = 1.0

    def follow(self, plan: Plan, change: Array, lengths: Array, robots: ce_gym.StepDerivatives) -> tuple[Array, list]:
        """Let robots follow a plan with feedback, their targets changed by shares of `change` (n, n_targets).

        Returns:
            Costs, shape (n_robots,), inf for one that diverged, and what `chosen` takes.
        """
        sim, n = robots.simulator, len(lengths)
        robots.restore({name: np.repeat(row, n, axis=0) for name, row in self.start.items()})
        costs, kept, used = np.zeros(n), [robots.state()], list[Array]()
        for i in range(len(plan.targets)):
            now, before = kept[-1], {name: rows[i * self.hold] for name, rows in plan.states.items()}
            targets = plan.targets[i] + lengths[:, None] * change[i]
            targets += apart(sim.model, now, before) @ plan.gains[i].T
            costs += self._costs(i, now) + (self.cost.target_residuals(i, targets) ** 2).sum(1) / 2
            used.append(targets)
            for _ in range(self.hold):
                sim.step(targets)
                kept.append(robots.state())
        costs += self._costs(len(plan.targets), kept[-1])
        return np.where(np.isfinite(costs) & ~sim.diverged, costs, np.inf), [kept, used]

    def _costs(self, i: int, state: State) -> Array:
        return (self.cost.residuals(i, state["q"], state["v"]) ** 2).sum(1) / 2

    def first(self, targets: Array) -> Plan:
        """Return the plan of just these targets (n, n_targets)."""
        width = sum(self.candidates.state_sizes.values())
        states = {name: np.repeat(row, len(targets) * self.hold + 1, axis=0) for name, row in self.start.items()}
        plan = Plan(states, targets, np.zeros((*targets.shape, width)), np.inf)
        costs, what = self.follow(plan, np.zeros_like(targets), LENGTHS, self.candidates)
        return chosen(0, costs, what, plan.gains)

    def linearized(self, plan: Plan) -> tuple[Array, Array]:
        """Return A and B of each control step."""
        n = len(plan.targets) * self.hold
        if self.along is None or self.along.simulator.num_envs != n:
            self.along = ce_gym.StepDerivatives(self.make(n))
        self.along.restore({name: rows[:-1] for name, rows in plan.states.items()})
        A, B = self.along.linearize(np.repeat(plan.targets, self.hold, axis=0), whole_state=True, by_rows=True)
        whole, by_target = A[:: self.hold], B[:: self.hold]
        for k in range(1, self.hold):
            whole, by_target = A[k :: self.hold] @ whole, A[k :: self.hold] @ by_target + B[k :: self.hold]
        return whole, by_target

    def improved(self, plan: Plan) -> Plan | None:
        """Return a cheaper plan; None if there is none along the way that was found."""
        A, B = self.linearized(plan)
        while self.damping < DAMPING[1]:
            found = self._backwards(plan, A, B)
            if found is not None:
                change, gains = found
                tried = Plan(plan.states, plan.targets, gains, plan.cost)
                costs, what = self.follow(tried, change, LENGTHS, self.candidates)
                best = int(costs.argmin())
                if costs[best] < plan.cost:
                    self.damping = max(DAMPING[0], self.damping * (0.3 if best < 4 else 1.0 if best < 9 else 3.0))
                    return chosen(best, costs, what, gains)
            self.damping *= 5
        return None

    def with_feedback(self, plan: Plan) -> Plan:
        """Return a plan with the gains of the linear-quadratic regulator about it, as little damped as they can be."""
        A, B = self.linearized(plan)
        self.damping = DAMPING[0]
        while (found := self._backwards(plan, A, B)) is None:
            self.damping *= 10
        return replace(plan, gains=found[1])

    def _backwards(self, plan: Plan, A: Array, B: Array) -> tuple[Array, Array] | None:
        """Return the change of targets and the gains; None if the curvature is not positive."""
        n, m = plan.targets.shape
        slope, curvature = self._terminal(n, plan)
        change, gains = np.zeros((n, m)), np.zeros(plan.gains.shape)
        w = self.cost.target_slope
        for i in reversed(range(n)):
            by_x, by_xx = self._terminal(i, plan)
            by_u = B[i].T @ slope + w * self.cost.target_residuals(i, plan.targets[i : i + 1])[0]
            back = curvature @ B[i]
            by_uu, by_ux = B[i].T @ back + w**2 * np.eye(m), back.T @ A[i]
            try:
                factor = np.linalg.inv(np.linalg.cholesky(by_uu + self.damping * np.eye(m)))
            except np.linalg.LinAlgError:
                return None
            change[i], gains[i] = -factor.T @ (factor @ by_u), -factor.T @ (factor @ by_ux)
            K = gains[i]
            slope = by_x + A[i].T @ slope + K.T @ (by_uu @ change[i] + by_u) + by_ux.T @ change[i]
            curvature = by_xx + A[i].T @ curvature @ A[i] + K.T @ by_uu @ K + K.T @ by_ux + by_ux.T @ K
            curvature = (curvature + curvature.T) / 2
        return change, gains

    def _terminal(self, i: int, plan: Plan) -> tuple[Array, Array]:
        """Slope and curvature of the cost at the start of control step i."""
        q, v = (plan.states[name][i * self.hold : i * self.hold + 1] for name in ("q", "v"))
        J, r, nv = self.cost.slopes(i, q, v), self.cost.residuals(i, q, v)[0], v.shape[1]
        width = plan.gains.shape[2]
        slope, curvature = np.zeros(width), np.zeros((width, width))
        slope[: 2 * nv], curvature[: 2 * nv, : 2 * nv] = J.T @ r, J.T @ J
        return slope, curvature


def chosen(which: int, costs: Array, what: list, gains: Array) -> Plan:
    """Return the plan that one of the robots followed."""
    kept, used = what
    states = {name: np.stack([state[name][which] for state in kept]) for name in kept[0]}
    return Plan(states, np.stack([targets[which] for targets in used]), gains, float(costs[which]))


def apart(model: ce_gym.Model, now: State, before: State) -> Array:
    """Return the way from one state (of size (size,) by part) to states of robots, (n, n_state), in tangents."""
    q, other = now["q"], before["q"]
    others = [now[name] - before[name] for name in ("v", "load", "anchor") if name in now]
    if not model.robot.floating:
        return np.hstack([q - other, *others])
    w, u, ow, ou = other[3], other[4:7], q[:, 3:4], q[:, 4:7]
    turn = 2 * np.sign(ow * w + ou @ u[:, None]) * (w * ou - ow * u - np.cross(u, ou))
    p = q[:, :3] - other[:3]
    way = p + 2 * np.cross(-u, np.cross(-u, p) + w * p)
    return np.hstack([turn, way, q[:, 7:] - other[7:], *others])
