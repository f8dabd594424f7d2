"""The variables of a time step, made once from the plan of its method; no other file composes their names.

A robot's state and outputs exist at the start of the step, at the end of each stage, and as `tried`: the result of a
step that has not been accepted yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import MOVED, OFF
from ce_gym.dynamics.laws.scene_laws import iterations_needed, output_sizes, state_sizes
from ce_gym.dynamics.stepping.conservation import balance_size
from ce_gym.model.mechanism import Mechanism

T = TypeVar("T")


@dataclass(frozen=True)
class Variable:
    """A vector that traced functions read and write; a kernel has a buffer of that name and size for it."""

    name: str
    size: int = 1

    def symbol(self) -> SX:
        """Return a symbol for the variable, shape (size,)."""
        return SX.sym(self.name, self.size)


DT, RETRIES = Variable("dt"), Variable("retries")
"""Length of the sub-step [s]; number of tries that were rejected because of a failure or a large error."""
LEFT, UNFINISHED = Variable("left"), Variable("unfinished")
"""Part of the sub-step that is left; whether the robot has to go on with it, 1 or 0."""


BALANCE = "balance"
"""Name of the momentum and energy after a stage, see `conservation.py`; only of methods that iterate."""


class Variables(dict[str, Variable]):
    """Variables by name, whose buffers have a prefix in common: `weights["q"]`.

    Args:
        prefix: Begins the names of the buffers; empty for none.
        sizes: Sizes by name.
    """

    def __init__(self, prefix: str, sizes: Mapping[str, int]) -> None:
        self._prefix = f"{prefix}_" if prefix else ""
        super().__init__({name: Variable(self._prefix + name, size) for name, size in sizes.items()})

    @property
    def names(self) -> dict[str, str]:
        """Names of the buffers, by name."""
        return {name: variable.name for name, variable in self.items()}

    def symbols(self) -> dict[str, SX]:
        """Return a symbol for each variable, by name."""
        return {name: variable.symbol() for name, variable in self.items()}

    def named(self, values: Mapping[str, T]) -> dict[str, T]:
        """Return values, given by name, by the names of their buffers."""
        return {self[name].name: value for name, value in values.items()}


class StateVariables(Variables):
    """State and outputs of a robot at one point of a step: `stage["q"]`, `stage.dt`."""

    @property
    def dt(self) -> Variable:
        """Length of the stage that ends there, or of the whole step [s]."""
        return Variable(f"{self._prefix}dt")


class StepVariables:
    """The variables of a step.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Names of the outputs; those that are empty for the robot are left out.

    Attributes:
        start: At the start of the step, and again after it once the step is accepted.
        tried: After the step that is tried, with `MOVED` and, if the step size is controlled, `OFF`.
        stages: At the end of each stage, by name. The only stage of a method is the step itself: `tried`. Methods that
            do not iterate are traced as one function; they have no stages here.
        iterations: How many iterations may follow the first one of each stage.
        outputs: Sizes of the outputs.
        evaluated: Outputs of the traced step, or of a stage; others follow from several stages.
    """

    def __init__(self, mechanism: Mechanism, options: StepOptions, outputs: Sequence[str] = ()) -> None:
        plan, known = METHODS[options.method], output_sizes(mechanism, options)
        self.outputs = {name: size for name in outputs if (size := known.get(name, 1))}
        measured = {MOVED: 1} | ({OFF: mechanism.robot.layout.nv + 1} if plan.controlled else {})
        state = state_sizes(mechanism, options) | {"diverged": 1}
        most = iterations_needed(mechanism, options)
        self.iterations = {stage.name: min(stage.iterations, most) for stage in plan.stages}
        iterates = any(self.iterations.values())
        balance = {BALANCE: balance_size(mechanism)} if iterates else {}
        self.start = StateVariables("", state | self.outputs | balance)
        self.tried = StateVariables("tried", state | self.outputs | measured | balance)
        evaluated = self.outputs | measured
        if iterates:
            evaluated = {name: size for name, size in self.outputs.items() if plan.single or name != "error"}
        self.evaluated = tuple(evaluated)
        self.stages = dict[str, StateVariables]()
        self._fractions = {self.tried.dt: 1.0}
        for stage in plan.stages if iterates else ():
            self.stages[stage.name] = (
                self.tried if plan.single else StateVariables(stage.name, state | evaluated | balance)
            )
            self._fractions[self.stages[stage.name].dt] = stage.length

    def lengths(self, dt: SX) -> dict[str, SX]:
        """Return the lengths of a step and its stages [s] by names of variables, given the length of the step."""
        return {length.name: fraction * dt for length, fraction in self._fractions.items()}
