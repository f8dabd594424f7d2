"""How long the lines of a scene report take: each is compiled as a kernel of its own, and all are timed in turn.

A line is the difference of two kernels, round by round, so that a change of the machine's pace meets both; the figure
is the median over rounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.compile import Buffer, Call, Kernel, Program, Repeat, load_kernel, source_fingerprint
from ce_gym.diagnostics.scene import SceneReport, SubStep
from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
from ce_gym.dynamics.model import Model
from ce_gym.envs.runtime.batch import TaskBatch
from ce_gym.sim.devices import device_named
from ce_gym.sim.kernels import load_step_kernel
from ce_gym.sim.substeps import DT, FRAME, HEIGHTS, TIMES
from ce_gym.sim.tiles import tiles, write_rows

BATCH = 512
"""Robots that a kernel steps while it is timed: few enough to stay in the cache of one core."""
REPEATS = 20
"""Sub-steps, or calls, in one round."""
ROUNDS = 15
"""Rounds over all kernels."""
DTYPE = "float64"

Work = Callable[[], float]
"""Does some work and returns how long it took for one robot [ns]."""


@dataclass(frozen=True)
class SceneTimes:
    """Nanoseconds for one robot on one core, in double precision.

    Attributes:
        sub_step: A sub-step, further iterations included where they were called for.
        env_step: An environment step as users get it, random actions, everything included.
        added: What an item of the report adds, by its group and name.
    """

    sub_step: float
    env_step: float
    added: dict[tuple[str, str], float]


def time_scene(report: SceneReport) -> SceneTimes:
    """Compile and time everything in a report; the kernels come from the cache the second time."""
    items = (*report.layers, *report.groups, *report.sometimes, *report.left_out)
    works = {(item.group, item.name): _work(report.program.model, item.compiled) for item in items if item.compiled}
    whole, env = (report.layers[-1].group, report.layers[-1].name), ("", "environment step")
    works[env] = _env_work(report)
    rounds = _in_turn(works)
    added: dict[tuple[str, str], float] = {}
    for chain in (report.layers, [item for item in report.groups[1:] if item.compiled]):
        before: NDArray | float = 0.0
        for item in chain:
            now = rounds[item.group, item.name]
            added[item.group, item.name], before = float(np.median(now - before)), now
    for item in (report.groups[0], *report.sometimes):
        added[item.group, item.name] = float(np.median(rounds[item.group, item.name]))
    for item in report.left_out:
        added[item.group, item.name] = float(np.median(rounds[item.group, item.name] - rounds[whole]))
    return SceneTimes(float(np.median(rounds[whole])), float(np.median(rounds[env])), added)


def _in_turn(works: dict[tuple[str, str], Work]) -> dict[tuple[str, str], NDArray]:
    """Do each work once unobserved, then all in turn; return the times, shape (ROUNDS,) each [ns]."""
    for work in works.values():
        work()
    times = [[work() for work in works.values()] for _ in range(ROUNDS)]
    return dict(zip(works, np.array(times).T, strict=True))


def _work(model: Model, compiled: SubStep | ca.Function) -> Work:
    """Prepare the kernel of a sub-step, which goes on from where it was, or of a function on constant arguments."""
    if isinstance(compiled, SubStep):
        model, options = compiled.model, compiled.options
        kernel = load_step_kernel(model, options, compiled.outputs, DTYPE)
        defaults = parameter_defaults(model.robot, options.material, options.parameters)
    else:
        kernel, defaults = _function_kernel(compiled), {}
    values = {
        "q": model.standing_q,
        "v": np.random.default_rng(0).normal(0, 0.1, (BATCH, model.nv)),
        "dependent": model.guess,
        "parameters": np.concatenate([np.zeros(0), *defaults.values()]),
        DT: 0.005,
        FRAME: np.array([-4.0, -4.0, 0.5]),
    }
    start = {name: tiles(BATCH, b.size, DTYPE) for name, b in kernel.buffers.items() if b.kind == "tiles"}
    for name, array in start.items():
        write_rows(array, np.broadcast_to(values.get(name, 0.0), (BATCH, array.shape[1])))
    arrays = {name: tiles(BATCH, array.shape[1], DTYPE) for name, array in start.items()}
    first = model.robot.layout.joints_q
    standing = model.standing_q[first : first + len(model.joint_links)]
    given = {"target": np.tile(standing, (BATCH, 1))} if "target" not in start else {}
    given[HEIGHTS] = np.zeros((17, 17), DTYPE)

    def work() -> float:
        for name, array in arrays.items():
            np.copyto(array, start[name])
        return _clocked(lambda: kernel(arrays | given, BATCH, repeats={TIMES: REPEATS}), BATCH * REPEATS)

    return work


def _env_work(report: SceneReport) -> Work:
    batch = TaskBatch(report.program, BATCH, DTYPE, device_named("cpu"))
    batch.seed(np.arange(BATCH).astype(np.uint64))
    batch.reset(np.ones(BATCH, bool))
    actions = np.random.default_rng(0).uniform(-1, 1, (BATCH, report.program.n_actions)).astype(np.float32)
    return lambda: _clocked(lambda: batch.step(actions), BATCH)


def _function_kernel(function: ca.Function) -> Kernel:
    """Compile the repeated call of one function."""

    def build() -> Program:
        arguments = function.sx_in()
        results = [result for result in function.call(arguments) if result.numel()]
        written = tuple(f"result{i}" for i in range(len(results)))
        buffers = [Buffer(name, x.numel(), "tiles") for name, x in zip(function.name_in(), arguments, strict=True)]
        buffers += [Buffer(name, x.numel(), "scratch") for name, x in zip(written, results, strict=True)]
        call = Call(ca.Function(function.name(), arguments, results), tuple(function.name_in()), written)
        return Program(f"part of a scene: {function.name()}", tuple(buffers), (Repeat(TIMES, (call,)),))

    return load_kernel(f"{source_fingerprint(__name__)} {function.serialize()}", build, DTYPE)


def _clocked(work: Callable[[], object], units: int) -> float:
    """Return the CPU time of one unit of work on this thread [ns]."""
    start = time.thread_time_ns()
    work()
    return (time.thread_time_ns() - start) / units
