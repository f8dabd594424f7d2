"""What an environment does around the sub-steps, as traced functions of the state in the schema.

assess   after a control step: reward terms, terminations, metrics, the next command, the observation
place    before a reset on a field: where the robot stands
begin    a reset: the state of a new episode, its first observation
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import casadi as ca
import numpy as np

from ce_gym.compile import Call, Grid
from ce_gym.dynamics.algebra.integration import turned_by
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.hulls import with_hulls
from ce_gym.envs.runtime.spec import TaskSpec
from ce_gym.envs.task.commands import Commands
from ce_gym.envs.task.ground import SEEN, resting_load, starting_place
from ce_gym.envs.task.sampling import Sampler
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.registry import Term
from ce_gym.sim.schema import Row
from ce_gym.sim.substeps import FRAME

OBSERVATION_BOUND = 100.0
"""Observations are clipped here; blocks are of order one, so only a robot about to fail comes near it."""
OUTCOME = ("reward", "terminated", "truncated", "diverged", "done")
"""Columns of the rows `outcome`; the weighted reward terms follow."""


@dataclass(frozen=True)
class Probe:
    """What the terms of a task turn out to be.

    Attributes:
        sizes: Length of each observation block, by name; the policy's first.
        memories: Rows of what terms remember, and of errors of sensors that stay for an episode.
        looked: How many heights of the ground terms look up, by name of what is found.
        grids: What they look at around every place, likewise.
        added: A text that changes with terms that users have added, for cache keys.
    """

    sizes: dict[str, int]
    memories: tuple[Row, ...]
    looked: Mapping[str, int]
    grids: Mapping[str, Grid]
    added: str


class Stages:
    """Traces the stages of a task on a robot.

    Args:
        spec: The task on the robot.
        schema: The state.
        looked: See `Probe`.
    """

    def __init__(
        self, spec: TaskSpec, schema: Mapping[str, Row], looked: Mapping[str, int] = MappingProxyType({})
    ) -> None:
        self.spec, self.task, self.model = spec, spec.task, spec.model
        self.schema = {row.name: row for row in schema.values() if not row.dtype and row.name != FRAME}
        self.commands = Commands(self.task, spec.curriculum)
        self.state = {name: SX.sym(name, row.size) for name, row in self.schema.items()}
        seen = {SEEN: spec.ground.size} if spec.ground else {}
        self.seen_ground = {name: SX.sym(name, size) for name, size in (seen | dict(looked)).items()}

    def probe(self) -> Probe:
        """Trace every term once."""
        p, sampler = self.spec, Sampler()
        s = self._context(self.state | self.seen_ground | {"previous_action": self.state["action"]})
        for term in (*p.reward_terms.values(), *p.termination_terms.values(), *p.metric_terms.values()):
            term.number(s)
        sensed, exact = self._blocks(s, sampler)
        blocks = sensed | exact
        kinds = (p.reward_terms, p.termination_terms, p.metric_terms, p.observation_terms, p.critic_terms)
        added = [term for terms in kinds for term in terms.values() if term.added]
        values = {f"x{i}": term(s) for i, term in enumerate(added) if term.kind != "observation"}
        found = {"k": s.kept, "s": sensed, "e": exact, "p": s.places}
        values |= {f"{kind}_{name}": x for kind, group in found.items() for name, x in group.items()}
        inputs = self.state | self.seen_ground | s.remembered | s.drifts | s.heights | {"draws": sampler.symbols}
        rows = tuple(Row(name, x.numel(), "term", s.resets[name]) for name, x in s.remembered.items())
        rows += tuple(Row(name, x.numel(), "drift") for name, x in s.drifts.items())
        text = f"{traced('added', inputs, values).serialize()} {rows!r} {s.grids!r}" if added else ""
        looked = {name: heights.numel() for name, heights in s.heights.items()}
        return Probe({name: block.numel() for name, block in blocks.items()}, rows, looked, s.grids, text)

    def places(self, begins: bool) -> list[Call]:
        """Trace where terms look at the ground, after the sub-steps or where a robot `begins`.

        Returns:
            Calls, each of which may depend on what is found at the places of those before.

        Raises:
            ValueError: If that depends on what is not known before observations are made.
        """
        state = self.state | {"clock": SX(0) if begins else self.state["clock"] + 1}
        s = self._context(state | self.seen_ground | {"previous_action": state["action"]})
        self._blocks(s, Sampler())
        places = {f"{name}_places": at for name, at in s.places.items()}
        given, calls = dict(self.state), []
        while places:
            known = {x.name() for x in ca.symvar(ca.vertcat(*[ca.vec(x) for x in given.values()]))}
            unknown = {name: {x.name() for x in ca.symvar(at)} - known for name, at in places.items()}
            if all(unknown.values()):
                name, first = next(iter(unknown.items()))
                expected = "expected positions and memory alone"
                raise ValueError(f"{name}: depends on {', '.join(sorted(first))}; {expected}")
            ready = [name for name in places if not unknown[name]]
            calls.append(_call("seen_by_terms", given, {name: places.pop(name) for name in ready}))
            found = [name.removesuffix("_places") for name in ready]
            given |= {name: self.seen_ground[name] for name in found}
        return calls

    def look(self) -> ca.Function:
        """Trace one observation of the policy, neither noisy nor clipped, and `failed`; of what they look at."""
        s = self._context(self.state | {"previous_action": self.state["action"]})
        seen = {name: term(s) for name, term in self.spec.observation_terms.items()}
        seen["failed"] = self._failed(s)
        return traced("look", _used(self.state, seen), seen)

    def values(self, terms: Mapping[str, Term]) -> ca.Function:
        """Trace terms alone, one after the other; of the state and the action before."""
        state = self.state | {"previous_action": SX.sym("previous_action", self.spec.n_actions)}
        s = self._context(state)
        values = {"values": ca.vertcat(SX(0, 1), *[term(s) for term in terms.values()])}
        return traced("terms", _used(state, values), values)

    def assess(self) -> tuple[Call, int]:
        """Trace what follows the sub-steps; return the call and how many random numbers it takes."""
        p, task, state, sampler = self.spec, self.task, self.state, Sampler()
        clipped = SX.sym("clipped", p.n_actions)
        values = state | self.seen_ground | {"action": clipped, "previous_action": state["action"]}
        s = self._context(values)
        terms = [term.weight * term.number(s) * p.control_dt for term in p.reward_terms.values()]
        total = sum(terms, SX(0))
        reward = ca.fmax(0, total) if task.only_positive else total
        diverged = state["diverged"] > 0.5
        terminated = ca.logic_and(self._failed(s), ca.logic_not(diverged))
        after = {"action": clipped, "elapsed": state["elapsed"] + 1, "clock": state["clock"] + 1}
        metrics = [self._summed(term, s, i) for i, term in enumerate(p.metric_terms.values(), 1 + len(terms))]
        after["sums"] = ca.vertcat(state["sums"][: 1 + len(terms)] + ca.vertcat(reward, *terms), *metrics)
        after["failures"] = state["failures"] + diverged
        if "air_time" in state:
            after["air_time"] = ca.if_else(s.foot_contact, 0, state["air_time"] + p.control_dt)
        after |= p.curriculum.followed(s, state) | s.kept

        fresh = self.commands.new(sampler, state.get("grown"))
        due = self._every(task.command_period, after["clock"])
        commanded = {name: ca.if_else(due, fresh[name], state[name]) for name in fresh}
        if task.push_period:
            after["v"] = self._pushed(state["v"], after["clock"], sampler)
        after |= self.commands.steered(values | after, commanded)
        seen = self._context(values | after)
        observation, history = self._observation(seen, state.get("history"), sampler)
        after |= seen.kept | ({"history": history} if "history" in state else {})

        truncated = ca.logic_or(after["elapsed"] >= state["limit"], diverged)
        after["chosen"] = done = ca.logic_or(terminated, truncated)
        outcome = ca.vertcat(reward, terminated, truncated, diverged, done, *terms)
        # mask NaN and Inf of robots that have diverged
        outcome = ca.if_else(ca.logic_or(ca.logic_not(diverged), ca.fabs(outcome) < ca.inf), outcome, 0)
        sums = ca.if_else(ca.logic_and(done, ca.fabs(after["sums"]) < ca.inf), after["sums"], 0)
        ended = ca.vertcat(ca.if_else(done, after["elapsed"], 0), sums)
        outputs = after | {"observation": observation, "outcome": outcome, "ended": ended}
        given = state | self.seen_ground | {"clipped": clipped, "draws": sampler.symbols}
        return _call("assess", given, outputs), sampler.symbols.numel()

    def begin(self) -> tuple[Call, int]:
        """Trace a reset where `chosen`; return the call and how many random numbers it takes.

        On a field the robots have been placed: their state has where they stand, all but the height of the ground.
        """
        p, sampler = self.spec, Sampler()
        ours = {name for name, row in self.schema.items() if row.writer in ("physics", "task", "term", "drift")}
        ours -= {"chosen", "retries"}  # the latter counts on, so that who looks after a reset sees it too
        state = {name: x for name, x in self.state.items() if name in ours}
        fresh = {name: SX(np.broadcast_to(self.schema[name].reset, x.shape[0])) for name, x in state.items()}
        fresh |= {name: state[name] for name in ("failures", "level") if name in state}
        ground = self.seen_ground.get(SEEN)
        if p.ground and ground is not None:
            fresh["q"] = SX(state["q"])
            fresh["q"][2] += p.ground.lift(state["q"], state.get("dependent"), ground)
        else:
            fresh["q"] = self._starting_pose(sampler)
        fresh["v"] = self._starting_velocity(sampler)
        fresh |= {name: state[name] for name in self._drifts} if p.ground else self._drifting(sampler)
        if "grown" in fresh:
            fresh["grown"] = p.curriculum.grown(state)
        if "draw" in fresh:
            fresh["draw"] = ca.vertcat(*[sampler.unit() for _ in range(p.randomised.n_draws)])
            fresh["parameters"] = p.randomised.values(fresh["draw"])
        if "delay" in fresh:
            low, high = self.task.latency
            fresh["delay"] = ca.floor(sampler.uniform(low, high + 1))
            fresh["target"] = SX(p.actions.rest)
        if "load" in fresh:
            resting = resting_load(self.model.mechanism, p.options, fresh, ground)
            fresh |= {name: resting for name in ("load", "whole_load") if name in fresh}
        fresh |= self.commands.new(sampler, fresh.get("grown"))
        fresh |= self.commands.steered(fresh, {name: fresh[name] for name in ("command", "heading") if name in fresh})
        chosen = self.state["chosen"] > 0.5
        after = {name: ca.if_else(chosen, ca.densify(fresh[name]), x) for name, x in state.items()}
        s = self._context(self.state | after | self.seen_ground | {"previous_action": after["action"]})
        observation, history = self._observation(s, None, sampler)
        later = s.kept | ({"history": history} if "history" in state else {})
        after |= {name: ca.if_else(chosen, value, state[name]) for name, value in later.items()}
        given = self.state | self.seen_ground | {"first_draws": sampler.symbols}
        return _call("begin", given, after | {"observation": observation}), sampler.symbols.numel()

    def place(self) -> tuple[Call, int]:
        """Trace how those who are `chosen` take a pose on a tile of the field as if the ground were at 0."""
        state, sampler, curriculum = self.state, Sampler(), self.spec.curriculum
        level = curriculum.level(state, sampler, self.spec.control_dt)
        place = starting_place(curriculum, level, sampler)
        fresh = {"q": self._starting_pose(sampler), "level": level, **self._drifting(sampler)}
        fresh["q"][:2] = place
        fresh |= {"dependent": SX(self.model.guess)} if "dependent" in state else {}
        after = {name: ca.if_else(state["chosen"] > 0.5, value, state[name]) for name, value in fresh.items()}
        return _call("place", state | {"place_draws": sampler.symbols}, after), sampler.symbols.numel()

    def _context(self, values: Mapping[str, SX]) -> TermContext:
        values = dict(values) | ({"scaled_parameters": 2 * values["draw"] - 1} if "draw" in values else {})
        p = self.spec
        values |= {"load": with_hulls(values["load"], p.options.hulls)} if "load" in values else {}
        return TermContext(self.model.mechanism, values, p.control_dt, self.task.gait_period, p.contacts)

    @property
    def _drifts(self) -> list[str]:
        return [name for name, row in self.schema.items() if row.writer == "drift"]

    def _drifting(self, sampler: Sampler) -> dict[str, SX]:
        """Draw the errors of sensors that stay for an episode."""
        return {name: sampler.symmetric(self.schema[name].size, 1.0) for name in self._drifts}

    def _failed(self, s: TermContext) -> SX:
        return sum([term.number(s) for term in self.spec.termination_terms.values()], SX(0)) > 0

    def _summed(self, term: Term, s: TermContext, row: int) -> SX:
        """Sum of a metric so far; of one that counts at the end of an episode a number whose mean is its value."""
        value, elapsed = term.number(s), self.state["elapsed"] + 1
        return value * elapsed if term.at_the_end else self.state["sums"][row] + value

    def _starting_pose(self, sampler: Sampler) -> SX:
        """Positions near the standing pose or, if the task says so, above it and leaning; heading anywhere."""
        standing = SX(self.model.standing_q)
        half_yaw = sampler.uniform(-np.pi / 2, np.pi / 2)
        layout = self.model.robot.layout
        still = SX(layout.joints - len(self.model.joint_links), 1)  # transmissions begin as they are at rest
        n = layout.nv - layout.base_nv - still.numel()
        noise = ca.vertcat(sampler.symmetric(n, self.task.reset_noise["joint_position"]), still)
        heading = ca.vertcat(ca.cos(half_yaw), 0, 0, ca.sin(half_yaw))
        if self.task.start:
            standing, heading = self._starting_place(standing, heading, sampler)
        balls = [
            turned_by(standing[row : row + 4], noise[3 * i : 3 * i + 3]) for i, (row, _) in enumerate(layout.ball_turns)
        ]
        joints = standing[layout.joints_q :] + noise[3 * layout.balls :]
        return ca.densify(ca.vertcat(standing[:3], heading, *balls, joints))

    def _starting_place(self, standing: SX, heading: SX, sampler: Sampler) -> tuple[SX, SX]:
        """Raise and tilt the base as the task's `start` asks for; return positions and the base's quaternion."""
        height, lean = (self.task.start.get(name, (0.0, 0.0)) for name in ("height", "lean"))
        raised = SX(standing)
        raised[2] += sampler.uniform(*height)
        about, angle = sampler.uniform(-np.pi, np.pi), sampler.uniform(*lean)
        return raised, turned_by(heading, angle * ca.vertcat(ca.cos(about), ca.sin(about), 0))

    def _starting_velocity(self, sampler: Sampler) -> SX:
        """Velocities near rest."""
        noise = self.task.reset_noise
        base = sampler.symmetric(6, noise["base_velocity"])
        stretches = self.model.robot.layout.joints - len(self.model.joint_links)
        joints = sampler.symmetric(self.model.nv - 6 - stretches, noise["joint_velocity"])
        return ca.densify(ca.vertcat(base, joints, SX(stretches, 1)))

    def _every(self, period: float, clock: SX) -> SX:
        """1 once in a period [s], else 0."""
        return ca.fmod(clock, max(round(period / self.spec.control_dt), 1)) < 0.5

    def _pushed(self, v: SX, clock: SX, sampler: Sampler) -> SX:
        """Change the horizontal velocity of the base, in its frame, once in a push period."""
        push = ca.vertcat(SX(3, 1), sampler.symmetric(2, self.task.push_speed), SX(v.numel() - 5, 1))
        return v + ca.if_else(self._every(self.task.push_period, clock), ca.densify(push), 0)

    def _observation(self, s: TermContext, before: SX | None, sampler: Sampler) -> tuple[SX, SX]:
        """The policy's observation, noisy and with its history, then the critic's; and the history to keep."""
        task = self.task
        blocks, exact = self._blocks(s, sampler)
        noisy = [b + sampler.symmetric(b.numel(), task.noise[n]) if task.noise.get(n) else b for n, b in blocks.items()]
        now = _clipped(ca.vertcat(*noisy))
        kept = SX(0, 1)
        if task.history > 1:
            kept = ca.repmat(now, task.history - 1, 1) if before is None else before
        policy = ca.vertcat(now, kept)
        critic = _clipped(ca.vertcat(SX(0, 1), *exact.values()))
        return ca.vertcat(policy, critic), policy[: kept.numel()]

    def _blocks(self, s: TermContext, sampler: Sampler) -> tuple[dict[str, SX], dict[str, SX]]:
        """Return the policy's blocks, with errors of sensors but without noise, and the critic's, without either."""
        own, critic = self.spec.observation_terms, self.spec.critic_terms
        s.unit = sampler.unit
        sensed = {name: term(s) for name, term in own.items()}
        s.unit = None
        if not self.task.critic:
            return sensed, {}
        s.again = True
        exact = {name: own[name](s) if f"observation_{name}" in s.erring else block for name, block in sensed.items()}
        s.again = False
        return sensed, exact | {name: term(s) for name, term in critic.items()}


def _call(name: str, given: Mapping[str, SX], after: Mapping[str, SX]) -> Call:
    """Trace a function of those buffers among `given` that `after`, the buffers that it writes, depends on."""
    used = _used(given, after)
    results = {f"{buffer}_next" if buffer in used else buffer: value for buffer, value in after.items()}
    return Call(traced(name, used, results), tuple(used), tuple(after))


def _used(given: Mapping[str, SX], after: Mapping[str, SX]) -> dict[str, SX]:
    everything = ca.vertcat(*[ca.vec(value) for value in after.values()])
    return {name: x for name, x in given.items() if x.numel() and ca.depends_on(everything, x)}


def _clipped(observation: SX) -> SX:
    return ca.fmax(-OBSERVATION_BOUND, ca.fmin(OBSERVATION_BOUND, observation))
