"""`DifferentiableEnv`: control steps of an environment with reverse-mode gradients."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from ce_gym.compile import aligned_copy, load_kernel
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.runtime.batch import kernel_key
from ce_gym.envs.runtime.gradient import ControlStepGradient
from ce_gym.envs.runtime.stages import Stages
from ce_gym.envs.terms.registry import Term

STEPS = {
    ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_SIGN,
    ca.OP_IF_ELSE_ZERO,
}  # fmt: skip
"""Operations with a discontinuous value."""
KINKS = {ca.OP_FABS, ca.OP_FMIN, ca.OP_FMAX}
"""Operations with a discontinuous slope."""


@dataclass
class Record:
    """One recorded control step.

    Attributes:
        arrays: State before the step, by name of the buffer.
        versions: Version before the step of each part of the state that passes a gradient, see `Batch.version`.
        counters: Counters of the random streams before the step.
        action: Action, shape (num_envs, n_actions).
        ignored: Robots that were reset instead of stepped, shape (num_envs,).
        replaced: Robots that returned the first observation of the next episode, shape (num_envs,).
    """

    arrays: dict[str, NDArray]
    versions: dict[str, NDArray[np.int64]]
    counters: NDArray
    action: NDArray
    ignored: NDArray
    replaced: NDArray


class DifferentiableEnv:
    """Control steps of an environment with gradients of sub-steps, observations and rewards.

    Gradients hold the active set of the step fixed: contacts that touch or stick, active limits, branches of terms.
    They do not pass the end or the start of an episode, a call that sets the state, or steps that are not recorded. A
    robot that diverged, or halved a sub-step (see `Simulator`), has a gradient of zero.

    Args:
        env: An unwrapped environment of this package on the CPU, with flat ground and without latency.
        largest: Largest norm of the gradient of a robot that passes from a control step to the one before.

    Attributes:
        not_smooth: Terms that are not smooth in the motion of the robot, by kind and name: "no gradient" (piecewise
            constant), "jumps" (discontinuous) or "kinks" (discontinuous slope).

    Raises:
        ValueError: The environment cannot be differentiated.

    Examples:
        >>> env = gymnasium.make_vec("ce_gym/MiniCheetahVelocity-v0", num_envs=8)
        >>> observations, _ = env.reset(seed=0)
        >>> differentiable = env.unwrapped.differentiable()
        >>> for _ in range(3):
        ...     result = differentiable.step(np.zeros((8, 12)))
        >>> gradients = [differentiable.backward(by_reward=np.ones(8)) for _ in range(3)]
        >>> print(gradients[0].shape)
        (8, 12)
    """

    def __init__(self, env: Any, largest: float = np.inf) -> None:
        self.env, self.batch, self.largest = env, env.batch, float(largest)
        place, n, dtype = self.batch.place, self.batch.num_envs, self.batch.dtype
        if place.name != "cpu":
            raise ValueError(f"differentiable environment on device {place.name!r}; expected 'cpu'")
        if not self.largest > 0:
            raise ValueError(f"largest={largest!r}; expected a number above 0")
        gradient = ControlStepGradient(self.batch.program)
        self._kernel = load_kernel(f"control step gradient {kernel_key(self.batch.program)}", gradient.program, dtype)
        self._recorded = [name for name in self._kernel.buffers if name in self.batch.schema]
        self._weights = gradient.weights
        self._carried = {weight.name: place.tiles(n, weight.size, dtype) for weight in self._weights.values()}
        self._following = dict.fromkeys(self._weights, np.full(n, -1))  # versions before the step differentiated last
        self._records, self._spare = list[Record](), list[dict[str, NDArray]]()

    @property
    def n_recorded(self) -> int:
        """Number of recorded control steps that have not been differentiated."""
        return len(self._records)

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Step the environment and record the step; arguments and results as for `step` of the environment."""
        batch, same_step = self.batch, getattr(self.env, "autoreset_mode", None) == AutoresetMode.SAME_STEP
        arrays = self._spare.pop() if self._spare else {x: aligned_copy(batch.arrays[x]) for x in self._recorded}
        for name, array in arrays.items():
            array[...] = batch.arrays[name]
        counters, ignored = batch.arrays["counters"].copy(), batch.arrays["finished"].copy()
        retries = batch.arrays["retries"].copy()
        versions = {name: batch.version(name) for name in self._weights}
        result = self.env.step(actions)
        arrays["diverged"][batch.arrays["retries"] > retries] = 1  # halved sub-steps are not differentiated
        action = (
            np.clip(actions, -2, 2).astype(np.float32).reshape(batch.num_envs, -1)
        )  # keeps actions beyond 1 beyond 1
        replaced = np.reshape(np.logical_or(result[2], result[3]), -1) & same_step
        self._records.append(Record(arrays, versions, counters, action, ignored, replaced))
        return result

    def backward(
        self, by_observation: Any = None, by_reward: ArrayLike = 0.0, by_final_observation: Any = None
    ) -> NDArray:
        """Differentiate the last recorded control step and remove it from the record.

        The gradient with respect to the state before this step is stored and used by the next call, which
        differentiates the control step before.

        Args:
            by_observation: Gradient of a loss with respect to the observation that the step returned, in its shape;
                None for zero. Ignored for the first observation of a new episode.
            by_reward: Gradient with respect to the reward, shape (num_envs,).
            by_final_observation: Gradient with respect to `final_obs`, where the next episode began in the same step.

        Returns:
            Gradient with respect to the action, shape (num_envs, n_actions); 0 for ignored actions.

        Raises:
            ValueError: No control step is recorded, or a shape is wrong.
        """
        if not self._records:
            raise ValueError("backward: no control step is recorded; expected `step` before")
        record, n, dtype = self._records.pop(), self.batch.num_envs, self.batch.dtype
        rows = self._rows(by_observation)
        if record.replaced.any():
            rows = np.where(record.replaced[:, None], self._rows(by_final_observation), rows)
        rewards = np.empty((n, 1), dtype)
        rewards[:, 0] = by_reward
        if record.ignored.any():
            rows, rewards = rows * ~record.ignored[:, None], rewards * ~record.ignored[:, None]
        for name, version in record.versions.items():
            follows = self._following[name] == version + 1  # a step changes the state once, and a reset in it again
            if not follows.all():
                self.batch.place.write(self._carried[self._weights[name].name], 0.0, ~follows)
        control = np.empty((n, 2), dtype)
        control[:, 0] = ~record.ignored
        control[:, 1] = min(self.largest, float(np.finfo(dtype).max))
        result = np.empty((n, self.batch.program.n_actions), dtype)
        arrays = {"action_in": record.action, "w_observation": rows, "w_reward": rewards}
        arrays |= {"control": control, "by_action": result}
        streams = {"keys": self.batch.arrays["keys"].view(np.uint64), "counters": record.counters}
        self._kernel(record.arrays | self._carried | arrays, n, num_threads=self.batch.num_threads, **streams)
        self._following = {name: np.where(record.ignored, -1, x) for name, x in record.versions.items()}
        self._spare.append(record.arrays)
        return result

    def state_gradient(self) -> dict[str, NDArray]:
        """Return gradients with respect to the state before the control step that was differentiated last.

        Arrays by name of the state, shape (num_envs, size), not yet limited to `largest`. The gradient to `q` is in the
        tangent space of positions.
        """
        read = self.batch.place.read
        return {name: read(self._carried[w.name], self.batch.num_envs) for name, w in self._weights.items()}

    def clear(self) -> None:
        """Remove all recorded control steps."""
        self._spare += [record.arrays for record in self._records]
        self._records.clear()

    @cached_property
    def not_smooth(self) -> dict[str, str]:
        """Terms that are not smooth, see the attributes of the class."""
        program = self.batch.program
        terms = {f"{term.kind} {term.name}": term for term in program.terms if term.kind != "metric"}
        roughness = {name: _roughness(program.stages, term) for name, term in terms.items()}
        return {name: kind for name, kind in roughness.items() if kind}

    def _rows(self, gradient: Any) -> NDArray:
        """Return gradients with respect to observations in the layout of the kernel: policy, then critic."""
        p, n = self.batch.program, self.batch.num_envs
        rows = np.zeros((n, p.observation_size + p.critic_size), self.batch.dtype)
        columns = {"policy": slice(p.observation_size), "critic": slice(-(p.critic_size or p.observation_size), None)}
        parts = gradient if isinstance(gradient, Mapping) else {"policy": gradient}
        for name, part in parts.items():
            if part is None:
                continue
            if name not in columns or np.size(part) != rows[:, columns[name]].size:
                raise ValueError(
                    f"gradient of observation {name!r} has shape {np.shape(part)}; expected that of {name}"
                )
            rows[:, columns[name]] += np.reshape(part, (n, -1))
        return rows


def _roughness(stages: Stages, term: Term) -> str:
    """Return "no gradient", "jumps" or "kinks" for a term that is not smooth in the motion, else ""."""
    state = stages.state | stages.ground_values | {"previous_action": SX.sym("previous", stages.spec.n_actions)}
    context = stages.context(state)
    value = ca.vec(term(context))
    moving = [state[name] for name in ("q", "v", "load", "torque", "action", "previous_action") if name in state]
    moving += list(context.memory.values())
    moved = ca.vertcat(*moving)
    if not ca.depends_on(value, moved):
        return ""
    if not ca.sparsify(ca.jacobian(value, moved)).nnz():
        return "no gradient"
    others = [x for x in ca.symvar(value) if not ca.depends_on(x, moved)]
    operations = _operations_on(ca.Function("term", [moved, ca.vertcat(SX(0, 1), *others)], [value]))
    return "jumps" if operations & STEPS else "kinks" if operations & KINKS else ""


def _operations_on(function: ca.Function) -> set[int]:
    """Return the operations of a function that depend on its first argument."""
    depends, operations = dict[int, bool](), set[int]()
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        if op == ca.OP_OUTPUT:
            continue
        (result,) = function.instruction_output(k)
        if op == ca.OP_INPUT:
            depends[result] = function.instruction_input(k)[0] == 0
            continue
        operands = [depends[i] for i in function.instruction_input(k)] if op != ca.OP_CONST else []
        # a branch counts only if its condition depends on the motion, not on the clock or the command
        operations |= {op} if any(operands[:1] if op == ca.OP_IF_ELSE_ZERO else operands) else set()
        depends[result] = any(operands)
    return operations
