"""A task on a robot as traced functions, and those as the two programs of an environment.

    step:   act -> physics sub-steps -> assess      all robots, every control step
    reset:  begin                                   only tiles with a robot to reset

`assess` is where the task looks at the robot: reward terms, terminations, metrics, the next command, the observation.
May know dynamics, sim, compile and the term files; no Gymnasium.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np

from ce_gym.compile import Buffer, Call, Program, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions, state_sizes
from ce_gym.dynamics.functions import traced
from ce_gym.dynamics.model import Model
from ce_gym.envs.task.actions import ActionMap
from ce_gym.envs.task.commands import Commands
from ce_gym.envs.task.curriculum import Progress
from ce_gym.envs.task.ground import SEEN, Ground, starting_place
from ce_gym.envs.task.randomisation import Randomised
from ce_gym.envs.task.sampling import Draws
from ce_gym.envs.task.tasks import Task
from ce_gym.envs.terms.context import Snapshot
from ce_gym.envs.terms.registry import Term, find_term, is_added
from ce_gym.sim.simulator import select_contacts
from ce_gym.sim.substeps import FRAME, HEIGHTS, substeps

OBSERVATION_BOUND = 100.0
"""Observations are clipped here; blocks are of order one, so only a robot about to fail comes near it."""


@dataclass
class TaskProgram:
    """Traces one task on one robot.

    Args:
        model: The robot at a transmission level.
        task: The task.
        contact_forces: Whether to compute contact forces for recording.

    Raises:
        ValueError: If the robot lacks what the task needs, or the task names something that does not exist.
    """

    model: Model
    task: Task
    contact_forces: bool = False

    def __post_init__(self) -> None:
        robot, task = self.model.robot, self.task
        if not robot.floating:
            raise ValueError(f"{robot.name} has a fixed base; a task needs a robot with a floating base")
        self.progress = Progress(task)
        self.commands = Commands(task, self.progress)
        self.reward_terms = {name: find_term("reward", name) for name in task.rewards}
        self.termination_terms = [find_term("termination", name) for name in task.terminations]
        self.metric_terms = {name: find_term("metric", name) for name in (*task.metrics, *self.progress.metrics)}
        self.observation_terms = {name: find_term("observation", name) for name in task.observations}
        self.critic_terms = {name: find_term("observation", name) for name in task.critic}
        for name in task.noise:
            if name not in self.observation_terms:
                raise ValueError(f"noise={name!r}; expected an observation among {', '.join(self.observation_terms)}")
        self.contacts = select_contacts(robot, task.contacts)
        if task.latency[1] > task.n_substeps:
            raise ValueError(
                f"latency={task.latency}; expected at most the {task.n_substeps} sub-steps of a control step"
            )
        self.ground = Ground(self.model.mechanism, self.contacts) if self.progress.on_field else None
        self.randomised = Randomised(robot, task.randomise)
        self.actions = ActionMap(self.model.mechanism, task)
        self.options = StepOptions(
            dt=task.dt,
            control=self.actions.control,
            contacts=self.contacts,
            material=robot.material,
            friction=task.friction,
            motors=task.motors,
            ground="field" if self.ground and self.contacts else "flat",
            parameters=self.randomised.parameters,
        )
        self.n_joints, self.n_actions = len(robot.independent), len(self.actions.moved)
        feet = {contact.body for contact in robot.contacts if contact.group == "foot"}
        self.n_feet = len(feet)

    @property
    def control_dt(self) -> float:
        """Length of a control step [s]."""
        return self.task.dt * self.task.n_substeps

    @cached_property
    def state_sizes(self) -> dict[str, int]:
        """State buffers of one robot, by name."""
        late = self.task.latency[1] > 0
        sizes = {
            **state_sizes(self.model.mechanism, self.options),
            "diverged": 1,
            "torque": self.n_joints,
            "action": self.n_actions,
            "command": 3,
            "heading": 1 if self.task.heading else 0,
            "clock": 1,
            "air_time": self.n_feet,
            "sums": 1 + len(self.reward_terms) + len(self.metric_terms),
            "parameters": self.randomised.size,
            "draw": self.randomised.n_draws,
            "delay": 1 if late else 0,
            "target": len(self.actions.targets) if late else 0,
            "contact_forces": 3 * len(self.contacts) if self.contact_forces else 0,
            **self.progress.sizes,
        }
        sizes = {name: size for name, size in sizes.items() if size}
        if self.task.history > 1:
            sizes["history"] = (self.task.history - 1) * sum(self._block_sizes(self.observation_terms, sizes).values())
        return sizes

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
        """Length of each block of one observation of the policy, by name, in order."""
        return self._block_sizes(self.observation_terms, self.state_sizes)

    @cached_property
    def critic_sizes(self) -> dict[str, int]:
        """Length of each block of an observation of the critic: the policy's blocks and the privileged ones."""
        return self._block_sizes(self.observation_terms | self.critic_terms, self.state_sizes)

    @property
    def observation_size(self) -> int:
        """Length of the policy's observation, history included."""
        return self.task.history * sum(self.observation_sizes.values())

    @property
    def critic_size(self) -> int:
        """Length of the critic's observation; 0 if the task gives it none of its own."""
        return sum(self.critic_sizes.values()) if self.task.critic else 0

    def look(self) -> ca.Function:
        """Return the state buffers that are looked at -> each block of an observation, `failed`.

        One observation of the policy, neither noisy nor clipped, and whether the episode ends: for robots that
        something else simulates.
        """
        state = {name: SX.sym(name, size) for name, size in self.state_sizes.items()}
        s = self._snapshot(self._seen(state | {"previous_action": state["action"]}))
        seen = {name: SX(term(s)) for name, term in self.observation_terms.items()}
        seen["failed"] = sum([term(s) for term in self.termination_terms], SX(0)) > 0
        everything = ca.vertcat(*seen.values())
        return traced("look", {n: x for n, x in state.items() if ca.depends_on(everything, x)}, seen)

    def terms_function(self, terms: Mapping[str, Term]) -> ca.Function:
        """Return the state buffers that terms look at, and the action before -> their values, one after the other."""
        state = {name: SX.sym(name, size) for name, size in self.state_sizes.items()}
        state["previous_action"] = SX.sym("previous_action", self.n_actions)
        s = self._snapshot(self._seen(state))
        values = ca.vertcat(SX(0, 1), *[SX(term(s)) for term in terms.values()])
        return traced("terms", {n: x for n, x in state.items() if ca.depends_on(values, x)}, {"values": values})

    def added_terms(self) -> str:
        """Return a text that changes with the terms that users have added, for cache keys."""
        state = {name: SX.sym(name, size) for name, size in self.state_sizes.items()}
        s = self._snapshot(self._seen(state | {"previous_action": state["action"]}))
        kinds = {"reward": self.task.rewards, "observation": (*self.task.observations, *self.task.critic)}
        kinds |= {"termination": self.task.terminations, "metric": self.task.metrics}
        added = {name: SX(find_term(k, name)(s)) for k, names in kinds.items() for name in names if is_added(k, name)}
        return traced("added", state, added).serialize() if added else ""

    def step_program(self) -> Program:
        """Return act, physics and assess as one program."""
        act, (assess, n_draws) = self.actions.act("delay" in self.state_sizes), self._assess()
        look, seeing = self._look_at_ground()
        _, scratch, physics = substeps(self.model.mechanism, self.options, self._physics_outputs)
        buffers = [Buffer(name, size, "tiles") for name, size in self.state_sizes.items()]
        buffers += [
            Buffer("action_in", self.n_actions, "rows_in", "float32"),
            Buffer("clipped", self.n_actions, "scratch"),
            *([Buffer("draws", n_draws, "random")] if n_draws else []),
            Buffer("observation", self.observation_size + self.critic_size, "rows_out", "float32"),
            Buffer("outcome", 3 + len(self.reward_terms), "rows_out", "float64"),
            *[buffer for buffer in scratch if buffer.kind != "table"],
            *seeing,
        ]
        if "delay" in self.state_sizes:
            buffers += [Buffer("new_target", len(self.actions.targets), "scratch"), Buffer("waited", 1, "scratch")]
            calls = (Call(act, ("action_in",), ("clipped", "new_target", "waited")), *self.actions.delayed(physics))
        else:
            buffers += [Buffer("target", len(self.actions.targets), "scratch")]
            calls = (Call(act, ("action_in",), ("clipped", "target")), *physics)
        steps = (*calls, *look, Call(assess, tuple(assess.name_in()), self._assess_outputs))
        return Program(f"{self.model.robot.name} {self.model.transmission} environment", tuple(buffers), steps)

    def reset_program(self) -> Program:
        """Return the program that starts new episodes where `chosen` is 1."""
        begin, n_draws = self._begin()
        buffers = [Buffer(name, size, "tiles") for name, size in self.state_sizes.items()]
        buffers += [
            Buffer("chosen", 1, "tiles"),
            Buffer("draws", n_draws, "random"),
            Buffer("observation", self.observation_size + self.critic_size, "rows_out", "float32"),
        ]
        calls: tuple[Step, ...] = (Call(begin, tuple(begin.name_in()), (*self.state_sizes, "observation")),)
        if self.ground:
            place, n_draws = self._place()
            look, seeing = self._look_at_ground()
            buffers += [Buffer("place_draws", n_draws, "random"), *seeing]
            placed = tuple(name.removesuffix("_next") for name in place.name_out())
            calls = (Call(place, tuple(place.name_in()), placed), *look, *calls)
        name = f"{self.model.robot.name} {self.model.transmission} reset"
        return Program(name, tuple(buffers), calls, skip_unless="chosen")

    def _look_at_ground(self) -> tuple[tuple[Step, ...], list[Buffer]]:
        """What a program has to do, and the buffers that takes, for the task to see the ground; nothing if flat."""
        if not self.ground:
            return (), []
        buffers, look = self.ground.look(self.state_sizes.get("dependent", 0))
        return look, [Buffer(FRAME, 3, "tiles"), Buffer(HEIGHTS, 0, "table"), *buffers]

    def function(self, name: Literal["act", "assess", "begin"]) -> ca.Function:
        """Trace what is done once in an environment step, before and after its sub-steps, or in a reset."""
        late = "delay" in self.state_sizes
        return {
            "act": lambda: self.actions.act(late),
            "assess": lambda: self._assess()[0],
            "begin": lambda: self._begin()[0],
        }[name]()

    @property
    def _physics_outputs(self) -> tuple[str, ...]:
        return ("torque", "contact_forces") if self.contact_forces else ("torque",)

    @property
    def _assess_outputs(self) -> tuple[str, ...]:
        optional = [name for name in ("heading", "history", "walked", "tracked") if name in self.state_sizes]
        pushed = ["v"] if self.task.push_period else []
        return ("action", "command", "clock", "air_time", "sums", *optional, *pushed, "observation", "outcome")

    def _snapshot(self, values: dict[str, SX]) -> Snapshot:
        return Snapshot(self.model.mechanism, values, self.control_dt, self.task.gait_period)

    def _block_sizes(self, terms: dict, sizes: dict[str, int]) -> dict[str, int]:
        s = self._snapshot(self._seen({name: SX.sym(name, n) for name, n in sizes.items()}))
        return {name: SX(term(s)).numel() for name, term in terms.items()}

    def _seen(self, state: dict[str, SX]) -> dict[str, SX]:
        return state | ({"scaled_parameters": 2 * state["draw"] - 1} if "draw" in state else {})

    def _assess(self) -> tuple[ca.Function, int]:
        """State after the sub-steps -> bookkeeping, observation, outcome [reward, terminated, diverged, terms]."""
        unused = ("anchor", "parameters", "delay", "target", "contact_forces")
        state = {name: SX.sym(name, size) for name, size in self.state_sizes.items() if name not in unused}
        seen_ground = {SEEN: SX.sym(SEEN, self.ground.size)} if self.ground else {}
        clipped, draws = SX.sym("clipped", self.n_actions), Draws()
        values = self._seen(state | seen_ground | {"action": clipped, "previous_action": state["action"]})
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
        fresh = self.commands.new(draws, state.get("grown"))
        due = self._every(self.task.command_period, clock)
        after = {name: ca.if_else(due, fresh[name], state[name]) for name in fresh}
        v = self._pushed(state["v"], clock, draws) if self.task.push_period else state["v"]
        after = self.commands.steered(values | {"v": v}, after)
        seen = values | after | {"air_time": air_time, "clock": clock, "v": v}
        observation, history = self._observation(seen, state.get("history"), draws)
        outputs = {"action_next": clipped, "command_next": after["command"], "clock_next": clock}
        outputs |= {"air_time_next": air_time, "sums_next": sums}
        outputs |= {"heading_next": after["heading"]} if "heading" in after else {}
        outputs |= {"history_next": history} if "history" in state else {}
        outputs |= {f"{name}_next": value for name, value in self.progress.followed(s, state).items()}
        outputs |= {"v_next": v} if self.task.push_period else {}
        outputs |= {"observation": observation, "outcome": ca.vertcat(reward, terminated, state["diverged"], *terms)}
        inputs = {**state, **seen_ground, "clipped": clipped}
        count = draws.symbols.numel()
        return traced("assess", inputs | ({"draws": draws.symbols} if count else {}), outputs), count

    def _begin(self) -> tuple[ca.Function, int]:
        """State, chosen, draws -> state of a new episode where chosen, observation.

        On a field the robots have been placed: their state has where they stand, all but the height of the ground.
        """
        state = {name: SX.sym(name, size) for name, size in self.state_sizes.items()}
        chosen, draws = SX.sym("chosen"), Draws()
        fresh = {name: SX(size, 1) for name, size in self.state_sizes.items()}
        seen_ground = {SEEN: SX.sym(SEEN, self.ground.size)} if self.ground else {}
        if self.ground:
            lift = self.ground.lift(state["q"], state.get("dependent"), seen_ground[SEEN])
            fresh["q"], fresh["level"] = SX(state["q"]), state["level"]
            fresh["q"][2] += lift
        else:
            fresh["q"] = self._starting_pose(draws)
        fresh["v"] = self._starting_velocity(draws)
        if "dependent" in fresh:
            fresh["dependent"] = SX(self.model.guess)
        if "grown" in fresh:
            fresh["grown"] = self.progress.grown(state)
        if "draw" in fresh:
            fresh["draw"] = ca.vertcat(*[draws.unit() for _ in range(self.randomised.n_draws)])
            fresh["parameters"] = self.randomised.values(fresh["draw"])
        if "delay" in fresh:
            low, high = self.task.latency
            fresh["delay"] = ca.floor(draws.uniform(low, high + 1))
            fresh["target"] = SX(self.actions.rest)
        fresh |= self.commands.new(draws, fresh.get("grown"))
        fresh |= self.commands.steered(fresh, {name: fresh[name] for name in ("command", "heading") if name in fresh})
        after = {name: ca.if_else(chosen > 0.5, ca.densify(fresh[name]), state[name]) for name in state}
        seen = self._seen(after | seen_ground | {"previous_action": after["action"]})
        observation, history = self._observation(seen, None, draws)
        if "history" in state:
            after["history"] = ca.if_else(chosen > 0.5, history, state["history"])
        outputs = {f"{name}_next": value for name, value in after.items()} | {"observation": observation}
        inputs = {**state, **seen_ground, "chosen": chosen, "draws": draws.symbols}
        return traced("begin", inputs, outputs), draws.symbols.numel()

    def _place(self) -> tuple[ca.Function, int]:
        """State, chosen, place_draws -> where chosen, a pose on a tile of the field as if the ground were at 0."""
        names = [n for n in ("q", "dependent", "level", "walked", "command", "clock") if n in self.state_sizes]
        state = {name: SX.sym(name, self.state_sizes[name]) for name in names}
        chosen, draws = SX.sym("chosen"), Draws()
        level = self.progress.level(state, draws, self.control_dt)
        place = starting_place(self.progress, level, draws)
        fresh = {"q": self._starting_pose(draws), "level": level}
        fresh["q"][:2] = place
        fresh |= {"dependent": SX(self.model.guess)} if "dependent" in state else {}
        outputs = {f"{name}_next": ca.if_else(chosen > 0.5, value, state[name]) for name, value in fresh.items()}
        inputs = {**state, "chosen": chosen, "place_draws": draws.symbols}
        return traced("place", inputs, outputs), draws.symbols.numel()

    def _starting_pose(self, draws: Draws) -> SX:
        """Positions near the standing pose, heading anywhere."""
        standing = self.model.standing_q
        half_yaw = draws.uniform(-np.pi / 2, np.pi / 2)
        joints = standing[7:] + draws.symmetric(self.n_joints, self.task.reset_noise["joint_position"])
        return ca.densify(ca.vertcat(standing[:3], ca.cos(half_yaw), 0, 0, ca.sin(half_yaw), joints))

    def _starting_velocity(self, draws: Draws) -> SX:
        """Velocities near rest."""
        noise = self.task.reset_noise
        base = draws.symmetric(6, noise["base_velocity"])
        return ca.vertcat(base, draws.symmetric(self.n_joints, noise["joint_velocity"]))

    def _every(self, period: float, clock: SX) -> SX:
        """1 once in a period [s], else 0."""
        return ca.fmod(clock, max(round(period / self.control_dt), 1)) < 0.5

    def _pushed(self, v: SX, clock: SX, draws: Draws) -> SX:
        """Now and then change the horizontal velocity of the base, as seen from it, at a stroke."""
        push = ca.vertcat(SX(3, 1), draws.symmetric(2, self.task.push_speed), SX(v.numel() - 5, 1))
        return v + ca.if_else(self._every(self.task.push_period, clock), ca.densify(push), 0)

    def _observation(self, values: dict[str, SX], before: SX | None, draws: Draws) -> tuple[SX, SX]:
        """The policy's observation, noisy and with its history, then the critic's; and the history to keep."""
        s = self._snapshot(values)
        blocks = {name: SX(term(s)) for name, term in self.observation_terms.items()}
        noisy = [b + draws.symmetric(b.numel(), self.task.noise.get(n, 0.0)) if self.task.noise.get(n) else b
                 for n, b in blocks.items()]  # fmt: skip
        now = _clipped(ca.vertcat(*noisy))
        kept = SX(0, 1)
        if self.task.history > 1:
            kept = ca.repmat(now, self.task.history - 1, 1) if before is None else before
        policy = ca.vertcat(now, kept)
        critic = SX(0, 1)
        if self.task.critic:
            critic = _clipped(ca.vertcat(*blocks.values(), *[SX(term(s)) for term in self.critic_terms.values()]))
        return ca.vertcat(policy, critic), policy[: kept.numel()]


def _clipped(observation: SX) -> SX:
    return ca.fmax(-OBSERVATION_BOUND, ca.fmin(OBSERVATION_BOUND, observation))
