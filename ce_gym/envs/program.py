"""A task on a robot as traced functions, and those as the two programs of an environment.

    step:   act -> physics sub-steps -> assess      all robots, every control step
    reset:  begin                                   only tiles with a robot to reset

`assess` is where the task looks at the robot: reward terms, terminations, metrics, the next command, the observation.
May know dynamics, sim, compile and the term files; no Gymnasium.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType

import casadi as ca
import numpy as np

from ce_gym.compile import Buffer, Call, Program
from ce_gym.dynamics.functions import traced
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.scene import StepOptions, state_sizes
from ce_gym.dynamics.spatial import SX
from ce_gym.envs import metrics, observations, rewards, terminations
from ce_gym.envs.draws import Draws
from ce_gym.envs.snapshot import Snapshot
from ce_gym.envs.tasks import Task
from ce_gym.sim.simulator import select_contacts
from ce_gym.sim.substeps import substeps

Term = Callable[[Snapshot], SX]

OBSERVATION_BOUND = 100.0
"""Observations are clipped here; blocks are of order one, so only a robot about to fail comes near it."""


@dataclass
class TaskProgram:
    """Traces one task on one robot.

    Args:
        model: The robot at a transmission level.
        task: The task.
        contact_forces: Whether to compute contact forces for recording.
    """

    model: Model
    task: Task
    contact_forces: bool = False

    def __post_init__(self) -> None:
        robot = self.model.robot
        if not robot.floating:
            raise ValueError(f"{robot.name} has a fixed base; a task needs a robot with a floating base")
        self.reward_terms = {name: _term(rewards, "reward", name) for name in self.task.rewards}
        self.termination_terms = [_term(terminations, "termination", name) for name in self.task.terminations]
        self.metric_terms = {name: _term(metrics, "metric", name) for name in self.task.metrics}
        self.observation_terms = {name: _term(observations, "observation", name) for name in self.task.observations}
        self.contacts = select_contacts(robot, self.task.contacts)
        self.options = StepOptions(self.task.dt, "position", self.contacts, robot.material, self.task.friction)
        self.n_joints = len(robot.independent)
        self.n_feet = sum(contact.group == "foot" for contact in robot.contacts)

    @property
    def control_dt(self) -> float:
        """Length of a control step [s]."""
        return self.task.dt * self.task.n_substeps

    @cached_property
    def state_sizes(self) -> dict[str, int]:
        """State buffers of one robot, by name."""
        sizes = {
            **state_sizes(self.model.mechanism, self.options),
            "diverged": 1,
            "torque": self.n_joints,
            "action": self.n_joints,
            "command": 3,
            "clock": 1,
            "air_time": self.n_feet,
            "sums": 1 + len(self.reward_terms) + len(self.metric_terms),
        }
        sizes |= {"contact_forces": 3 * len(self.contacts)} if self.contact_forces else {}
        return {name: size for name, size in sizes.items() if size}

    @property
    def sum_names(self) -> list[str]:
        """What `sums` adds up over an episode, in order."""
        return [
            "return",
            *(f"reward/{name}" for name in self.reward_terms),
            *(f"metrics/{name}" for name in self.metric_terms),
        ]

    @cached_property
    def observation_sizes(self) -> dict[str, int]:
        """Length of each observation block, by name, in order."""
        s = self._snapshot({name: SX.sym(name, n) for name, n in self.state_sizes.items()})
        return {name: term(s).numel() for name, term in self.observation_terms.items()}

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return sum(self.observation_sizes.values())

    def step_program(self) -> Program:
        """Return act, physics and assess as one program."""
        act, (assess, n_draws) = self._act(), self._assess()
        _, scratch, physics = substeps(self.model.mechanism, self.options, self._physics_outputs)
        buffers = [Buffer(name, size, "tiles") for name, size in self.state_sizes.items()]
        buffers += [
            Buffer("action_in", self.n_joints, "rows_in", "float32"),
            Buffer("clipped", self.n_joints, "scratch"),
            Buffer("target", self.n_joints, "scratch"),
            Buffer("draws", n_draws, "random"),
            Buffer("observation", self.observation_size, "rows_out", "float32"),
            Buffer("outcome", 3, "rows_out", "float64"),
            *scratch,
        ]
        calls = (
            Call(act, ("action_in",), ("clipped", "target")),
            *physics,
            Call(assess, tuple(assess.name_in()), self._assess_outputs),
        )
        return Program(f"{self.model.robot.name} {self.model.transmission} environment", tuple(buffers), calls)

    def reset_program(self) -> Program:
        """Return the program that starts new episodes where `chosen` is 1."""
        begin, n_draws = self._begin()
        buffers = [Buffer(name, size, "tiles") for name, size in self.state_sizes.items()]
        buffers += [
            Buffer("chosen", 1, "tiles"),
            Buffer("draws", n_draws, "random"),
            Buffer("observation", self.observation_size, "rows_out", "float32"),
        ]
        call = Call(begin, tuple(begin.name_in()), (*self.state_sizes, "observation"))
        name = f"{self.model.robot.name} {self.model.transmission} reset"
        return Program(name, tuple(buffers), (call,), skip_unless="chosen")

    @property
    def _physics_outputs(self) -> tuple[str, ...]:
        return ("torque", "contact_forces") if self.contact_forces else ("torque",)

    _assess_outputs = ("action", "command", "clock", "air_time", "sums", "observation", "outcome")

    def _snapshot(self, values: dict[str, SX]) -> Snapshot:
        return Snapshot(self.model.mechanism, values, self.control_dt)

    def _act(self) -> ca.Function:
        """(action_in) -> clipped action, joint targets."""
        action = SX.sym("action_in", self.n_joints)
        clipped = ca.fmax(-1, ca.fmin(1, action))
        standing = self._snapshot({}).standing_joints
        target = SX(standing) + self.task.action_scale * clipped
        return traced("act", {"action_in": action}, {"clipped": clipped, "target": target})

    def _assess(self) -> tuple[ca.Function, int]:
        """State after the sub-steps -> bookkeeping, observation, outcome [reward, terminated, diverged]."""
        used = ("q", "v", "dependent", "diverged", "torque", "action", "command", "clock", "air_time", "sums")
        state = {name: SX.sym(name, self.state_sizes[name]) for name in used if name in self.state_sizes}
        clipped, draws = SX.sym("clipped", self.n_joints), Draws()
        values = state | {"action": clipped, "previous_action": state["action"]}
        s = self._snapshot(values)

        terms = [self.task.rewards[name] * term(s) * self.control_dt for name, term in self.reward_terms.items()]
        total = sum(terms, SX(0))
        reward = ca.fmax(0, total) if self.task.only_positive else total
        failed = sum([term(s) for term in self.termination_terms], SX(0)) > 0
        terminated = ca.logic_and(failed, state["diverged"] < 0.5)
        sums = state["sums"] + ca.vertcat(reward, *terms, *[term(s) for term in self.metric_terms.values()])

        air_time = (
            ca.if_else(s.foot_contact, 0, state["air_time"] + self.control_dt) if self.n_feet else state["air_time"]
        )
        clock = state["clock"] + 1
        period = max(round(self.task.command_period / self.control_dt), 1)
        due = ca.fmod(clock, period) < 0.5
        command = ca.if_else(due, self._new_command(draws), state["command"])
        seen = self._snapshot(values | {"command": command, "air_time": air_time})
        outputs = {
            "action_next": clipped,
            "command_next": command,
            "clock_next": clock,
            "air_time_next": air_time,
            "sums_next": sums,
            "observation": self._observation(seen),
            "outcome": ca.vertcat(reward, terminated, state["diverged"]),
        }
        inputs = {**state, "clipped": clipped, "draws": draws.symbols}
        return traced("assess", inputs, outputs), draws.symbols.numel()

    def _begin(self) -> tuple[ca.Function, int]:
        """State, chosen, draws -> state of a new episode where chosen, observation."""
        state = {name: SX.sym(name, size) for name, size in self.state_sizes.items()}
        chosen, draws = SX.sym("chosen"), Draws()
        fresh = {name: SX(size, 1) for name, size in self.state_sizes.items()}
        fresh["q"], fresh["v"] = self._start(draws)
        if "dependent" in fresh:
            fresh["dependent"] = SX(self.model.guess)
        fresh["command"] = self._new_command(draws)
        after = {name: ca.if_else(chosen > 0.5, ca.densify(fresh[name]), state[name]) for name in state}
        seen = self._snapshot(after | {"previous_action": after["action"]})
        outputs = {f"{name}_next": value for name, value in after.items()} | {"observation": self._observation(seen)}
        inputs = {**state, "chosen": chosen, "draws": draws.symbols}
        return traced("begin", inputs, outputs), draws.symbols.numel()

    def _start(self, draws: Draws) -> tuple[SX, SX]:
        """Positions and velocities near the standing pose, heading anywhere."""
        noise, standing = self.task.reset_noise, self.model.standing_q
        half_yaw = draws.uniform(-np.pi / 2, np.pi / 2)
        joints = standing[7:] + draws.symmetric(self.n_joints, noise["joint_position"])
        q = ca.vertcat(standing[:3], ca.cos(half_yaw), 0, 0, ca.sin(half_yaw), joints)
        base = draws.symmetric(6, noise["base_velocity"])
        return q, ca.vertcat(base, draws.symmetric(self.n_joints, noise["joint_velocity"]))

    def _new_command(self, draws: Draws) -> SX:
        """A command within the task's range, or standing still."""
        standing = draws.unit() < self.task.standing_fraction
        return ca.if_else(standing, 0, draws.within(self.task.command_range))

    def _observation(self, s: Snapshot) -> SX:
        observation = ca.vertcat(*[term(s) for term in self.observation_terms.values()])
        return ca.fmax(-OBSERVATION_BOUND, ca.fmin(OBSERVATION_BOUND, observation))


def _term(module: ModuleType, kind: str, name: str) -> Term:
    """Find a term by name.

    Raises:
        ValueError: If there is none; names those there are.
    """
    known = {
        key: function
        for key, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and not key.startswith("_")
    }
    if name not in known:
        raise ValueError(f"no {kind} term {name!r}; expected one of {', '.join(sorted(known))}")
    return known[name]
