"""The reverse mode of a control step as one program: sub-steps made again and kept, then back through all of it.

forwards    act -> sub-steps, every iteration kept
backwards   observation and rewards -> sub-steps, last to first, iteration by iteration -> act

What is carried from control step to control step are gradients with respect to `carried`, one buffer `w_{name}` each,
read and overwritten; positions are differentiated in their tangent space.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.compile import Buffer, Call, Program, Step, calls_of
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.derivatives import tangent_basis
from ce_gym.dynamics.stepping.derivatives import adjoint_function, iterations_of, primal_function, state_parts
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.sim.derivative_kernels import Chain

FLAGS = 2
"""Columns of the rows `control`: whether the gradient goes on from the step after it, and its largest norm."""

BACK = {"sums": "substep_sums"}
"""Buffers that an environment has for something else under the name that the reverse mode of a sub-step uses."""


class ControlStepGradient:
    """Traces the reverse mode of the control step of a task on a robot.

    Args:
        program: The task on the robot.

    Attributes:
        carried: Sizes of the gradients that pass from control step to control step, by name of the state.

    Raises:
        ValueError: If the task is one whose control step cannot be differentiated.
    """

    def __init__(self, program: TaskProgram) -> None:
        task = program.task
        for unfit, given, expected in (
            (program.ground is not None, f"terrain {task.terrain['kind']!r}", "'flat'"),
            (task.latency[1] > 0, f"latency={task.latency}", "(0, 0)"),
            ("motor_torque" in program.schema, "observation 'motor_torques'", "observations without it"),
            (task.method != "euler", f"method={task.method!r}", "'euler'"),
        ):
            if unfit:
                raise ValueError(f"derivatives of a control step with {given}; expected {expected}")
        self.task, mechanism, options = program, program.model.mechanism, program.options
        self.primal = primal_function(mechanism, options, ("torque",))
        self.adjoint = adjoint_function(mechanism, options, ("torque",))
        self.parts, self.iterations = state_parts(self.primal), iterations_of(mechanism, options)
        own = ["action", *(name for name, row in program.schema.items() if row.writer == "term" or name == "history")]
        own += ["command"] if "heading" in program.schema else []
        sizes = self.parts | {name: program.schema[name].size for name in own}
        self.carried = sizes | {"q": sizes["q"] - 1}
        self.substeps = program.task.n_substeps
        self.assess, self.n_draws = program.stages.assess()

    def program(self) -> Program:
        """Return the program."""
        task, steps = self.task, [*self._forwards(), *self._backwards()]
        used = {name for call in calls_of(steps) for name in (*call.inputs, *call.outputs)}
        own = [
            Buffer("action_in", task.n_actions, "rows_in", "float32"),
            Buffer("w_observation", task.observation_size + task.critic_size, "rows_in"),
            Buffer("w_reward", 1, "rows_in"),
            Buffer("control", FLAGS, "rows_in"),
            *([Buffer("draws", self.n_draws, "random")] if "draws" in used else []),
            *(Buffer(f"w_{name}", size, "tiles") for name, size in self.carried.items()),
            Buffer("by_action", task.n_actions, "rows_out"),
        ]
        known = {buffer.name for buffer in own}
        state = [Buffer(row.name, row.size, "tiles") for row in task.schema.values() if row.name in used]
        scratch = [Buffer(name, size, "scratch") for name, size in self._sizes(steps).items() if name not in known]
        scratch = [buffer for buffer in scratch if buffer.name not in task.schema]
        name = f"{task.model.robot.name} {task.model.transmission} control step gradient"
        return Program(name, tuple(state + own + scratch), tuple(steps), compact=True)

    def _sizes(self, steps: list[Step]) -> dict[str, int]:
        sizes: dict[str, int] = {}
        for call in steps:
            assert isinstance(call, Call)
            f = call.function
            sizes |= {name: f.numel_in(i) for i, name in enumerate(call.inputs)}
            sizes |= {name: f.numel_out(i) for i, name in enumerate(call.outputs)}
        return sizes

    def _at(self, name: str, k: int) -> str:
        """Name of the buffer of a part of the state before sub-step k; `torque` is that of the last one."""
        return name if k == 0 else f"{name}@{k}"

    def _forwards(self) -> list[Step]:
        act = self.task.function("act")
        steps: list[Step] = [Call(act, ("action_in",), ("clipped", "target"))]
        for k in range(self.substeps):
            chain = self._chain(k)
            after = self._parts_at(k + 1) | {"torque": "torque@"}
            steps += [chain.begun(), *chain.forwards(self.iterations, self._parts_at(k), after)]
        return steps

    def _chain(self, k: int) -> Chain:
        """Return the iterations of sub-step k."""
        return Chain(self.primal, self.adjoint, self.iterations, f"@{k}.")

    def _parts_at(self, k: int) -> dict[str, str]:
        """Names of the buffers of the state before sub-step k."""
        return {name: self._at(name, k) for name in (*self.parts, "diverged")}

    def _backwards(self) -> list[Step]:
        flags = ("control", *(f"w_{name}" for name in self.carried))
        steps: list[Step] = [Call(self._begun(), flags, (*flags[1:], "by_target")), self._assessed()]
        for k in reversed(range(self.substeps)):
            steps += self._chain(k).backwards(self._parts_at(k) | BACK)
            state = tuple(f"w_{name}" for name in self.parts)
            steps.append(Call(self._split(), (BACK["sums"], "by_target"), (*state, "w_torque", "by_target")))
        return [*steps, Call(self._act_adjoint(), ("action_in", "by_clipped", "by_target"), ("by_action",))]

    def _begun(self) -> ca.Function:
        """Trace (control, *carried gradients) -> the same, cut or shortened, and a gradient of 0 to the target."""
        control = SX.sym("control", FLAGS)
        given = {f"w_{name}": SX.sym(name, size) for name, size in self.carried.items()}
        length = ca.norm_2(ca.vertcat(*given.values()))
        scale = ca.if_else(length > control[1], control[1] / length, 1)
        left = {f"{name}_next": ca.if_else(control[0] > 0.5, scale * w, 0) for name, w in given.items()}
        left["by_target"] = SX(ca.DM.zeros(len(self.task.actions.targets)))
        return traced("begun", {"control": control} | given, left)

    def _assessed(self) -> Call:
        """Return the reverse mode of what follows the sub-steps; of a diverged robot nothing is left."""
        f, moving = self.assess.function, (*self.parts, "diverged")
        x = {name: SX.sym(name, f.numel_in(i)) for i, name in enumerate(self.assess.inputs)}
        y = dict(zip(self.assess.outputs, f.call(list(x.values())), strict=True))
        x.setdefault("q", SX.sym("q", self.parts["q"]))
        w = {name: SX.sym(f"w_{name}", size) for name, size in self.carried.items()}
        seen, rewarded = SX.sym("w_observation", y["observation"].numel()), SX.sym("w_reward")
        changed = [name for name in self.carried if name in y]
        results = ca.vertcat(y["observation"], y["outcome"][0], *[y[name] for name in changed])
        seeds = ca.vertcat(seen, rewarded, *[w[name] for name in changed])
        wrt = {name: x[name] for name in (*self.carried, "torque", "clipped") if name in x}
        gradient = ca.jtimes(results, ca.vertcat(*wrt.values()), seeds, True)
        ends = [sum(value.numel() for value in list(wrt.values())[:i]) for i in range(len(wrt) + 1)]
        found = dict(zip(wrt, ca.vertsplit(gradient, ends), strict=True))
        found["q"] = tangent_basis(x["q"], self.task.model.robot.layout).T @ found["q"]
        sizes = self.carried | {"torque": self.primal.numel_out("torque"), "clipped": self.task.n_actions}
        total = {name: found.get(name, SX(ca.DM.zeros(size))) for name, size in sizes.items()}
        total |= {name: total[name] + w[name] for name in self.carried if name not in y}
        flag = x.setdefault("diverged", SX.sym("diverged"))
        left = {f"{name}_after": ca.if_else(flag > 0.5, 0, value) for name, value in total.items()}
        given = x | {f"w_{name}": value for name, value in w.items()} | {"w_observation": seen, "w_reward": rewarded}
        everything = ca.vertcat(*left.values())
        given = {name: value for name, value in given.items() if ca.depends_on(everything, value)}
        at = {name: self._at(name, self.substeps) for name in moving} | {"torque": "torque@"}
        buffers = tuple(f"w_{name}" for name in total if name != "clipped") + ("by_clipped",)
        return Call(traced("assessed", given, left), tuple(at.get(name, name) for name in given), buffers)

    def _split(self) -> ca.Function:
        """Trace (sums, by_target) -> gradients to the parts of the state, to no torque, and to the target so far."""
        sums, before = (
            SX.sym("sums", self.adjoint.numel_in("sums")),
            SX.sym("by_target", len(self.task.actions.targets)),
        )
        sizes = [self.carried[name] for name in self.parts] + [before.numel()]
        ends = [sum(sizes[:i]) for i in range(len(sizes) + 1)]
        *parts, target = ca.vertsplit(sums[: ends[-1]], ends)
        left = {f"w_{name}": part for name, part in zip(self.parts, parts, strict=True)}
        left |= {"w_torque": SX(ca.DM.zeros(self.primal.numel_out("torque"))), "by_target_next": before + target}
        return traced("split", {"sums": sums, "by_target": before}, left)

    def _act_adjoint(self) -> ca.Function:
        """Trace (action, gradients to the clipped action and to the target) -> to the action."""
        act, action = self.task.function("act"), SX.sym("action_in", self.task.n_actions)
        clipped, target = act(action)
        by = {"by_clipped": SX.sym("by_clipped", clipped.numel()), "by_target": SX.sym("by_target", target.numel())}
        gradient = ca.jtimes(ca.vertcat(clipped, target), action, ca.vertcat(*by.values()), True)
        return traced("act_adjoint", {"action_in": action} | by, {"by_action": gradient})
