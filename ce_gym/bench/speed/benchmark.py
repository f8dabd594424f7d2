"""Time of one robot's sub-step, compared with MuJoCo's fastest settings and with the peak of the processor.

Both simulators have the same contact spheres, jittered position targets and gains, and run alternately. MuJoCo has the
fastest settings with which the robot stands as with 1 ms steps and a converged solver.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.measure.timing import Competitor, Timing, interleaved, ratio
from ce_gym.bench.peers import mujoco_settings, stand
from ce_gym.bench.speed import competitors
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot, load_robot
from ce_gym.sim import Simulator

IN_DEPTH = ("armature", "exact")
"""Transmission levels."""
DTYPES = ("float64", "float32")
REQUIRED = {"armature": 30.0, "exact": 55.0}
"""Required ratio of times, MuJoCo to ce_gym, both in double precision."""
LEAST_GAIN = 1.7
"""Required ratio of times, double to single precision, at level `exact`."""
LEAST_SHARE = 40.0
"""Required fraction of the processor's peak for the exact sub-step in both precisions [%]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path")
    parser.add_argument("--contacts", choices=("foot", "all"), default="foot", help="which contact spheres take part")
    parser.add_argument("--dt", type=float, default=0.005, help="sub-step [s]")
    parser.add_argument("--num-envs", type=int, default=1024, help="robots in our batch")
    parser.add_argument("--rounds", type=int, default=9, help="how often each side is timed")
    parser.add_argument("--quick", action="store_true", help="three rounds")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    if arguments.quick:
        arguments.rounds = 3
    competitors.silence_mujoco()
    report = Report("speed")
    _compare(stand.bare(load_robot(arguments.robot), arguments.contacts), arguments, report)
    report.remarks.append(
        "CPU time of one thread. MuJoCo: mujoco.rollout, no visual geoms, dense Jacobian, pyramidal cones, islands "
        "off, no sensors, energy or callbacks, and the fastest of the settings tried with which it stands. ce_gym: "
        "Simulator.step, Python call and copy of targets included."
    )
    return report


def _compare(robot: Robot, arguments: argparse.Namespace, report: Report) -> None:
    """Add the comparison of a robot's sub-step with MuJoCo and with the processor's peak to the report."""
    sides = [_our_side(robot, level, dtype, arguments) for level in IN_DEPTH for dtype in DTYPES]
    sides += [_mujoco_side(robot, level, arguments.dt) for level in IN_DEPTH]
    peaks = {f"peak {dtype}": competitors.peak(dtype) for dtype in DTYPES}
    timings = interleaved({s.name: s.competitor for s in sides} | peaks, arguments.rounds, clock=time.thread_time)
    report.tables.append(_step_table(robot, sides, timings))
    for level in IN_DEPTH:
        compared = ratio(timings[f"MuJoCo {level}"], timings[f"ce_gym {level} float64"])
        claim = f"MuJoCo / ce_gym, {level}, float64, at least {REQUIRED[level]:.0f}"
        report.requirements.append(Requirement(claim, str(compared), compared.cautious >= REQUIRED[level]))
    gain = ratio(timings["ce_gym exact float64"], timings["ce_gym exact float32"])
    claim = f"float64 / float32, exact, at least {LEAST_GAIN}"
    report.requirements.append(Requirement(claim, str(gain), gain.cautious >= LEAST_GAIN))
    rows: list[tuple[Cell, ...]] = []
    for dtype in DTYPES:
        work = competitors.operations(Model(robot, transmission="exact"), dtype, arguments.dt)
        step, most = timings[f"ce_gym exact {dtype}"], timings[f"peak {dtype}"]
        share = 100.0 * work * ratio(most, step).median
        rows.append((dtype, 1e-9 / most.best, work, 1e-9 * work / step.best, share))
        claim = f"exact sub-step, {dtype}, at least {LEAST_SHARE:.0f} % of the peak of multiply-adds"
        report.requirements.append(Requirement(claim, f"{share:.1f} %", share >= LEAST_SHARE))
    columns = ("dtype", "peak [GFLOP/s]", "FLOP/sub-step", "sub-step [GFLOP/s]", "% of peak, by rounds")
    report.tables.append(Table(f"Operations per second of one core, {robot.name} exact", columns, tuple(rows)))


@dataclass(frozen=True)
class Side:
    """One competitor with its settings and the behaviour of its robots."""

    name: str
    settings: str
    timestep: float
    behaviour: stand.Behaviour
    competitor: Competitor


def _our_side(robot: Robot, level: str, dtype: str, arguments: argparse.Namespace) -> Side:
    model = Model(robot, transmission=level)
    sim = Simulator(model, num_envs=arguments.num_envs, dt=arguments.dt, dtype=dtype, num_threads=1, contacts="all")
    behaviour = stand.watch_ours(sim, robot)
    n = round(stand.HOLD / arguments.dt)
    jitter = np.ascontiguousarray(stand.targets(robot, arguments.num_envs, 10, seed=2).swapaxes(0, 1))

    def stand_on() -> None:
        for target in jitter:
            sim.step(target, n_substeps=n)

    work = Competitor(stand_on, arguments.num_envs * len(jitter) * n)
    return Side(f"ce_gym {level} {dtype}", f"batch {arguments.num_envs}", arguments.dt, behaviour, work)


def _mujoco_side(robot: Robot, level: str, timestep: float) -> Side:
    settings, batch, behaviour = mujoco_settings.fastest(robot, level, timestep)
    n_steps = round(stand.HOLD / settings.timestep)
    control = np.repeat(stand.targets(robot, batch.num_envs, 10, seed=2), n_steps, axis=1)
    out = np.empty((*control.shape[:2], batch.states.shape[1]))
    work = Competitor(lambda: batch.trajectory(control, out), control.shape[0] * control.shape[1])
    return Side(f"MuJoCo {level}", str(settings), settings.timestep, behaviour, work)


def _step_table(robot: Robot, sides: list[Side], timings: dict[str, Timing]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for side in sides:
        timing, b = timings[side.name], side.behaviour
        figures = (1e6 * timing.best, 1e6 * timing.median, 1.0 / timing.best)
        rows.append((side.name, 1e3 * side.timestep, *figures, b.contacts, b.height, b.speed, b.slip, side.settings))
    columns = ("side", "dt [ms]", "best [us]", "median [us]", "steps/s", "contacts", "height", "rms speed")
    title = f"Sub-step of {robot.name}, standing on {len(robot.contacts)} contact spheres, jittered targets, one core"
    return Table(title, (*columns, "gear slip [rad]", "settings"), tuple(rows))
