"""A task on a robot as the two programs of an environment, and the schema of the state that they share.

step:   act -> physics sub-steps -> ground look-ups -> evaluate    all robots, every control step
reset:  spawn -> ground look-ups -> reset                          only tiles with a robot to reset
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np

from ce_gym.compile import Buffer, Call, Foreign, Lookup, Program, Repeat, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.runtime.spec import TaskSpec
from ce_gym.envs.runtime.stages import OUTCOME, Stages
from ce_gym.sim.schema import COUNT, FINITE, Row, physics_rows, state_buffers
from ce_gym.sim.substeps import FRAME, HEIGHTS, substeps

HOST_ROWS = (
    Row("limit", 1, "host", np.inf, bounds=(0.0, np.inf)),
    Row("keys", 0, "host", dtype="int64"),
    Row("counters", 0, "host", dtype="int64"),
    Row("seeded", 0, "host", dtype="bool"),
    Row("finished", 0, "host", dtype="bool"),
)
"""State that only the host writes: control steps until time is up; key and counter of the random stream; whether the
stream has been seeded; whether the episode has ended and the next one has not begun."""


class TaskProgram(TaskSpec):
    """Traces one task on one robot as the programs of an environment."""

    @cached_property
    def _rows(self) -> dict[str, Row]:
        """The schema without the rows that terms add."""
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
        physics = physics_rows(self.model, self.options, outputs, self.task.dt, self.task.tolerance)
        rows = [replace(row, writer="task") if row.name == "parameters" else row for row in (*physics, *HOST_ROWS)]
        bounds = dict.fromkeys(("clock", "elapsed", "failures"), COUNT) | {"draw": (0.0, 1.0)}
        rows += [Row(name, size, "task", bounds=bounds.get(name, FINITE)) for name, size in sizes.items() if size]
        rows += [Row(FRAME, 3, "host", bounds=FINITE)] if self.ground and not self.contacts else []
        return {row.name: row for row in rows}

    @cached_property
    def stages(self) -> Stages:
        """The traced stages around the sub-steps."""
        return Stages(self, self._rows)

    @cached_property
    def schema(self) -> dict[str, Row]:
        """State of one robot, by name."""
        observation = Row("observation", self.observation_size + self.critic_size, "host", dtype="float32")
        return self._rows | self.stages.rows | {"observation": observation}

    @cached_property
    def state_sizes(self) -> dict[str, int]:
        """Sizes of the state buffers in the lanes of the kernels, by name."""
        return {row.name: row.size for row in self.schema.values() if not row.dtype}

    @cached_property
    def sum_names(self) -> list[str]:
        """Names of the entries of `sums`, the sums over an episode, in order."""
        return [
            "return",
            *(f"reward/{name}" for name in self.reward_terms),
            *(f"metrics/{name}" for name in self.metric_terms),
        ]

    @cached_property
    def observation_sizes(self) -> dict[str, int]:
        """Length of each block of one observation of the policy, by name, in order."""
        return {name: self.stages.block_sizes[name] for name in self.observation_terms}

    @cached_property
    def observation_size(self) -> int:
        """Length of the policy's observation, history included."""
        return self.task.history * sum(self.observation_sizes.values())

    @cached_property
    def critic_size(self) -> int:
        """Length of the critic's observation, the policy's blocks included; 0 if the task has no critic blocks."""
        return sum(self.stages.block_sizes.values()) if self.task.critic else 0

    def step_program(self, fused: bool = False, joint_space: bool = True) -> Program:
        """Return act, physics and evaluate as one program.

        Args:
            fused: Whether robots that are done are reset in the same launch, as on a GPU. `final_observation` then
                keeps the observation before the reset.
            joint_space: See `Device`.
        """
        evaluate, n_draws = self.stages.evaluate()
        act, size = self.actions.act("delay" in self.schema), self.observation_size + self.critic_size
        outputs = tuple(name for name in ("torque", "motor_torque", "contact_forces") if name in self.schema)
        _, scratch, physics = substeps(self.model.mechanism, self.options, outputs, joint_space)
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
        look_ups, ground_buffers = self._ground_look_ups(begins=False)
        njit_steps, njit_buffers = self._njit_steps()
        steps = (*steps, *look_ups, *njit_steps, evaluate)
        if fused:
            x = SX.sym("observation", size)
            steps = (*steps, Call(ca.Function("keep", [x], [x]), ("observation",), ("final_observation",)))
            buffers.append(Buffer("final_observation", size, "rows_out", "float32"))
        return self._program("environment", [*buffers, *ground_buffers, *njit_buffers], steps)

    def _njit_steps(self) -> tuple[tuple[Step, ...], list[Buffer]]:
        """Return the steps that call the user's `@njit` terms, whose addresses are run-time integers; see `Foreign`."""
        if not self.njit_terms:
            return (), []
        keys, buffers = [term.key for term in self.njit_terms], []
        inputs = self.stages.njit_inputs()
        for key in keys:
            size = inputs.function.numel_out(inputs.outputs.index(f"{key}_inputs"))
            buffers += [Buffer(f"{key}_inputs", size, "scratch"), Buffer(key, 1, "rows_out", "float64")]
        return (inputs, *[Foreign(key, (f"{key}_inputs", key)) for key in keys]), buffers

    def reset_program(self) -> Program:
        """Return the program that starts new episodes where `chosen` is 1."""
        reset, n_draws = self.stages.reset()
        buffers = [
            Buffer("first_draws", n_draws, "random"),
            Buffer("observation", self.observation_size + self.critic_size, "rows_out", "float32"),
        ]
        steps: tuple[Step, ...] = (reset,)
        if self.ground:
            spawn, n_draws = self.stages.spawn()
            look_ups, ground_buffers = self._ground_look_ups(begins=True)
            buffers += [Buffer("spawn_draws", n_draws, "random"), *ground_buffers]
            steps = (spawn, *look_ups, reset)
        return self._program("reset", buffers, steps, skip_unless="chosen")

    def _program(
        self, name: str, buffers: list[Buffer], steps: tuple[Step | Repeat, ...], skip_unless: str = ""
    ) -> Program:
        """Return a program with the state buffers that its steps use."""
        program = Program(f"{self.model.robot.name} {self.model.transmission} {name}", (), steps, skip_unless)
        used = {skip_unless, *(name for call in program.calls for name in (*call.inputs, *call.outputs))}
        declared = {buffer.name for buffer in buffers}
        state = [b for b in state_buffers(self.schema.values()) if b.name in used and b.name not in declared]
        return replace(program, buffers=(*state, *buffers))

    def _ground_look_ups(self, begins: bool) -> tuple[tuple[Step, ...], list[Buffer]]:
        """Return the steps with which a program looks up the ground, and their buffers; empty on flat ground."""
        if not self.ground:
            return (), []
        buffers, steps = self.ground.look_up(self.state_sizes.get("dependent", 0))
        buffers = [Buffer(HEIGHTS, 0, "table"), *buffers]
        for places in self.stages.places(begins) if self.stages.grids else ():
            steps = (*steps, places)
            for i, points in enumerate(places.outputs):
                name = points.removesuffix("_places")
                steps = (*steps, Lookup(HEIGHTS, FRAME, points, name, slopes=False, grid=self.stages.grids[name]))
                buffers.append(Buffer(points, places.function.numel_out(i), "scratch"))
                buffers.append(Buffer(name, self.stages.ground_values[name].numel(), "scratch"))
        return steps, buffers

    def function(self, name: Literal["act", "evaluate", "reset"]) -> ca.Function:
        """Return the function of a stage: the action, the evaluation after the sub-steps, or the reset."""
        if name == "act":
            return self.actions.act("delay" in self.schema)
        return (self.stages.evaluate() if name == "evaluate" else self.stages.reset())[0].function
