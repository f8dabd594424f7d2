"""Forward dynamics and sub-step of every robot and level, one core and all, beside MuJoCo and Pinocchio.

Whoever is compared is timed in turn, robot by robot.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from ce_gym.bench.measure.report import Cell, Table
from ce_gym.bench.measure.timing import Competitor, Timing, interleaved, ratio
from ce_gym.bench.speed import forward, stepping
from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot
from ce_gym.model.errors import RobotError

DTYPES = ("float64", "float32")
MUJOCO_ENVS = 32


@dataclass
class Measured:
    """What was measured of one robot at one level.

    Attributes:
        robot: Its name.
        level: Transmission level.
        timings: By (side, what, threads): "forward" or "step"; threads 0 stands for all cores.
        operations: Floating-point operations of a sub-step, in double precision.
        bytes_per_robot: Memory of one more robot, by dtype [B].
        mujoco_bytes: Size of MuJoCo's physics state [B].
        skipped: Why a peer is missing.
    """

    robot: str
    level: str
    timings: dict[tuple[str, str, int], Timing]
    operations: int
    bytes_per_robot: dict[str, int]
    mujoco_bytes: int | None = None
    skipped: list[str] = field(default_factory=list)

    def microseconds(self, side: str, what: str, threads: int) -> float | None:
        """Return the best round [us]; None if it was not measured."""
        timing = self.timings.get((side, what, threads))
        return None if timing is None else 1e6 * timing.best


def measure(robot: Robot, level: str, num_envs: int, dt: float, rounds: int) -> Measured:
    """Time one robot at one level."""
    model, cores = Model(robot, transmission=level), usable_cores()
    competitors: dict[tuple[str, str, int], Competitor] = {}
    for dtype in DTYPES:
        for threads, n in ((1, 1), (0, cores)):
            competitors[dtype, "forward", threads] = forward.ours(robot, level, dtype, num_envs, n)
            competitors[dtype, "step", threads] = stepping.ours(model, dtype, num_envs, n, dt)
    measured = Measured(
        robot.name,
        level,
        {},
        stepping.operations(model, "float64", dt),
        {dtype: stepping.bytes_per_robot(model, dtype, dt) for dtype in DTYPES},
    )
    try:
        for threads, n in ((1, 1), (0, cores)):
            batch = stepping.mujoco_batch(robot, level, MUJOCO_ENVS * n, n, dt)
            competitors["mujoco", "step", threads] = stepping.theirs(batch, robot)
            measured.mujoco_bytes = 8 * batch.states.shape[1]
    except (RobotError, ValueError) as error:
        measured.skipped.append(f"MuJoCo, {robot.name} {level}: {error}")
    for one_core in (True, False):  # time of the thread where there is one, elapsed time where there are several
        chosen = {repr(key): c for key, c in competitors.items() if (key[2] == 1) == one_core}
        timings = interleaved(chosen, rounds, time.thread_time if one_core else time.perf_counter)
        measured.timings |= {key: timings[repr(key)] for key in competitors if repr(key) in timings}
    return measured


def time_table(results: Sequence[Measured]) -> Table:
    """Return times of all robots."""
    what = [(dtype, name, threads) for dtype in DTYPES for name in ("forward", "step") for threads in (1, 0)]
    rows: list[tuple[Cell, ...]] = []
    for m in results:
        peers = [m.microseconds("mujoco", "step", threads) for threads in (1, 0)]
        compared = None
        if peers[0] is not None:
            compared = ratio(m.timings["mujoco", "step", 1], m.timings["float64", "step", 1]).cautious
        rows.append((m.robot, m.level, *[m.microseconds(*key) for key in what], *peers, compared))
    short = {"float64": "f64", "float32": "f32", "forward": "FD", "step": "step"}
    names = [f"{short[d]} {short[n]}{'' if threads else ' all'}" for d, n, threads in what]
    columns = ("robot", "level", *names, "MuJoCo step", "MuJoCo step all", "MuJoCo / ours")
    title = "Microseconds for one robot: forward dynamics (FD) and sub-step, one core and all cores (all)"
    return Table(title, columns, tuple(rows))


def work_table(results: Sequence[Measured], peak: dict[str, float]) -> Table:
    """Return operations per second and memory; `peak` is the machine's by dtype, one core [operations/s]."""
    rows: list[tuple[Cell, ...]] = []
    for m in results:
        rates = {d: m.operations / m.timings[d, "step", 1].best for d in DTYPES}
        shares = [x for d in DTYPES for x in (1e-9 * rates[d], 100 * rates[d] / peak[d])]
        memory = [m.bytes_per_robot[d] for d in DTYPES]
        rows.append((m.robot, m.level, m.operations, *shares, *memory, m.mujoco_bytes))
    rates = [f"{d} [{unit}]" for d in ("f64", "f32") for unit in ("GFLOP/s", "% of peak")]
    columns = ("robot", "level", "FLOP/sub-step", *rates, "f64 [B/robot]", "f32 [B/robot]", "MuJoCo state [B]")
    return Table("Sub-step on one core: operations per second, and memory", columns, tuple(rows))


def dynamics_table(robots: Sequence[Robot], num_envs: int, rounds: int) -> tuple[Table, list[str]]:
    """Return forward dynamics beside MuJoCo's and Pinocchio's, and why some are missing."""
    rows: list[tuple[Cell, ...]] = []
    skipped: list[str] = []
    for robot in robots:
        competitors = {f"ours, {level}": forward.ours(robot, level, "float64", num_envs) for level in PAIR}
        for level in PAIR:
            try:
                competitors[f"MuJoCo mj_forward, {level}"] = forward.mujoco_forward(robot, level)
            except (RobotError, ValueError) as error:
                skipped.append(f"MuJoCo, {robot.name} {level}: {error}")
        peers, reason = _pinocchio(robot)
        competitors |= peers
        skipped += reason
        timings = interleaved(competitors, rounds, time.thread_time)
        for name, timing in timings.items():
            mine = timings["ours, exact" if name.endswith("exact") else "ours, armature"]
            compared = None if name.startswith("ours") else ratio(timing, mine).cautious
            rows.append((robot.name, name, 1e6 * timing.best, compared))
    title = "Forward dynamics in double precision on one core, no contact"
    return Table(title, ("robot", "side", "best [us]", "times ours"), tuple(rows)), skipped


PAIR = ("exact", "armature")
"""What a peer simulates with rotors as bodies, and without."""


def _pinocchio(robot: Robot) -> tuple[dict[str, Competitor], list[str]]:
    try:
        from ce_gym.bench.peers import pinocchio as pinocchio_peer
    except ImportError:
        return {}, ["Pinocchio: not installed (pip install pin)"]
    try:
        found = pinocchio_peer.competitors(pinocchio_peer.load(robot))
    except RobotError as error:
        return {}, [f"Pinocchio, {error}"]
    found["(call of a single joint)"] = pinocchio_peer.overhead()
    return {f"Pinocchio {name}": competitor for name, competitor in found.items()}, []
