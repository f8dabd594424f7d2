"""Time of a sub-step of every robot, compared with MuJoCo on one core, with the same contacts and targets.

ce_gym runs at level `exact` in double precision. It computes contacts of the feet always, and all other contacts only
near the ground, as MuJoCo does for all contacts. MuJoCo has the solver Newton 4/4 and is timed at two levels: `exact`,
with rotors as bodies and gears as equalities, and the simplest level in MJCF, which most users choose.
"""

from __future__ import annotations

import argparse
import time

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.measure.timing import Competitor, interleaved, ratio
from ce_gym.bench.speed import competitors
from ce_gym.dynamics.model import Model
from ce_gym.envs.custom import missing
from ce_gym.model import Robot, RobotError, load_robot, robots

REQUIRED = 40.0
"""Required ratio of times at level `exact`, MuJoCo to ce_gym."""
SIMPLEST = ("armature", "coupled")
NUM_ENVS, MUJOCO_ENVS = 1024, 32
COLUMNS = ("robot", "contacts", "ours [us]", "MuJoCo exact [us]", "ratio", "MuJoCo simplest [us]", "level", "ratio ")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robots", nargs="+", default=[], help="names or paths; without, all that tasks can have")
    parser.add_argument("--rounds", type=int, default=15, help="how often each side is timed")
    parser.add_argument("--dt", type=float, default=0.005, help="sub-step [s]")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    competitors.silence_mujoco()
    report, rows = Report("beside"), []
    for name in arguments.robots or [name for name in robots() if not missing(load_robot(name))]:
        rows.append(_row(load_robot(name), arguments, report))
    report.tables.append(Table("A sub-step of one robot, one core, double precision", COLUMNS, tuple(rows)))
    report.remarks.append(f"CPU time of one thread, sides in turn, best of {arguments.rounds} rounds.")
    return report


def _row(robot: Robot, arguments: argparse.Namespace, report: Report) -> tuple[Cell, ...]:
    sides: dict[str, Competitor] = {
        "ours": competitors.sub_steps(Model(robot), "float64", NUM_ENVS, 1, arguments.dt),
    }
    for level in ("exact", *SIMPLEST):
        if level == SIMPLEST[1] and SIMPLEST[0] in sides:
            continue
        try:
            batch = competitors.mujoco_batch(robot, level, MUJOCO_ENVS, 1, arguments.dt)
            sides[level] = competitors.mujoco_steps(batch, robot)
        except (RobotError, ValueError) as error:
            report.remarks.append(f"MuJoCo, {robot.name} {level}: {error}")
    timings = interleaved(sides, arguments.rounds, time.thread_time)
    best = {name: 1e6 * timing.best for name, timing in timings.items()}
    times = {name: ratio(timing, timings["ours"]).cautious for name, timing in timings.items()}
    simplest = next((level for level in SIMPLEST if level in best), None)
    if "exact" in times:
        claim = f"{robot.name}: MuJoCo / ours, exact, at least {REQUIRED:.0f}"
        report.requirements.append(Requirement(claim, f"{times['exact']:.1f}", times["exact"] >= REQUIRED))
    last = (best[simplest], simplest, times[simplest]) if simplest else (None, None, None)
    return (robot.name, len(robot.contacts), best["ours"], best.get("exact"), times.get("exact"), *last)
