"""The stages of a control step and of a reset around the sub-steps, traced as functions of the robot's state.

evaluate   after the sub-steps: rewards, terminations, metrics, curriculum, next command, observation
spawn      before a reset on a field: level, place and pose of the robot
reset      the state of a new episode and its first observation
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import casadi as ca
import numpy as np

from ce_gym.compile import Call, Grid
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.hulls import with_hulls
from ce_gym.envs.runtime.spec import TaskSpec
from ce_gym.envs.task.commands import Commands
from ce_gym.envs.task.ground import SEEN, resting_load
from ce_gym.envs.task.sampling import Sampler
from ce_gym.envs.task.start import starting_place, starting_pose, starting_velocity
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.registry import Term
from ce_gym.sim.schema import Row
from ce_gym.sim.substeps import FRAME

OBSERVATION_BOUND = 100.0
"""Observations are clipped to this bound. Blocks are of order one, so only a robot about to fail comes near it."""
OUTCOME = ("reward", "terminated", "truncated", "diverged", "done")
"""Columns of the rows `outcome`; the weighted reward terms follow."""


class Stages:
    """Traces the stages of a task on a robot.

    The constructor traces every term once, in `evaluate`. This trace also yields the state that terms need.
    `evaluate`, `spawn` and `reset` return a call and the number of random numbers that it reads.

    Args:
        spec: The task on the robot.
        rows: The state without the memory of terms.

    Attributes:
        rows: State in the lanes of the kernels by name, with memory and biases of terms and the observation history.
        state: A symbol for each of these rows.
        block_sizes: Length of each observation block by name; the critic's own blocks are last.
        ground_values: Symbols of the ground heights and slopes that the task and its terms look up, by name.
        grids: Grid of each look-up of terms, by name.
        njit_values: Symbols of the values of terms that are `@njit` functions, by key of the term.
        njit_shapes: Shapes of the inputs of each of these terms, by key.
    """

    def __init__(self, spec: TaskSpec, rows: Mapping[str, Row]) -> None:
        self.spec, self.task, self.model = spec, spec.task, spec.model
        self.rows = {name: row for name, row in rows.items() if not row.dtype and name != FRAME}
        self.state = {name: SX.sym(name, row.size) for name, row in self.rows.items()}
        self.ground_values = {SEEN: SX.sym(SEEN, spec.ground.size)} if spec.ground else {}
        self.commands = Commands(self.task, spec.curriculum)
        self.block_sizes: dict[str, int] = {}
        self.grids: dict[str, Grid] = {}
        self.njit_values = {term.key: SX.sym(term.key) for term in spec.njit_terms}
        self.njit_shapes: dict[str, tuple[tuple[int, ...], ...]] = {}
        self._places: dict[str, SX] = {}
        sampler, action = Sampler(), SX.sym("clipped", spec.n_actions)
        self._evaluation = self._evaluate(action, sampler)
        inputs = {"clipped": action, "draws": sampler.symbols}
        self._inputs = self.state | self.ground_values | self.njit_values | inputs
        self._njit_inputs = self._trace_njit_inputs(action)

    def evaluate(self) -> tuple[Call, int]:
        """Return the stage that follows the sub-steps."""
        return _call("evaluate", self._inputs, self._evaluation), self._inputs["draws"].numel()

    def njit_inputs(self) -> Call:
        """Return the call that writes the inputs of `@njit` functions as `<key>_inputs`, and nan as their values."""
        return _call("njit_inputs", self._inputs, self._njit_inputs)

    def _trace_njit_inputs(self, action: SX) -> dict[str, SX]:
        results = {}
        s = self.context(self._before_evaluation(action))
        for term in self.spec.njit_terms:
            values = term.trace_inputs(s)
            self.njit_shapes[term.key] = tuple(x.shape if x.shape[1] != 1 else (x.shape[0],) for x in values)
            results[f"{term.key}_inputs"] = ca.vertcat(*[ca.vec(x.T) for x in values])  # in the order of numpy
            results[term.key] = SX(np.nan)
        return results

    def _before_evaluation(self, action: SX) -> dict[str, SX]:
        """Return the values that terms read after the sub-steps, by name."""
        return self.state | self.ground_values | {"action": action, "previous_action": self.state["action"]}

    def _evaluate(self, action: SX, sampler: Sampler) -> dict[str, SX]:
        """Trace the buffers that a control step writes after its sub-steps, by name, in the order of the stages."""
        spec, state = self.spec, self.state
        values = self._before_evaluation(action)
        s = self.context(values)
        after = {"action": action, "elapsed": state["elapsed"] + 1, "clock": state["clock"] + 1}

        # rewards, terminations, metrics
        rewards = [term.weight * term.number(s) * spec.control_dt for term in spec.reward_terms.values()]
        reward = ca.fmax(0, sum(rewards, SX(0))) if self.task.only_positive else sum(rewards, SX(0))
        diverged = state["diverged"] > 0.5
        terminated = ca.logic_and(self._failed(s), ca.logic_not(diverged))
        truncated = ca.logic_or(after["elapsed"] >= state["limit"], diverged)
        done = ca.logic_or(terminated, truncated)
        after["sums"] = self._sums(s, reward, rewards)
        after["failures"] = state["failures"] + diverged
        if "air_time" in state:
            after["air_time"] = ca.if_else(s.foot_contact, 0, state["air_time"] + spec.control_dt)

        # curriculum, memory of terms
        after |= spec.curriculum.progress(s, state)
        after |= self._learn(s)

        # commands, pushes
        command = self._next_command(after["clock"], sampler)
        after |= self._push(after["clock"], sampler)
        after |= self.commands.steer(state["q"], command)

        # observations
        s = self.context(values | after)
        policy, critic = self._blocks(s, sampler)
        self.block_sizes = {name: block.numel() for name, block in (policy | critic).items()}
        after |= self._learn(s)
        newest = self._noisy(policy, sampler)
        observation, history = _stack(newest, self._add_history(newest), critic)
        after |= history | {"chosen": done, "observation": observation}

        # results; rewards of diverged robots may be NaN or infinite
        outcome = ca.vertcat(reward, terminated, truncated, diverged, done, *rewards)
        outcome = ca.if_else(ca.logic_or(ca.logic_not(diverged), ca.fabs(outcome) < ca.inf), outcome, 0)
        sums = ca.if_else(ca.logic_and(done, ca.fabs(after["sums"]) < ca.inf), after["sums"], 0)
        return after | {"outcome": outcome, "ended": ca.vertcat(ca.if_else(done, after["elapsed"], 0), sums)}

    def spawn(self) -> tuple[Call, int]:
        """Trace the pose of `chosen` robots on a tile of the field, for ground at height 0."""
        state, sampler = self.state, Sampler()
        level = self.spec.curriculum.next_level(state, sampler, self.spec.control_dt)
        place = starting_place(self.task, level, sampler)
        fresh = {"q": starting_pose(self.model, self.task, sampler), "level": level, **self._draw_biases(sampler)}
        fresh["q"][:2] = place
        fresh |= {"dependent": SX(self.model.guess)} if "dependent" in state else {}
        after = {name: ca.if_else(state["chosen"] > 0.5, value, state[name]) for name, value in fresh.items()}
        return _call("spawn", state | {"spawn_draws": sampler.symbols}, after), sampler.symbols.numel()

    def reset(self) -> tuple[Call, int]:
        """Trace the start of an episode of `chosen` robots, which `spawn` has placed if the ground is a field."""
        sampler, chosen = Sampler(), self.state["chosen"] > 0.5
        written = {name for name, row in self.rows.items() if row.writer in ("physics", "task", "term", "drift")}
        written -= {"chosen", "retries"}  # `retries` goes on counting, so that a reader after a reset sees all
        state = {name: x for name, x in self.state.items() if name in written}

        fresh = {name: SX(np.broadcast_to(self.rows[name].reset, x.shape[0])) for name, x in state.items()}
        fresh |= self._start(sampler)
        fresh |= self._progress()
        fresh |= self._draw_parameters(sampler)
        fresh |= self._draw_latency(sampler)
        fresh |= self._resting_loads(fresh)
        fresh |= self.commands.steer(fresh["q"], self.commands.draw(sampler, fresh.get("grown")))
        after = {name: ca.if_else(chosen, ca.densify(fresh[name]), x) for name, x in state.items()}

        s = self.context(self.state | after | self.ground_values | {"previous_action": after["action"]})
        policy, critic = self._blocks(s, sampler)
        newest = self._noisy(policy, sampler)
        observation, history = _stack(newest, ca.repmat(newest, self.task.history - 1, 1), critic)
        after |= {name: ca.if_else(chosen, x, state[name]) for name, x in (s.next_memory | history).items()}
        inputs = self.state | self.ground_values | {"first_draws": sampler.symbols}
        return _call("reset", inputs, after | {"observation": observation}), sampler.symbols.numel()

    def places(self, begins: bool) -> list[Call]:
        """Trace where terms look up the ground, after the sub-steps or at the start of an episode.

        Returns:
            Calls in order. The places of a call may depend on the heights at the places of earlier calls.

        Raises:
            ValueError: A place depends on a value that is not known before observations are made.
        """
        state = self.state | {"clock": SX(0) if begins else self.state["clock"] + 1}
        s = self.context(state | self.ground_values | {"previous_action": state["action"]})
        self._blocks(s, Sampler())
        places = {f"{name}_places": place for name, place in s.places.items()}
        inputs, calls = dict(self.state), []
        while places:
            known = {x.name() for x in ca.symvar(ca.vertcat(*[ca.vec(x) for x in inputs.values()]))}
            unknown = {name: {x.name() for x in ca.symvar(place)} - known for name, place in places.items()}
            ready = [name for name in places if not unknown[name]]
            if not ready:
                name, symbols = next(iter(unknown.items()))
                expected = "expected positions and memory alone"
                raise ValueError(f"{name}: depends on {', '.join(sorted(symbols))}; {expected}")
            calls.append(_call("places", inputs, {name: places.pop(name) for name in ready}))
            inputs |= {name: self.ground_values[name] for name in (key.removesuffix("_places") for key in ready)}
        return calls

    def observation_function(self) -> ca.Function:
        """Trace state buffers -> each block of the policy's observation, without noise or clipping, and `failed`."""
        s = self.context(self.state | {"previous_action": self.state["action"]})
        blocks = {name: term(s) for name, term in self.spec.observation_terms.items()} | {"failed": self._failed(s)}
        return traced("observe", _used(self.state | self.njit_values, blocks), blocks)

    def terms_function(self, terms: Mapping[str, Term]) -> ca.Function:
        """Trace state buffers and `previous_action` -> the values of terms, stacked."""
        inputs = self.state | {"previous_action": SX.sym("previous_action", self.spec.n_actions)} | self.njit_values
        s = self.context(inputs)
        values = {"values": ca.vertcat(SX(0, 1), *[term(s) for term in terms.values()])}
        return traced("terms", _used(inputs, values), values)

    def context(self, values: Mapping[str, SX]) -> TermContext:
        """Return the context in which terms read the values of state buffers, by name."""
        spec, values = self.spec, self.njit_values | dict(values)
        if "draw" in values:
            values["scaled_parameters"] = 2 * values["draw"] - 1
        if "load" in values:
            values["load"] = with_hulls(values["load"], spec.options.hulls)
        return TermContext(self.model.mechanism, values, spec.control_dt, self.task.gait_period, spec.contacts)

    @cached_property
    def user_terms(self) -> str:
        """A text that identifies the terms that users have added, for cache keys; empty without such terms."""
        if not any(term.added for term in self.spec.terms):
            return ""
        everything = self._evaluation | self._places | self._njit_inputs
        results = {f"{name}_result": x for name, x in everything.items()}
        function = traced("user_terms", self._inputs, results)
        return f"{function.serialize()} {list(self.rows.values())!r} {self.grids!r}"

    def _learn(self, s: TermContext) -> dict[str, SX]:
        """Add the state and the ground heights that terms have used; return the next values of their memory."""
        for name, x in s.memory.items():
            self._add_row(Row(name, x.numel(), "term", s.resets[name]), x)
        for name, x in s.biases.items():
            self._add_row(Row(name, x.numel(), "drift"), x)
        self.ground_values |= s.heights
        self.grids |= s.grids
        self._places |= s.places
        return s.next_memory

    def _add_row(self, row: Row, symbol: SX) -> None:
        self.rows[row.name], self.state[row.name] = row, symbol

    def _failed(self, s: TermContext) -> SX:
        return sum([term.number(s) for term in self.spec.termination_terms.values()], SX(0)) > 0

    def _sums(self, s: TermContext, reward: SX, rewards: list[SX]) -> SX:
        """Return the sums over the episode of the reward, of each reward term and of each metric."""
        old, n = self.state["sums"], 1 + len(rewards)
        metrics = []
        for i, term in enumerate(self.spec.metric_terms.values(), n):
            value = term.number(s)
            # the mean over the episode of a final metric is its last value
            metrics.append(value * (self.state["elapsed"] + 1) if term.at_the_end else old[i] + value)
        return ca.vertcat(old[:n] + ca.vertcat(reward, *rewards), *metrics)

    def _next_command(self, clock: SX, sampler: Sampler) -> dict[str, SX]:
        fresh = self.commands.draw(sampler, self.state.get("grown"))
        due = self._is_due(self.task.command_period, clock)
        return {name: ca.if_else(due, value, self.state[name]) for name, value in fresh.items()}

    def _push(self, clock: SX, sampler: Sampler) -> dict[str, SX]:
        """Change the horizontal velocity of the base, in its frame, once in a push period."""
        if not self.task.push_period:
            return {}
        v = self.state["v"]
        push = ca.vertcat(SX(3, 1), sampler.symmetric(2, self.task.push_speed), SX(v.numel() - 5, 1))
        return {"v": v + ca.if_else(self._is_due(self.task.push_period, clock), ca.densify(push), 0)}

    def _is_due(self, period: float, clock: SX) -> SX:
        """Return 1 once in a period [s], else 0."""
        return ca.fmod(clock, max(round(period / self.spec.control_dt), 1)) < 0.5

    def _blocks(self, s: TermContext, sampler: Sampler) -> tuple[dict[str, SX], dict[str, SX]]:
        """Return the blocks of the policy, with errors of sensors, and of the critic, without them; neither noisy."""
        spec = self.spec
        s.unit = sampler.unit
        policy = {name: term(s) for name, term in spec.observation_terms.items()}
        s.unit = None
        if not spec.critic_terms:
            return policy, {}
        s.exact_pass = True
        terms = spec.observation_terms
        exact = {n: terms[n](s) if f"observation_{n}" in s.noisy_terms else block for n, block in policy.items()}
        s.exact_pass = False
        return policy, exact | {name: term(s) for name, term in spec.critic_terms.items()}

    def _noisy(self, policy: Mapping[str, SX], sampler: Sampler) -> SX:
        """Return one observation of the policy with the noise of the task, clipped."""
        blocks = []
        for name, block in policy.items():
            bound = self.task.noise.get(name)
            blocks.append(block + sampler.symmetric(block.numel(), bound) if bound else block)
        return _clip(ca.vertcat(*blocks))

    def _add_history(self, newest: SX) -> SX:
        """Add the older observations to the state if the policy sees any, and return them."""
        older = SX.sym("history", (self.task.history - 1) * newest.numel())
        if older.numel():
            self._add_row(Row("history", older.numel(), "task"), older)
        return older

    def _start(self, sampler: Sampler) -> dict[str, SX]:
        """Return pose, velocity and biases of sensors; on a field `spawn` has drawn the pose and the biases."""
        if not self.spec.ground:
            q, v = starting_pose(self.model, self.task, sampler), starting_velocity(self.model, self.task, sampler)
            return {"q": q, "v": v, **self._draw_biases(sampler)}
        q = SX(self.state["q"])
        q[2] += self.spec.ground.lift(self.state["q"], self.state.get("dependent"), self.ground_values[SEEN])
        biases = {name: self.state[name] for name in self._biases}
        return {"q": q, "v": starting_velocity(self.model, self.task, sampler), **biases}

    def _progress(self) -> dict[str, SX]:
        """Return the state that goes on from episode to episode."""
        kept = {name: self.state[name] for name in ("failures", "level") if name in self.state}
        if "grown" in self.state:
            kept["grown"] = self.spec.curriculum.next_times_grown(self.state)
        return kept

    @property
    def _biases(self) -> list[str]:
        return [name for name, row in self.rows.items() if row.writer == "drift"]

    def _draw_biases(self, sampler: Sampler) -> dict[str, SX]:
        return {name: sampler.symmetric(self.rows[name].size, 1.0) for name in self._biases}

    def _draw_parameters(self, sampler: Sampler) -> dict[str, SX]:
        if "draw" not in self.state:
            return {}
        draw = ca.vertcat(*[sampler.unit() for _ in range(self.spec.randomised.n_draws)])
        return {"draw": draw, "parameters": self.spec.randomised.values(draw)}

    def _draw_latency(self, sampler: Sampler) -> dict[str, SX]:
        if "delay" not in self.state:
            return {}
        low, high = self.task.latency
        return {"delay": ca.floor(sampler.uniform(low, high + 1)), "target": SX(self.spec.actions.rest)}

    def _resting_loads(self, state: Mapping[str, SX]) -> dict[str, SX]:
        if "load" not in state:
            return {}
        load = resting_load(self.model.mechanism, self.spec.options, state, self.ground_values.get(SEEN))
        return {name: load for name in ("load", "whole_load") if name in state}


def _call(name: str, inputs: Mapping[str, SX], outputs: Mapping[str, SX]) -> Call:
    """Trace a function that writes buffers and reads those inputs on which they depend."""
    used = _used(inputs, outputs)
    results = {f"{buffer}_next" if buffer in used else buffer: value for buffer, value in outputs.items()}
    return Call(traced(name, used, results), tuple(used), tuple(outputs))


def _used(inputs: Mapping[str, SX], outputs: Mapping[str, SX]) -> dict[str, SX]:
    everything = ca.vertcat(*[ca.vec(value) for value in outputs.values()])
    return {name: x for name, x in inputs.items() if x.numel() and ca.depends_on(everything, x)}


def _stack(newest: SX, older: SX, critic: Mapping[str, SX]) -> tuple[SX, dict[str, SX]]:
    """Return the observation of policy and critic as one vector, and the next observation history if there is one."""
    policy = ca.vertcat(newest, older)
    history = {"history": policy[: older.numel()]} if older.numel() else {}
    return ca.vertcat(policy, _clip(ca.vertcat(SX(0, 1), *critic.values()))), history


def _clip(observation: SX) -> SX:
    return ca.fmax(-OBSERVATION_BOUND, ca.fmin(OBSERVATION_BOUND, observation))
