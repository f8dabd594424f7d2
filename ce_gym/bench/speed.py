"""Time of a sub-step with contacts and of forward dynamics on one core, against MuJoCo's rollout of the same robot.

Both sides stand on the same contact spheres, hold the same jittered position targets with the same gains, and are
timed in turn. MuJoCo gets the fastest settings with which it still stands as it does at 1 ms with a converged solver.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from dataclasses import dataclass

import numpy as np

from ce_gym.bench import forward, mujoco_settings, stand
from ce_gym.bench.report import Cell, Report, Requirement, Table
from ce_gym.bench.timing import Competitor, Timing, interleaved, ratio
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot, load_robot
from ce_gym.sim import Simulator

LEVELS = ("armature", "exact")
DTYPES = ("float64", "float32")
REQUIRED = {"armature": 25.0, "exact": 45.0}
"""How many times as long as ours MuJoCo's sub-step has to take, both in double precision."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path")
    parser.add_argument("--contacts", choices=("foot", "all"), default="foot", help="which contact spheres take part")
    parser.add_argument("--dt", type=float, default=0.005, help="sub-step [s]")
    parser.add_argument("--num-envs", type=int, default=1024, help="robots in our batch")
    parser.add_argument("--rounds", type=int, default=9, help="how often each side is timed")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    robot = bare(load_robot(arguments.robot), arguments.contacts)
    report = Report("speed")
    sides = [_our_side(robot, level, dtype, arguments) for level in LEVELS for dtype in DTYPES]
    sides += [_mujoco_side(robot, level, arguments.dt) for level in LEVELS]
    timings = interleaved({side.name: side.competitor for side in sides}, arguments.rounds, clock=time.thread_time)
    report.tables.append(_step_table(robot, sides, timings))
    for level in LEVELS:
        ours, theirs = timings[f"ce_gym {level} float64"], timings[f"MuJoCo {level}"]
        compared = ratio(theirs, ours)
        claim = f"MuJoCo / ce_gym, {level}, float64, at least {REQUIRED[level]:.0f}"
        report.requirements.append(Requirement(claim, str(compared), compared.cautious >= REQUIRED[level]))
    report.tables.append(_forward_dynamics_table(robot, arguments))
    report.remarks.append(
        "One thread; processor time of that thread. MuJoCo: mujoco.rollout, no visual geoms, dense Jacobian, pyramidal "
        "cones, islands off, no sensors, energy or callbacks; the fastest of the settings tried with which it stands. "
        "ce_gym: Simulator.step, Python call and copy of targets included."
    )
    return report


def bare(robot: Robot, contacts: str) -> Robot:
    """Return the robot with one group of contacts ("all" keeps every one), and without visual shapes."""
    kept = tuple(contact for contact in robot.contacts if contacts in ("all", contact.group))
    bodies = tuple(dataclasses.replace(body, shapes=()) for body in robot.bodies)
    return dataclasses.replace(robot, contacts=kept, bodies=bodies)


@dataclass(frozen=True)
class Side:
    """One competitor, how it is set up and how its robots stand."""

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


def _forward_dynamics_table(robot: Robot, arguments: argparse.Namespace) -> Table:
    timings = interleaved(
        forward.competitors(robot, LEVELS, DTYPES, arguments.num_envs), arguments.rounds, time.thread_time
    )
    rows = tuple((name, 1e6 * t.best, 1e6 * t.median) for name, t in timings.items())
    return Table("Forward dynamics, no contact, one core", ("side", "best [us]", "median [us]"), rows)
