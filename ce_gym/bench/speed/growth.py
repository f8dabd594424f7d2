"""Time of a step as the number of joints, contacts or robots grows; compile time and memory.

Chains of links with geared rotors have 2 to 200 joints; MuJoCo's `mj_forward` and Pinocchio's `aba` run them with
armature. A plate stands on an increasing number of spheres, also in MuJoCo. Competitors of a row run alternately. Times
are processor times of the calling thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Collection

import numpy as np

from ce_gym.bench.chains import link_and_rotor_chain
from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.measure.timing import interleaved
from ce_gym.bench.peers import stand
from ce_gym.bench.speed import competitors
from ce_gym.console import progress
from ce_gym.dynamics.model import Model
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Pose, Robot, load_robot
from ce_gym.model.mechanism import LEVELS

JOINTS = (2, 5, 10, 20, 50, 100, 200)
CONTACTS = (0, 1, 4, 16, 36, 64)
ROBOTS = (1, 8, 64, 512, 4096, 32_768, 262_144, 1_048_576)
LEAST_R2 = 0.99
"""Required coefficient of determination of a straight line through instructions, or times, by joints."""
PLATE_MASS = 10.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path of the robot of batches")
    parser.add_argument("--joints", type=int, nargs="*", default=JOINTS, help="lengths of the chain")
    parser.add_argument("--contacts", type=int, nargs="*", default=CONTACTS, help="spheres under the plate")
    parser.add_argument("--robots", type=int, nargs="*", default=ROBOTS, help="sizes of batches")
    parser.add_argument("--dt", type=float, default=0.005, help="sub-step [s]")
    parser.add_argument("--rounds", type=int, default=7, help="how often each is timed")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    competitors.silence_mujoco()
    report = Report("growth")
    if arguments.joints:
        joints(arguments.joints, arguments.rounds, report)
    if arguments.contacts:
        report.tables.append(contacts(arguments.contacts, arguments.dt, arguments.rounds))
    if arguments.robots:
        robot = stand.bare(load_robot(arguments.robot), "foot")
        report.tables.append(crowd(robot, arguments.robots, arguments.dt, arguments.rounds))
    return report


def joints(lengths: Collection[int], rounds: int, report: Report) -> None:
    """Add instructions at each level, times compared with peers, and compile times of growing chains to the report."""
    rows: list[tuple[Cell, ...]] = []
    for n in progress(lengths, "joints"):
        robot = link_and_rotor_chain(1, n)
        counts = [Model(robot, transmission=level).n_instructions("forward_dynamics") for level in LEVELS]
        start = time.perf_counter()
        sides = {"ours": competitors.forward_dynamics(robot, "exact", 256)}
        compiled = time.perf_counter() - start
        sides |= {"MuJoCo": competitors.mujoco_forward(robot, "armature"), **competitors.pinocchio_peer(robot)}
        timings = interleaved(sides, rounds, time.thread_time)
        names = ("ours", "MuJoCo", "Pinocchio aba")
        times = [1e6 * timings[name].best if name in timings else None for name in names]
        rows.append((n, *counts, *times, compiled))
    columns = ("joints", *(f"{level} [instructions]" for level in LEVELS))
    columns += ("exact [us]", "MuJoCo armature [us]", "Pinocchio aba [us]", "trace and compile, or load [s]")
    report.tables.append(Table("Forward dynamics of a chain against its joints", columns, tuple(rows)))
    for column, what in enumerate((*LEVELS, "exact, time"), start=1):
        measured = straightness([row[0] for row in rows], [row[column] for row in rows])
        claim = f"linear in the joints, {what}: r^2 at least {LEAST_R2}"
        report.requirements.append(Requirement(claim, f"{measured:.5f}", measured >= LEAST_R2))


def contacts(numbers: Collection[int], dt: float, rounds: int) -> Table:
    """Return times of a sub-step, compared with MuJoCo, by the number of spheres under a plate."""
    rows: list[tuple[Cell, ...]] = []
    for n in progress(numbers, "contacts"):
        robot = plate(n)
        sides = {"ours": competitors.sub_steps(Model(robot), "float64", 256, 1, dt)}
        sides["MuJoCo"] = competitors.mujoco_steps(competitors.mujoco_batch(robot, "none", 32, 1, dt), robot)
        timings = interleaved(sides, rounds, time.thread_time)
        ours, theirs = (1e6 * timings[name].best for name in sides)
        rows.append((n, ours, theirs, theirs / ours))
    columns = ("spheres", "ours [us]", "MuJoCo [us]", "ratio")
    return Table("Sub-step of a plate against the spheres that it stands on, one core", columns, tuple(rows))


def crowd(robot: Robot, sizes: Collection[int], dt: float, rounds: int) -> Table:
    """Return the time of one robot's sub-step on one core, and memory, by batch size."""
    model = Model(robot)
    rows: list[tuple[Cell, ...]] = []
    each = {dtype: competitors.bytes_per_robot(model, dtype, dt) for dtype in ("float64", "float32")}
    for size in progress(sizes, "robots"):
        sides = {dtype: competitors.sub_steps(model, dtype, size, 1, dt) for dtype in each}
        timings = interleaved(sides, min(rounds, 3) if size > 1 << 16 else rounds, time.thread_time)
        row = [cell for d in each for cell in (1e6 * timings[d].best, 2.0**-20 * each[d] * size)]
        rows.append((size, *row))
    columns = ("robots", "float64 [us]", "float64 [MiB]", "float32 [us]", "float32 [MiB]")
    return Table(f"One robot's sub-step against the batch, {robot.name} exact, one core", columns, tuple(rows))


def plate(n: int) -> Robot:
    """Return a square plate of 1 m on a floating base with `n` spheres under it, in rows, with equal loads."""
    side = max(1, int(np.ceil(np.sqrt(n))))
    at = np.linspace(-0.5, 0.5, side) if side > 1 else np.zeros(1)
    places = [(float(x), float(y), 0.0) for x in at for y in at][:n]
    moment = PLATE_MASS / 12.0
    inertia = ((moment, 0.0, 0.0), (0.0, moment, 0.0), (0.0, 0.0, 2.0 * moment))
    body = Body("plate", "link", None, Placement(), Joint("free"), Inertial(PLATE_MASS, (0.0, 0.0, 0.0), inertia))
    spheres = tuple(ContactSphere(f"sphere_{i}", "plate", place, 0.02) for i, place in enumerate(places))
    material = ContactMaterial(5e4 / max(n, 1), 300.0 / max(n, 1), 0.5)
    return Robot(f"plate_{n}", (body,), contacts=spheres, material=material, pose=Pose(0.02))


def straightness(x: list[Cell], y: list[Cell]) -> float:
    """Return the coefficient of determination r^2 of a straight line y(x)."""
    return float(np.corrcoef(np.array(x, float), np.array(y, float))[0, 1] ** 2)
