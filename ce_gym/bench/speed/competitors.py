# pyright: reportAttributeAccessIssue=false
"""Sub-steps as something to time: our Simulator's and MuJoCo's rollout of the same robot from the same pose.

Targets jitter around the standing pose on both sides, which go on for half a second and then stand up again: a robot
that falls by itself is not timed on the ground. (MuJoCo's compiled modules carry no types, hence the line above.)
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from itertools import count, islice

import mujoco
import numpy as np

from ce_gym.bench.measure.timing import Competitor
from ce_gym.bench.peers import stand
from ce_gym.compile import Call, calls_of
from ce_gym.compile.lowering.counting import floating_point_operations
from ce_gym.dynamics.model import Model
from ce_gym.export.mujoco_batch import Batch
from ce_gym.export.mujoco_model import STIFF, Settings, compiled
from ce_gym.model import Robot
from ce_gym.sim import Simulator
from ce_gym.sim.substeps import substeps

SUBSTEPS = 4
"""Sub-steps of one call: one step of a policy."""
OUTPUTS = ("torque", "contact_forces")
TARGETS = 8
"""How many sets of targets take turns, one for each call."""
AGAIN = 25
"""Calls after which robots begin again from the standing pose."""
TOGETHER = 4096 * AGAIN
"""Robots times calls that are timed together: of batches up to 4096, whole half seconds."""


def ours(
    model: Model, dtype: str, num_envs: int, num_threads: int, dt: float, seldom: Sequence[str] = ()
) -> Competitor:
    """Return calls of `Simulator.step`, copying of targets included; one unit of work is one robot's sub-step."""
    sim = Simulator(model, num_envs, dt, dtype, num_threads, seldom=seldom)
    start, made = sim.snapshot(), count()
    calls = max(1, TOGETHER // num_envs)
    targets = np.ascontiguousarray(stand.targets(model.robot, num_envs, TARGETS, seed=2).swapaxes(0, 1))

    def run() -> None:
        for i in islice(made, calls):
            if i % AGAIN == 0:
                sim.restore(start)
            sim.step(targets[i % TARGETS], n_substeps=SUBSTEPS)

    return Competitor(run, num_envs * calls * SUBSTEPS)


def operations(model: Model, dtype: str, dt: float) -> int:
    """Return floating-point operations of one robot's sub-step; what only some steps do is not counted."""
    sim = Simulator(model, 1, dt, dtype)
    _, _, steps = substeps(model.mechanism, sim.options, OUTPUTS)
    calls = [call for call in calls_of(steps) if isinstance(call, Call) and not call.only_if]
    return sum(floating_point_operations(call.function, dtype) for call in calls)


def bytes_per_robot(model: Model, dtype: str, dt: float) -> int:
    """Return the memory that one more robot of a Simulator takes [B]."""
    Simulator(model, 8, dt, dtype)  # loads the kernel, whose memory is not the robots'
    sizes = []
    for num_envs in (1024, 2048):
        tracemalloc.start()
        sim = Simulator(model, num_envs, dt, dtype)
        sizes.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        del sim
    return round((sizes[1] - sizes[0]) / 1024)


def fast_settings(level: str, dt: float) -> Settings:
    """Return MuJoCo's settings for robots that it is not tuned for one by one: those Mini Cheetah stands with."""
    return Settings(dt, "Euler", "Newton", 4, 4, STIFF if level == "exact" else None)


def mujoco_batch(robot: Robot, level: str, num_envs: int, num_threads: int, dt: float) -> Batch:
    """Return MuJoCo's robots in their standing pose.

    Raises:
        RobotError: If MJCF cannot say what the robot is at this level.
        ValueError: If MuJoCo refuses it.
    """
    return Batch(compiled(robot, level, fast_settings(level, dt)), num_envs, num_threads)


def theirs(batch: Batch, robot: Robot) -> Competitor:
    """Return a rollout; one unit of work is one robot's step."""
    calls = AGAIN * max(1, 32 // batch.num_envs)
    moved = [robot.independent.index(name) for name in robot.driven]  # passive joints have no actuator
    targets = stand.targets(robot, batch.num_envs, TARGETS, seed=2)[..., moved]
    controls = [np.repeat(targets[:, i : i + 1], SUBSTEPS, axis=1) for i in range(TARGETS)]
    out, start, made = np.empty((batch.num_envs, SUBSTEPS, batch.states.shape[1])), batch.states.copy(), count()

    def run() -> None:
        for i in islice(made, calls):
            if i % AGAIN == 0:
                batch.states[:] = start
            batch.trajectory(controls[i % TARGETS], out)
            batch.states[:] = out[:, -1]

    return Competitor(run, batch.num_envs * SUBSTEPS * calls)


def quiet() -> None:
    """Keep MuJoCo from writing a log of robots that fall over."""
    mujoco.set_mju_user_warning(lambda _: None)
