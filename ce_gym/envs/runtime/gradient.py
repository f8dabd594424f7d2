"""The reverse mode of one control step as a program: sub-steps are repeated and their iterations kept, then reversed.

forwards    act -> sub-steps, with every iteration kept
backwards   observation and reward -> sub-steps and their iterations, last to first -> action

The gradient with respect to each part of the state stays in a buffer `w_{name}` from control step to control step.
The gradient with respect to positions `q` is in their tangent space.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise

import casadi as ca

from ce_gym.compile import Buffer, Call, Program, Step, calls_of, scratch_buffers
from ce_gym.dynamics.algebra.integration import tangent_basis
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.stepping.derivatives import adjoint_function, iterations_of, primal_function, state_parts
from ce_gym.dynamics.stepping.variables import Variables
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.sim.derivative_kernels import IterationTape

FLAGS = 2
"""Columns of the rows `control`: whether the gradient of the following control step is used, and its largest norm."""

SUMS, TORQUE = "substep_sums", "substep_torque"
"""Buffers for `sums` of the adjoint of a sub-step and for its torque; environments have `sums` and `torque`, too."""


class ControlStepGradient:
    """Traces the reverse mode of the control step of a task on a robot.

    Args:
        program: The task on the robot.

    Attributes:
        carried: Sizes of the gradients that pass from control step to control step, by name of the state.
        weights: Variables of these gradients.
        states: Variables of the state before each sub-step, and after the last.

    Raises:
        ValueError: The control step of the task cannot be differentiated.
    """

    def __init__(self, program: TaskProgram) -> None:
        task = program.task
        for unsupported, argument, expected in (
            (program.ground is not None, f"terrain {task.terrain['kind']!r}", "'flat'"),
            (task.latency[1] > 0, f"latency={task.latency}", "(0, 0)"),
            (program.njit_terms, "terms that are @njit functions", "traced terms"),
            ("motor_torque" in program.schema, "observation 'motor_torques'", "observations without it"),
            (task.method != "euler", f"method={task.method!r}", "'euler'"),
        ):
            if unsupported:
                raise ValueError(f"derivatives of a control step with {argument}; expected {expected}")
        mechanism, options = program.model.mechanism, program.options
        self.task, self.substeps = program, task.n_substeps
        self.primal = primal_function(mechanism, options, ("torque",))
        self.adjoint = adjoint_function(mechanism, options, ("torque",))
        self.parts, self.iterations = state_parts(self.primal), iterations_of(mechanism, options)
        names = ["action", *(name for name, row in program.schema.items() if row.writer == "term" or name == "history")]
        names += ["command"] if "heading" in program.schema else []
        sizes = self.parts | {name: program.schema[name].size for name in names}
        self.carried = sizes | {"q": sizes["q"] - 1}
        self.weights = Variables("w", self.carried)
        prefixes = ["", *(f"substep{k}" for k in range(1, self.substeps + 1))]
        self.states = [Variables(prefix, self.parts | {"diverged": 1}) for prefix in prefixes]
        self.evaluate, self.n_draws = program.stages.evaluate()

    def program(self) -> Program:
        """Return the program."""
        task, steps = self.task, [*self._forwards(), *self._backwards()]
        used = {name for call in calls_of(steps) for name in (*call.inputs, *call.outputs)}
        buffers = [
            Buffer("action_in", task.n_actions, "rows_in", "float32"),
            Buffer("w_observation", task.observation_size + task.critic_size, "rows_in"),
            Buffer("w_reward", 1, "rows_in"),
            Buffer("control", FLAGS, "rows_in"),
            *([Buffer("draws", self.n_draws, "random")] if "draws" in used else []),
            *(Buffer(weight.name, weight.size, "tiles") for weight in self.weights.values()),
            Buffer("by_action", task.n_actions, "rows_out"),
        ]
        state = [Buffer(row.name, row.size, "tiles") for row in task.schema.values() if row.name in used]
        known = {buffer.name for buffer in buffers} | task.schema.keys()
        scratch = scratch_buffers(steps, known)
        name = f"{task.model.robot.name} {task.model.transmission} control step gradient"
        return Program(name, tuple(state + buffers + scratch), tuple(steps), compact=True)

    def _tape(self, k: int) -> IterationTape:
        """Return the iterations of sub-step k."""
        return IterationTape(self.primal, self.adjoint, self.iterations, f"@{k}.")

    def _forwards(self) -> list[Step]:
        steps: list[Step] = [Call(self.task.function("act"), ("action_in",), ("clipped", "target"))]
        for k, (before, after) in enumerate(pairwise(self.states)):
            tape, results = self._tape(k), after.names | {"torque": TORQUE}
            steps += [tape.begin(), *tape.forwards(self.iterations, before.names, results)]
        return steps

    def _backwards(self) -> list[Step]:
        weights = tuple(self.weights.names.values())
        parts = tuple(self.weights[name].name for name in self.parts)
        steps: list[Step] = [Call(self._start(), ("control", *weights), (*weights, "by_target"))]
        steps.append(self._evaluate_adjoint())
        for k in reversed(range(self.substeps)):
            steps += self._tape(k).backwards(self.states[k].names | {"sums": SUMS})
            steps.append(Call(self._split_sums(), (SUMS, "by_target"), (*parts, "w_torque", "by_target")))
        return [*steps, Call(self._act_adjoint(), ("action_in", "by_clipped", "by_target"), ("by_action",))]

    def _start(self) -> ca.Function:
        """Trace (control, *carried gradients) -> these, cut off or shortened, and a gradient of 0 to the target."""
        control = SX.sym("control", FLAGS)
        weights = self.weights.named(self.weights.symbols())
        length = ca.norm_2(ca.vertcat(*weights.values()))
        scale = ca.if_else(length > control[1], control[1] / length, 1)
        results = {name: ca.if_else(control[0] > 0.5, scale * w, 0) for name, w in weights.items()}
        results["by_target"] = SX(ca.DM.zeros(len(self.task.actions.targets)))
        return traced("start", {"control": control} | weights, results)

    def _evaluate_adjoint(self) -> Call:
        """Return the adjoint of the stage `evaluate`, which follows the sub-steps; 0 for a diverged robot.

        It reads the gradients with respect to the state after the control step, observation and reward. It writes the
        gradients with respect to the state after the sub-steps, the torque of the last one and the clipped action.
        """
        f = self.evaluate.function
        inputs = {name: SX.sym(name, f.numel_in(i)) for i, name in enumerate(self.evaluate.inputs)}
        outputs = dict(zip(self.evaluate.outputs, f.call(list(inputs.values())), strict=True))
        inputs.setdefault("q", SX.sym("q", self.parts["q"]))
        diverged = inputs.setdefault("diverged", SX.sym("diverged"))
        weights = self.weights.symbols()
        w_observation, w_reward = SX.sym("w_observation", outputs["observation"].numel()), SX.sym("w_reward")

        changed = [name for name in self.carried if name in outputs]
        results = [outputs["observation"], outputs["outcome"][0], *(outputs[name] for name in changed)]
        seeds = [w_observation, w_reward, *(weights[name] for name in changed)]
        sizes = self.carried | {"torque": self.primal.numel_out("torque"), "clipped": self.task.n_actions}
        gradients = _adjoint(results, seeds, {name: inputs[name] for name in sizes if name in inputs})
        gradients["q"] = tangent_basis(inputs["q"], self.task.model.robot.layout).T @ gradients["q"]
        after = {}
        for name, size in sizes.items():
            gradient = gradients.get(name, SX(ca.DM.zeros(size)))
            if name in self.carried and name not in outputs:  # the stage does not write this part of the state
                gradient = gradient + weights[name]
            after[f"{name}_after"] = ca.if_else(diverged > 0.5, 0, gradient)

        inputs |= self.weights.named(weights)
        inputs |= {"w_observation": w_observation, "w_reward": w_reward}
        everything = ca.vertcat(*after.values())
        inputs = {name: x for name, x in inputs.items() if ca.depends_on(everything, x)}
        buffers = self.states[-1].names | {"torque": TORQUE}
        written = (*self.weights.names.values(), "w_torque", "by_clipped")
        function = traced("evaluate_adjoint", inputs, after)
        return Call(function, tuple(buffers.get(name, name) for name in inputs), written)

    def _split_sums(self) -> ca.Function:
        """Trace (sums, by_target) -> gradients to the parts of the state, 0 to the torque, and to the target so far."""
        sums = SX.sym("sums", self.adjoint.numel_in("sums"))
        by_target = SX.sym("by_target", len(self.task.actions.targets))
        sizes = [*(self.carried[name] for name in self.parts), by_target.numel()]
        ends = list(accumulate(sizes, initial=0))
        *parts, target = ca.vertsplit(sums[: ends[-1]], ends)
        results = {self.weights[name].name: part for name, part in zip(self.parts, parts, strict=True)}
        results["w_torque"] = SX(ca.DM.zeros(self.primal.numel_out("torque")))
        results["by_target"] = by_target + target
        return traced("split_sums", {"sums": sums, "by_target": by_target}, results)

    def _act_adjoint(self) -> ca.Function:
        """Trace (action, gradients to the clipped action and to the target) -> gradient to the action."""
        action = SX.sym("action_in", self.task.n_actions)
        clipped, target = self.task.function("act")(action)
        by_clipped, by_target = SX.sym("by_clipped", clipped.numel()), SX.sym("by_target", target.numel())
        gradient = _adjoint([clipped, target], [by_clipped, by_target], {"by_action": action})
        return traced("act_adjoint", {"action_in": action, "by_clipped": by_clipped, "by_target": by_target}, gradient)


def _adjoint(results: Sequence[SX], seeds: Sequence[SX], wrt: Mapping[str, SX]) -> dict[str, SX]:
    """Return the gradients of the sum of results times seeds with respect to each expression of `wrt`, by name."""
    gradient = ca.jtimes(ca.vertcat(*results), ca.vertcat(*wrt.values()), ca.vertcat(*seeds), True)
    ends = list(accumulate((x.numel() for x in wrt.values()), initial=0))
    return dict(zip(wrt, ca.vertsplit(gradient, ends), strict=True))
