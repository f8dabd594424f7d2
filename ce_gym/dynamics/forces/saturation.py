"""A torque kept within limits, of a joint or of a motor, linearly implicit in the step.

Within the limits the torque is the commanded one; at a limit it is the limit, and depends on accelerations only as the
limit does. Which of the three it is depends on the acceleration, and vice versa. The first iteration decides by the
command at zero acceleration, further ones by the torque that the iteration before predicts for the end of the step. It
matters on light links: deciding saturation at zero acceleration applies an excessive impulse there.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.linear import JointForce, Motion

ITERATIONS = 4
"""How many iterations of a step saturation may ask for after the first."""

SHORT = 1e-6
"""Share of a limit by which an expected torque stays short of it."""
LARGE = 1e30
"""Keeps infinite limits infinite [N m or N]."""


@dataclass
class Saturation:
    """A torque that is kept within limits.

    Attributes:
        asked: The commanded torque `tau - slope @ ydd` [N m or N], linear in the acceleration.
        high, low: Limits, linear in the acceleration; the slopes of constant limits are 0.
        expected: The torque [N m or N] whose place among the limits is the active set.
    """

    asked: JointForce
    high: JointForce
    low: JointForce
    expected: SX

    @staticmethod
    def about(iterate: SX, place: int, asked: JointForce, high: JointForce, low: JointForce) -> Saturation:
        """Return a torque with its expected value in an iterate; in the first iteration at zero acceleration."""
        first = Saturation(asked, high, low, asked.tau)
        if not first.answers:
            return first
        return replace(first, expected=ca.if_else(iterate[-1] > 0, iterate[place], asked.tau))

    @property
    def answers(self) -> bool:
        """Whether the active set depends on accelerations at all."""
        return any(ca.sparsify(force.slope).nnz() for force in (self.asked, self.high, self.low))

    @property
    def at_high(self) -> SX:
        """1 if it is taken to be at its upper limit, else 0."""
        return self.expected > self.high.tau

    @property
    def at_low(self) -> SX:
        """1 if it is taken to be at its lower limit, else 0."""
        return self.expected < self.low.tau

    @property
    def free(self) -> SX:
        """1 if the torque is the commanded one, else 0."""
        return ca.logic_not(ca.logic_or(self.at_high, self.at_low))

    @property
    def given(self) -> SX:
        """The torque at zero acceleration [N m or N]."""
        return ca.if_else(self.at_high, self.high.tau, ca.if_else(self.at_low, self.low.tau, self.asked.tau))

    def after(self, ydd: SX) -> Saturation:
        """Return it with the active set at the end of the step, given the accelerations.

        The predicted end-of-step torque keeps its violation of a limit as the next guess. It never goes from beyond one
        limit to beyond the other, because the range between has not been tried then: it stays short of the other, by
        more than rounding, because other functions that read the iterate round the limits differently.
        """
        asked = self.asked.at(ydd)
        short_of_high = self.high.tau - SHORT * ca.fmin(ca.fabs(self.high.tau), LARGE)
        short_of_low = self.low.tau + SHORT * ca.fmin(ca.fabs(self.low.tau), LARGE)
        if ca.sparsify(self.high.slope).nnz() or ca.sparsify(self.low.slope).nnz():
            over = asked - self.high.at(ydd)
            under = self.low.at(ydd) - asked
            within = ca.fmax(short_of_low, ca.fmin(short_of_high, asked))
            asked = ca.if_else(over > 0, self.high.tau + over, ca.if_else(under > 0, self.low.tau - under, within))
        kept = ca.if_else(self.at_low, ca.fmin(asked, short_of_high), asked)
        return replace(self, expected=ca.if_else(self.at_high, ca.fmax(asked, short_of_low), kept))


@dataclass
class Stick:
    """Dry friction of one joint or rotor over one step.

    Attributes:
        turning: Speed of the joint or rotor for unit velocities of all independent joints, shape (1, nj).
        sticks: 1 if it sticks, else 0.
        rests: 1 if it was at rest at the start of the step, else 0.
    """

    turning: SX
    sticks: SX
    rests: SX


@dataclass
class SaturatedForce(JointForce):
    """A force on joints made of torques within limits.

    Attributes:
        size: Size of the iterate: the expected torques, then `count`.
        limited: The torques within limits, by their rows in the iterate.
        frictions: Dry friction of joints or rotors.
        windings: Torques of motors before losses, by the places of the motors.
        on_line: Torque-speed line of each motor, by its place: 1 forwards, -1 backwards, 0 for none.
        sampled: The field `held_torque` after the step.
        count: Last entry of the next iterate; above 0, because there has been an iteration.
    """

    size: int
    limited: dict[int, Saturation] = field(default_factory=dict)
    frictions: list[Stick] = field(default_factory=list)
    windings: dict[int, JointForce] = field(default_factory=dict)
    on_line: dict[int, SX] = field(default_factory=dict)
    sampled: SX = field(default_factory=lambda: SX(0, 1))
    count: SX | int = 1

    def check(self, motion: Motion) -> SX:
        """Return 1 if a torque is at another limit than was assumed; else 0."""
        changed = SX(0)
        for torque in self.limited.values():
            if torque.answers:
                after = torque.after(motion.ydd)
                elsewhere = ca.logic_or(after.at_high != torque.at_high, after.at_low != torque.at_low)
                changed = ca.logic_or(changed, elsewhere)
        return changed

    def next_iterate(self, motion: Motion) -> SX:
        """Return the iterate for another iteration, shape (size,)."""
        iterate = SX(self.size, 1)
        for place, torque in self.limited.items():
            if torque.answers:
                iterate[place] = torque.after(motion.ydd).expected
        if self.size:
            iterate[-1] = self.count
        return iterate
