"""A task on a robot as the two programs of an environment, and the schema of the state that they share.

step:   act -> physics sub-steps -> assess      all robots, every control step
reset:  begin                                   only tiles with a robot to reset
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np

from ce_gym.compile import Buffer, Call, Lookup, Program, Repeat, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.envs.runtime.stages import OUTCOME, Probe, Stages
from ce_gym.envs.task.actions import ActionMap
from ce_gym.envs.task.curriculum import Curriculum
from ce_gym.envs.task.ground import Ground
from ce_gym.envs.task.randomisation import Randomised
from ce_gym.envs.task.tasks import Task
from ce_gym.envs.task.terrain_tiles import field_of
from ce_gym.envs.terms.registry import Term, terms_of
from ce_gym.sim.kernels import select_contacts, select_pairs
from ce_gym.sim.schema import Row, checked_tolerance, physics_rows, state_buffers
from ce_gym.sim.substeps import FRAME, HEIGHTS, substeps
from ce_gym.sim.terrain.hulls import hulls_on

HOST_ROWS = (
    Row("limit", 1, "host", np.inf),
    Row("keys", 0, "host", dtype="int64"),
    Row("counters", 0, "host", dtype="int64"),
    Row("seeded", 0, "host", dtype="bool"),
    Row("finished", 0, "host", dtype="bool"),
)
"""Control steps until time is up; the key of the random stream, its bits, and how often the stream was used; whether it
has been seeded; whether an episode has ended and the next one has not begun."""


class TaskProgram:
    """Traces one task on one robot.

    Args:
        model: The robot at a transmission level.
        task: The task.
        contact_forces: Whether to compute contact forces for recording.

    Attributes:
        curriculum: What robots carry over from one episode to the next.
        actions: What an action asks for.
        contacts: Names of the spheres that take part in the physics.
        randomised: Figures that are drawn for each episode.
        ground: How the task sees a field; None on flat ground.
        options: The scene of the sub-steps.
        reward_terms, termination_terms, metric_terms, observation_terms, critic_terms: Terms by name.

    Raises:
        ValueError: If the robot lacks what the task needs, or the task names something that does not exist.
    """

    def __init__(self, model: Model, task: Task, contact_forces: bool = False) -> None:
        self.model, self.task, self.contact_forces = model, task, contact_forces
        robot = model.robot
        if not robot.floating:
            raise ValueError(f"{robot.name} has a fixed base; a task needs a robot with a floating base")
        self.curriculum = Curriculum(task)
        self.reward_terms = terms_of("reward", task.rewards)
        self.termination_terms = terms_of("termination", task.terminations)
        self.metric_terms = terms_of("metric", task.metrics) | terms_of("metric", self.curriculum.metrics)
        self.observation_terms = terms_of("observation", task.observations)
        self.critic_terms = terms_of("observation", task.critic)
        for name in task.noise:
            if name not in self.observation_terms:
                raise ValueError(f"noise={name!r}; expected an observation among {', '.join(self.observation_terms)}")
        self.contacts = select_contacts(robot, task.contacts)
        if task.latency[1] > task.n_substeps:
            raise ValueError(
                f"latency={task.latency}; expected at most the {task.n_substeps} sub-steps of a control step"
            )
        self.field = field_of(task.terrain)
        hulls = hulls_on(robot, self.contacts, self.field)
        self.ground = Ground(self.model.mechanism, self.contacts, hulls) if self.curriculum.on_field else None
        self.randomised = Randomised(robot, task.randomise)
        self.actions = ActionMap(self.model.mechanism, task)
        self.options = StepOptions(
            control=self.actions.control,
            contacts=self.contacts,
            material=robot.material,
            friction=task.friction,
            method=task.method,
            motors=task.motors,
            control_period=task.control_period,
            ground="field" if self.ground and self.contacts else "flat",
            parameters=self.randomised.parameters,
            self_collisions=select_pairs(self.model.mechanism, task.self_collisions),
            seldom=tuple(name for name in select_contacts(robot, task.seldom) if name in self.contacts),
            hulls=hulls,
        )

    @property
    def n_actions(self) -> int:
        """Length of an action."""
        return len(self.actions.moved)

    @property
    def control_dt(self) -> float:
        """Length of a control step [s]."""
        return self.task.dt * self.task.n_substeps

    @cached_property
    def _rows(self) -> dict[str, Row]:
        """The schema without what terms add to it."""
        seen = {term for terms in (self.observation_terms, self.critic_terms) for term in terms}
        outputs = ("torque", *(["motor_torque"] if "motor_torques" in seen else []))
        outputs += ("contact_forces",) if self.contact_forces else ()
        feet = {contact.body for contact in self.model.robot.contacts if contact.group == "foot"}
        late = self.task.latency[1] > 0
        sizes = {
            "action": self.n_actions,
            "command": 3,
            "heading": int(self.task.heading),
            "clock": 1,
            "air_time": len(feet),
            "sums": len(self.sum_names),
            "elapsed": 1,
            "failures": 1,
            "chosen": 1,
            "draw": self.randomised.n_draws,
            "delay": int(late),
            "target": len(self.actions.targets) if late else 0,
            **self.curriculum.sizes,
        }
        tolerance = checked_tolerance(self.task.method, self.task.tolerance)
        physics = physics_rows(self.model, self.options, outputs, self.task.dt, tolerance)
        rows = [replace(row, writer="task") if row.name == "parameters" else row for row in (*physics, *HOST_ROWS)]
        rows += [Row(name, size, "task") for name, size in sizes.items() if size]
        rows += [Row(FRAME, 3, "host")] if self.ground and not self.contacts else []
        return {row.name: row for row in rows}

    @cached_property
    def probe(self) -> Probe:
        """What the terms turn out to be when they are traced."""
        return Stages(self, self._rows).probe()

    @cached_property
    def schema(self) -> dict[str, Row]:
        """State of one robot, by name."""
        rows = [Row("observation", self.observation_size + self.critic_size, "host", dtype="float32")]
        if self.task.history > 1:
            rows.append(Row("history", (self.task.history - 1) * sum(self.observation_sizes.values()), "task"))
        return self._rows | {row.name: row for row in (*self.probe.memories, *rows)}

    @property
    def stages(self) -> Stages:
        """What is done around the sub-steps, to be traced."""
        return Stages(self, self.schema, self.probe.looked)

    @cached_property
    def state_sizes(self) -> dict[str, int]:
        """Sizes of the state buffers in the lanes of the kernels, by name."""
        return {row.name: row.size for row in self.schema.values() if not row.dtype}

    @cached_property
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
        return {name: self.probe.sizes[name] for name in self.observation_terms}

    @cached_property
    def observation_size(self) -> int:
        """Length of the policy's observation, history included."""
        return self.task.history * sum(self.observation_sizes.values())

    @cached_property
    def critic_size(self) -> int:
        """Length of the critic's observation, the policy's blocks included; 0 if it has none of its own."""
        return sum(self.probe.sizes.values()) if self.task.critic else 0

    def look(self) -> ca.Function:
        """Return the state buffers that are looked at -> each block of an observation, `failed`.

        One observation of the policy, neither noisy nor clipped, and whether the episode ends: for robots that
        something else simulates.
        """
        return self.stages.look()

    def terms_function(self, terms: Mapping[str, Term]) -> ca.Function:
        """Return the state buffers that terms look at, and the action before -> their values, one after the other."""
        return self.stages.values(terms)

    def step_program(self, fused: bool = False) -> Program:
        """Return act, physics and assess as one program.

        Args:
            fused: Whether a reset of those who are done follows in the same launch, so that what they leave has to be
                kept: `final_observation`.
        """
        assess, n_draws = self.stages.assess()
        act, size = self.actions.act("delay" in self.schema), self.observation_size + self.critic_size
        outputs = tuple(name for name in ("torque", "motor_torque", "contact_forces") if name in self.schema)
        _, scratch, physics = substeps(self.model.mechanism, self.options, outputs)
        buffers = [
            Buffer("action_in", self.n_actions, "rows_in", "float32"),
            Buffer("clipped", self.n_actions, "scratch"),
            *([Buffer("draws", n_draws, "random")] if n_draws else []),
            Buffer("observation", size, "rows_out", "float32"),
            Buffer("outcome", len(OUTCOME) + len(self.reward_terms), "rows_out", "float64"),
            Buffer("ended", 1 + len(self.sum_names), "rows_out", "float64"),
            *[buffer for buffer in scratch if buffer.kind != "table"],
        ]
        targets = len(self.actions.targets)
        if "delay" in self.schema:
            buffers += [Buffer("new_target", targets, "scratch"), Buffer("waited", 1, "scratch")]
            steps = (Call(act, ("action_in",), ("clipped", "new_target", "waited")), *self.actions.delayed(physics))
        else:
            buffers += [Buffer("target", targets, "scratch")]
            steps = (Call(act, ("action_in",), ("clipped", "target")), *physics)
        look, seeing = self._look_at_ground(begins=False)
        steps = (*steps, *look, assess)
        if fused:
            seen = SX.sym("observation", size)
            steps = (*steps, Call(ca.Function("keep", [seen], [seen]), ("observation",), ("final_observation",)))
            buffers.append(Buffer("final_observation", size, "rows_out", "float32"))
        return self._program("environment", [*buffers, *seeing], steps)

    def reset_program(self) -> Program:
        """Return the program that starts new episodes where `chosen` is 1."""
        stages = self.stages
        begin, n_draws = stages.begin()
        buffers = [
            Buffer("first_draws", n_draws, "random"),
            Buffer("observation", self.observation_size + self.critic_size, "rows_out", "float32"),
        ]
        steps: tuple[Step, ...] = (begin,)
        if self.ground:
            place, n_draws = stages.place()
            look, seeing = self._look_at_ground(begins=True)
            buffers += [Buffer("place_draws", n_draws, "random"), *seeing]
            steps = (place, *look, begin)
        return self._program("reset", buffers, steps, skip_unless="chosen")

    def _program(
        self, name: str, buffers: list[Buffer], steps: tuple[Step | Repeat, ...], skip_unless: str = ""
    ) -> Program:
        """Return a program with those state buffers that it uses."""
        program = Program(f"{self.model.robot.name} {self.model.transmission} {name}", (), steps, skip_unless)
        used = {skip_unless, *(name for call in program.calls for name in (*call.inputs, *call.outputs))}
        own = {buffer.name for buffer in buffers}
        state = [b for b in state_buffers(self.schema.values()) if b.name in used and b.name not in own]
        return replace(program, buffers=(*state, *buffers))

    def _look_at_ground(self, begins: bool) -> tuple[tuple[Step, ...], list[Buffer]]:
        """What a program has to do, and the buffers that takes, for the task to see the ground; nothing if flat."""
        if not self.ground:
            return (), []
        buffers, look = self.ground.look(self.state_sizes.get("dependent", 0))
        buffers = [Buffer(HEIGHTS, 0, "table"), *buffers]
        if not (looked := self.probe.looked):
            return look, buffers
        for places in self.stages.places(begins):
            look = (*look, places)
            for i, at in enumerate(places.outputs):
                name = at.removesuffix("_places")
                look = (*look, Lookup(HEIGHTS, FRAME, at, name, slopes=False, grid=self.probe.grids[name]))
                buffers += [Buffer(at, places.function.numel_out(i), "scratch"), Buffer(name, looked[name], "scratch")]
        return look, buffers

    def function(self, name: Literal["act", "assess", "begin"]) -> ca.Function:
        """Trace what is done once in an environment step, before and after its sub-steps, or in a reset."""
        if name == "act":
            return self.actions.act("delay" in self.schema)
        stages = self.stages
        return (stages.assess() if name == "assess" else stages.begin())[0].function
