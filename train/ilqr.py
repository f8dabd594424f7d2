"""Iterative LQR through the steps of a simulator: joint targets and feedback that minimise a cost of the motion.

The state contains all quantities that a step passes to the next, such as contact loads, so that linearised steps can be
chained while feet land and slide. One call linearises all sub-steps of a motion, each with its own robot of a batch.
The step lengths of the line search are robots of another batch.

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
"""Step lengths of the line search, as fractions of the full step."""
DAMPING = 1e-6, 1e10
"""Smallest and largest damping, added to the second derivative with respect to targets."""


class Cost(Protocol):
    """A cost: half the sum of squares of residuals of states and targets over all control steps."""

    def residuals(self, i: int, q: Array, v: Array) -> Array:
        """Return residuals at the start of control step i, shape (n, n_residuals), for q (n, nq) and v (n, nv)."""
        ...

    def slopes(self, i: int, q: Array, v: Array) -> Array:
        """Return derivatives of the residuals with respect to [q; v] of one robot, shape (n_residuals, 2 nv)."""
        ...

    def target_residuals(self, i: int, targets: Array) -> Array:
        """Return residuals of targets, shape (n, n_targets), linear in the targets with slope `target_slope`."""
        ...

    target_slope: float


@dataclass(frozen=True)
class Plan:
    """A motion with feedback.

    Attributes:
        states: States at the start of each sub-step and at the end, by name, shape (n_substeps + 1, size) each.
        targets: Joint targets of each control step, shape (n, n_targets).
        gains: Feedback gains from state to targets, shape (n, n_targets, n_state).
        cost: Cost of the motion, see `Cost`.
    """

    states: State
    targets: Array
    gains: Array
    cost: float


class ILQR:
    """Iterative LQR of one robot's motion.

    Args:
        make: Function that returns a simulator with a number of robots.
        cost: The cost.
        start: Initial state of one robot, see `StepDerivatives.state`.
        hold: Sub-steps in a control step.
    """

    def __init__(self, make: Callable[[int], ce_gym.Simulator], cost: Cost, start: State, hold: int) -> None:
        self.make, self.cost, self.start, self.hold = make, cost, start, hold
        self.candidates = ce_gym.StepDerivatives(make(len(LENGTHS)))
        self.along: ce_gym.StepDerivatives | None = None
        self.damping = 1.0

    def follow(self, plan: Plan, change: Array, lengths: Array, robots: ce_gym.StepDerivatives) -> tuple[Array, list]:
        """Let robots follow a plan with feedback and changed targets.

        Args:
            plan: The plan.
            change: Change of targets, shape (n, n_targets).
            lengths: Fraction of the change for each robot, shape (n_robots,).
            robots: Simulator of the robots.

        Returns:
            Costs, shape (n_robots,), inf for a robot that diverged; states and targets for `select`.
        """
        sim, n = robots.simulator, len(lengths)
        robots.restore({name: np.repeat(row, n, axis=0) for name, row in self.start.items()})
        costs, states, all_targets = np.zeros(n), [robots.state()], list[Array]()
        for i in range(len(plan.targets)):
            state, planned = states[-1], {name: rows[i * self.hold] for name, rows in plan.states.items()}
            targets = plan.targets[i] + lengths[:, None] * change[i]
            targets += difference(sim.model, state, planned) @ plan.gains[i].T
            costs += self._costs(i, state) + (self.cost.target_residuals(i, targets) ** 2).sum(1) / 2
            all_targets.append(targets)
            for _ in range(self.hold):
                sim.step(targets)
                states.append(robots.state())
        costs += self._costs(len(plan.targets), states[-1])
        return np.where(np.isfinite(costs) & ~sim.diverged, costs, np.inf), [states, all_targets]

    def _costs(self, i: int, state: State) -> Array:
        return (self.cost.residuals(i, state["q"], state["v"]) ** 2).sum(1) / 2

    def first(self, targets: Array) -> Plan:
        """Return the motion with these targets (n, n_targets) and no feedback."""
        width = sum(self.candidates.state_sizes.values())
        states = {name: np.repeat(row, len(targets) * self.hold + 1, axis=0) for name, row in self.start.items()}
        plan = Plan(states, targets, np.zeros((*targets.shape, width)), np.inf)
        costs, motions = self.follow(plan, np.zeros_like(targets), LENGTHS, self.candidates)
        return select(0, costs, motions, plan.gains)

    def linearized(self, plan: Plan) -> tuple[Array, Array]:
        """Return the derivatives A and B of each control step with respect to state and targets."""
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
        """Return a plan with a lower cost, or None if no damping gives one."""
        A, B = self.linearized(plan)
        while self.damping < DAMPING[1]:
            policy = self._backwards(plan, A, B)
            if policy is not None:
                change, gains = policy
                with_gains = replace(plan, gains=gains)
                costs, motions = self.follow(with_gains, change, LENGTHS, self.candidates)
                best = int(costs.argmin())
                if costs[best] < plan.cost:
                    self.damping = max(DAMPING[0], self.damping * (0.3 if best < 4 else 1.0 if best < 9 else 3.0))
                    return select(best, costs, motions, gains)
            self.damping *= 5
        return None

    def with_feedback(self, plan: Plan) -> Plan:
        """Return a plan with the gains of its linear-quadratic regulator, with the smallest possible damping."""
        A, B = self.linearized(plan)
        self.damping = DAMPING[0]
        while (policy := self._backwards(plan, A, B)) is None:
            self.damping *= 10
        return replace(plan, gains=policy[1])

    def _backwards(self, plan: Plan, A: Array, B: Array) -> tuple[Array, Array] | None:
        """Return change of targets and gains, or None if the second derivative is not positive definite."""
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
        """Return first and second derivative of the cost of the state at the start of control step i."""
        q, v = (plan.states[name][i * self.hold : i * self.hold + 1] for name in ("q", "v"))
        J, r, nv = self.cost.slopes(i, q, v), self.cost.residuals(i, q, v)[0], v.shape[1]
        width = plan.gains.shape[2]
        slope, curvature = np.zeros(width), np.zeros((width, width))
        slope[: 2 * nv], curvature[: 2 * nv, : 2 * nv] = J.T @ r, J.T @ J
        return slope, curvature


def select(robot: int, costs: Array, motions: list, gains: Array) -> Plan:
    """Return the motion of one robot from the result of `ILQR.follow`."""
    states, targets = motions
    own_states = {name: np.stack([state[name][robot] for state in states]) for name in states[0]}
    return Plan(own_states, np.stack([rows[robot] for rows in targets]), gains, float(costs[robot]))


def difference(model: ce_gym.Model, states: State, reference: State) -> Array:
    """Return the difference of states to a reference in the tangent space, shape (n, n_state).

    Args:
        model: Model of the robot.
        states: States of n robots by name, shape (n, size) each.
        reference: One state by name, shape (size,) each.
    """
    q, other = states["q"], reference["q"]
    others = [states[name] - reference[name] for name in ("v", "load", "anchor") if name in states]
    if not model.robot.floating:
        return np.hstack([q - other, *others])
    w, u, ow, ou = other[3], other[4:7], q[:, 3:4], q[:, 4:7]
    turn = 2 * np.sign(ow * w + ou @ u[:, None]) * (w * ou - ow * u - np.cross(u, ou))
    p = q[:, :3] - other[:3]
    shift = p + 2 * np.cross(-u, np.cross(-u, p) + w * p)
    return np.hstack([turn, shift, q[:, 7:] - other[7:], *others])
