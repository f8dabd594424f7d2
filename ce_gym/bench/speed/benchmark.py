"""Time of forward dynamics and of a sub-step, of every robot and level, one core and all, against MuJoCo and Pinocchio.

First one robot in depth: both sides stand on the same contact spheres, hold the same jittered position targets with the
same gains, and are timed in turn; MuJoCo gets the fastest settings with which it still stands as it does at 1 ms with a
converged solver. Then all robots, operations per second against the machine's peak, memory, and batches of all sizes.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.measure.timing import Competitor, Timing, interleaved, ratio
from ce_gym.bench.peers import mujoco_settings, stand
from ce_gym.bench.speed import batch as speed_batch
from ce_gym.bench.speed import peak, stepping
from ce_gym.bench.speed import robots as speed_robots
from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot, load_robot, robots
from ce_gym.model.mechanism import LEVELS
from ce_gym.sim import Simulator

IN_DEPTH = ("armature", "exact")
"""Levels of the comparison in depth."""
DTYPES = ("float64", "float32")
BATCHES = (1, 8, 64, 512, 4096, 65536)
REQUIRED = {"armature": 30.0, "exact": 55.0}
"""How many times as long as ours MuJoCo's sub-step has to take, both in double precision."""
LEAST_GAIN = 1.7
"""How many times as fast single precision has to be, exact."""
LEAST_SHARE = 40.0
"""Least share of the machine's peak that the exact sub-step has to reach, in either precision [%]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path of the robot measured in depth")
    parser.add_argument("--robots", nargs="*", default=robots(), help="names or paths of the robots in the tables")
    parser.add_argument("--levels", nargs="+", default=LEVELS, choices=LEVELS, help="levels in the tables")
    parser.add_argument("--contacts", choices=("foot", "all"), default="foot", help="which contact spheres take part")
    parser.add_argument("--dt", type=float, default=0.005, help="sub-step [s]")
    parser.add_argument("--num-envs", type=int, default=1024, help="robots in our batch")
    parser.add_argument("--batches", type=int, nargs="*", default=BATCHES, help="sizes of batches to compare")
    parser.add_argument("--rounds", type=int, default=9, help="how often each side is timed")
    parser.add_argument("--out", type=Path, default=Path("speed"), help="folder for picture, CSV and Markdown")
    parser.add_argument("--quick", action="store_true", help="one robot, two levels, small batches, three rounds")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    if arguments.quick:
        arguments.robots, arguments.levels = [arguments.robot], IN_DEPTH
        arguments.batches, arguments.rounds = [n for n in arguments.batches if n <= 512], 3
    stepping.quiet()
    arguments.out.mkdir(parents=True, exist_ok=True)
    report = Report("speed")
    robot = bare(load_robot(arguments.robot), arguments.contacts)
    _in_depth(robot, arguments, report)
    many = [bare(load_robot(name), arguments.contacts) for name in arguments.robots]
    _all_robots(many, arguments, report)
    if arguments.batches:
        table = speed_batch.measure(robot, arguments.batches, arguments.dt, min(arguments.rounds, 5))
        report.tables.append(table)
        table.write_csv(arguments.out / "batch.csv")
        speed_batch.draw(table, arguments.out)
    markdown = "\n\n".join(table.as_markdown() for table in report.tables)
    (arguments.out / "speed.md").write_text(markdown + "\n", encoding="utf-8")
    report.remarks.append(
        "Time on one core is CPU time of one thread, on all cores elapsed time. MuJoCo: mujoco.rollout, no "
        "visual geoms, dense Jacobian, pyramidal cones, islands off, no sensors, energy or callbacks; in the first "
        "table the fastest of the settings tried with which it stands, in the others Euler with Newton 4/4, whether it "
        "stands or not. ce_gym: Simulator.step, Python call and copy of targets included. Pinocchio: called from a "
        "Python loop; what the call itself takes is in the table, as forward dynamics of a single joint."
    )
    report.remarks.append(f"Written to {arguments.out}: speed.md and CSV; of the batches also batch.png.")
    return report


def _in_depth(robot: Robot, arguments: argparse.Namespace, report: Report) -> None:
    """Compare one robot's sub-step with MuJoCo at its best, and with the machine's peak."""
    sides = [_our_side(robot, level, dtype, arguments) for level in IN_DEPTH for dtype in DTYPES]
    sides += [_mujoco_side(robot, level, arguments.dt) for level in IN_DEPTH]
    peaks = {f"peak {dtype}": peak.competitor(dtype) for dtype in DTYPES}
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
        work = stepping.operations(Model(robot, transmission="exact"), dtype, arguments.dt)
        step, most = timings[f"ce_gym exact {dtype}"], timings[f"peak {dtype}"]
        share = 100.0 * work * ratio(most, step).median
        rows.append((dtype, 1e-9 / most.best, work, 1e-9 * work / step.best, share))
        claim = f"exact sub-step, {dtype}, at least {LEAST_SHARE:.0f} % of the peak of multiply-adds"
        report.requirements.append(Requirement(claim, f"{share:.1f} %", share >= LEAST_SHARE))
    columns = ("dtype", "peak [GFLOP/s]", "FLOP/sub-step", "sub-step [GFLOP/s]", "% of peak, by rounds")
    report.tables.append(Table(f"Operations per second of one core, {robot.name} exact", columns, tuple(rows)))


def _all_robots(many: list[Robot], arguments: argparse.Namespace, report: Report) -> None:
    """Measure every robot at every level."""
    if not many:
        return
    one, cores = {d: peak.competitor(d) for d in DTYPES}, usable_cores()
    most = {d: 1.0 / t.best for d, t in interleaved(one, arguments.rounds, time.thread_time).items()}
    every = {d: peak.competitor(d, cores) for d in DTYPES}
    together = {d: 1.0 / t.best for d, t in interleaved(every, arguments.rounds).items()}
    results = [
        speed_robots.measure(robot, level, arguments.num_envs, arguments.dt, arguments.rounds)
        for robot in many
        for level in arguments.levels
    ]
    times = speed_robots.time_table(results)
    work = speed_robots.work_table(results, most)
    dynamics, skipped = speed_robots.dynamics_table(many, arguments.num_envs, arguments.rounds)
    report.tables += [times, work, dynamics]
    for name, table in (("robots", times), ("work", work), ("forward_dynamics", dynamics)):
        table.write_csv(arguments.out / f"{name}.csv")
    peaks = ", ".join(f"{d} {1e-9 * most[d]:.0f} on one core, {1e-9 * together[d]:.0f} on {cores}" for d in DTYPES)
    report.remarks.append(f"Peak of multiply-adds [GFLOP/s]: {peaks}.")
    skipped = list(dict.fromkeys([reason for m in results for reason in m.skipped] + skipped))
    if skipped:
        report.remarks.append("\n".join(["Skipped:", *(f"  {reason}" for reason in skipped)]))


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
