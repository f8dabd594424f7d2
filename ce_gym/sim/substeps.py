"""The sub-steps of a scene as a kernel, or part of a kernel's program: the plan of its method, stage by stage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import casadi as ca

from ce_gym.compile import Buffer, Call, Foreign, Lookup, Program, Repeat, Step, While, scratch_buffers
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import LOAD
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping import halving, step_size
from ce_gym.dynamics.stepping.ground_lookup import (
    hull_places_function,
    hulls_function,
    places_function,
    planes_function,
    touching_function,
)
from ce_gym.dynamics.stepping.trace import (
    NEAR,
    NEAR_ITERATE,
    balance_function,
    combination_function,
    conserve_function,
    iteration_function,
    step_function,
)
from ce_gym.dynamics.stepping.variables import BALANCE, UNFINISHED, StepVariables
from ce_gym.model.mechanism import Mechanism
from ce_gym.sim.calls import NONE, assign, call
from ce_gym.sim.devices import Cpu, Device
from ce_gym.sim.kernel_key import laws_key, model_key

TIMES = "n_substeps"
"""Name of the run-time integer with the number of sub-steps."""
CONTROLLER = "controller"
"""Name of the run-time integer with the address of a user's controller."""
COMMAND = "command"
"""Name of the buffer of targets before the controller changes them."""
DT = "dt"
"""Name of the buffer with the length of a sub-step of each robot [s]."""
HEIGHTS = "heights"
"""Name of the table with the heights of the ground, on a field."""
FRAME = "frame"
"""Name of the buffer with the frame of that table for each robot: x, y of the first entry and the cell size [m]."""
ITERATE = "iterate"
"""Name of the iterate of forces that are always computed. Those of culled groups are zero between stages of steps."""
UNCONVERGED = "unconverged"
"""Name of the buffer that says whether a robot needs another iteration."""


def load_step_kernel(
    model: Model,
    options: StepOptions,
    outputs: tuple[str, ...],
    dtype: str,
    device: Device | None = None,
    controlled: bool = False,
) -> Any:
    """Compile, or load from the cache, the kernel that repeats a sub-step.

    Args:
        model: The robot at a transmission level.
        options: The scene.
        outputs: Quantities to compute besides the state.
        dtype: "float64" or "float32".
        device: Device of the kernel; the CPU if None.
        controlled: Whether each sub-step begins with a call of a controller, see `CONTROLLER`.
    """
    device = device or Cpu()

    def build() -> tuple[Program]:
        sizes, further, steps = substeps(model.mechanism, options, outputs, device.joint_space)
        joints = sizes.pop("target", 0)
        buffers = [Buffer(name, size, "tiles") for name, size in sizes.items()]
        buffers += [Buffer(COMMAND if controlled else "target", joints, "rows_in")] if joints else []
        if controlled:
            buffers.append(Buffer("target", joints, "scratch"))
            steps = _controlled(steps, joints)
        return (Program(f"{model.robot.name} {model.transmission} step", tuple(buffers + further), steps),)

    scene = f"{model_key(model)} {options!r} {laws_key(model.mechanism, options)}"
    return device.kernel(f"step {scene} {outputs!r} {controlled} {device.joint_space}", build, dtype)


def _controlled(steps: tuple[Step | Repeat, ...], size: int) -> tuple[Repeat]:
    """Return sub-steps that each begin with a call of the controller, as if each was a call of the kernel."""
    *begin, substep = steps
    assert isinstance(substep, Repeat)
    command = SX.sym(COMMAND, size)
    copy = call(traced("copy", {COMMAND: command}, {"target": command}))
    controller = Foreign(CONTROLLER, ("q", "v", "target"))
    return (replace(substep, calls=(*begin, copy, controller, *substep.calls)),)


def substeps(
    mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...], joint_space: bool = True
) -> tuple[dict[str, int], list[Buffer], tuple[Step | Repeat, ...]]:
    """Return the part of a program that advances a robot by `n_substeps` sub-steps.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Quantities to compute besides the state.
        joint_space: See `Scene`.

    Returns:
        Sizes of the buffers that the program must provide: state, `diverged`, `retries`, inputs of `step_function` with
        `DT`, on a field `FRAME`, and outputs; further buffers, which are scratch and on a field the table `HEIGHTS`;
        and the steps. Outputs that are empty for the robot are left out.
    """
    options, plan = replace(options, dt=None), METHODS[options.method]
    step = StepVariables(mechanism, options, outputs)
    if step.stages:
        function = iteration_function(
            mechanism, options, step.evaluated, culls=True, conserves=False, joint_space=joint_space
        )
    else:
        function = step_function(mechanism, options, step.evaluated)
    culled = [name for name in function.name_in() if name.startswith(NEAR_ITERATE)]
    computed = (ITERATE, *culled, BALANCE, "ground", "region_points")
    sizes = {name: function.numel_in(name) for name in function.name_in() if name not in computed}
    sizes |= {"retries": 1, **step.outputs} | ({FRAME: 3} if "ground" in function.name_in() else {})
    sizes |= step_size.control_sizes(mechanism.robot.layout) if plan.controlled else {}

    clear = [_clear(function, name) for name in culled]
    begin = call((step_size if plan.controlled else halving).begin_function(step))
    stages = _stages if step.stages else _one_call
    tries = (*stages(mechanism, options, step, function), *_accept(mechanism, options, step))
    clear += [call(balance_function(mechanism, options))] if step.stages else []
    steps = (*clear, Repeat(TIMES, (begin, While(UNFINISHED.name, tries))))
    buffers = scratch_buffers(steps, sizes)
    return sizes, buffers + ([Buffer(HEIGHTS, 0, "table")] if FRAME in sizes else []), steps


def _stages(
    mechanism: Mechanism, options: StepOptions, step: StepVariables, iteration: ca.Function
) -> Iterator[Call | Lookup]:
    """Yield the calls of a step that is tried: of each stage the iterations that a tile needs, then their combination.

    A tile iterates again only if one of its robots has not converged; the others reproduce their results.
    """
    plan = METHODS[options.method]
    culled = {
        NEAR + name.removeprefix(NEAR_ITERATE): name for name in iteration.name_in() if name.startswith(NEAR_ITERATE)
    }
    iterates = (*culled.values(), *([ITERATE] if ITERATE in iteration.name_in() else []))
    on_field, looked_up_at = "ground" in iteration.name_in(), None
    for stage in plan.stages:
        assert isinstance(stage.start, str), "explicit stages do not iterate"
        start, end = step.stages[stage.start] if stage.start else step.start, step.stages[stage.name]
        if on_field and stage.start != looked_up_at:
            yield from look_up(mechanism, options, start.names)
            looked_up_at = stage.start
        inputs = start.names | {DT: end.dt.name}
        if LOAD in start and not stage.start:
            inputs[LOAD] = start[stage.load].name
        if ITERATE in iterates:
            yield _clear(iteration, ITERATE)
        first = call(iteration, inputs, end.names, short_if_zero=tuple(culled))
        yield first
        yield from [replace(first, only_if=UNCONVERGED, again=iterates)] * step.iterations[stage.name]
        yield from [_clear(iteration, name, only_if=flag) for flag, name in culled.items()]
        yield call(conserve_function(mechanism, options), {**end.names, DT: end.dt.name}, end.names)
    if not plan.single:
        yield call(combination_function(mechanism, options, step), {DT: step.tried.dt.name}, step.tried.names)


def _clear(iteration: ca.Function, name: str, only_if: str = "") -> Call:
    """Return the call that sets an iterate to zero."""
    return assign({name: ca.DM.zeros(iteration.numel_in(name))}, only_if=only_if)


def _one_call(
    mechanism: Mechanism, options: StepOptions, step: StepVariables, function: ca.Function
) -> Iterator[Call | Lookup]:
    """Yield the calls of a step that is tried, by a method that does not iterate."""
    if "ground" in function.name_in():
        yield from look_up(mechanism, options)
    yield call(function, {DT: step.tried.dt.name}, step.tried.names)


def _accept(mechanism: Mechanism, options: StepOptions, step: StepVariables) -> tuple[Call, ...]:
    """Return the calls that accept or reject a try, and choose the next step, or part of a step, to try."""
    if METHODS[options.method].controlled:
        return (call(step_size.control_function(step, mechanism.robot.layout)),)
    return (
        call(halving.accept_function(step)),
        call(halving.subdivide_function(step, options.retry), only_if=UNFINISHED.name),
        call(halving.copy_function(step)),
    )


def look_up(mechanism: Mechanism, options: StepOptions, state: Mapping[str, str] = NONE) -> Iterator[Call | Lookup]:
    """Yield the calls that find the ground under the contacts.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        state: Buffers of the state by name, if not the start of the step.
    """
    contacts = {"places": "contact_places", "ground": "contact_ground"} if options.hulls else {}
    places, ground = contacts.get("places", "places"), contacts.get("ground", "ground")
    yield call(places_function(mechanism, options), state, contacts)
    yield Lookup(HEIGHTS, FRAME, places, ground)
    touching = touching_function(mechanism, options)
    if touching is not None:
        yield call(touching, {**state, **contacts})
        yield Lookup(HEIGHTS, FRAME, "touching", "touching_ground")
        yield call(planes_function(mechanism, options), contacts, contacts)
    if options.hulls:
        yield call(hull_places_function(mechanism, options), state)
        yield Lookup(HEIGHTS, FRAME, "hull_places", "hull_ground")
        yield call(hulls_function(mechanism, options), state)
