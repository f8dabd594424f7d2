# pyright: reportAttributeAccessIssue=false
"""Time of derivatives, compared with steps, MuJoCo's finite differences and Pinocchio's derivatives, on one core.

Robots fly or stand on their feet. A window of sub-steps is simulated, and the backward pass repeats its iterations.
MuJoCo differentiates with `mjd_transitionFD`, with the fastest settings with which the robot stands. All competitors
run alternately.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import mujoco
import numpy as np

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.measure.timing import Competitor, Timing, interleaved, ratio
from ce_gym.bench.peers import mujoco_settings, stand
from ce_gym.bench.speed import competitors
from ce_gym.console import progress
from ce_gym.dynamics.model import Model
from ce_gym.export.mujoco_batch import STATE, Batch
from ce_gym.model import Robot, load_robot
from ce_gym.model.errors import RobotError
from ce_gym.sim.derivatives import StepDerivatives
from ce_gym.sim.simulator import Simulator

LEVELS, SCENES = ("exact", "armature"), ("in flight", "standing")
WINDOW = 32
"""Sub-steps of a backward pass."""
HIGH = 1.0
"""Height of flying robots above the standing height [m]."""
PARAMETERS = ("kp", "kd", "motor_strength", "rotor_inertia", "ratio", "stiffness", "damping", "friction")
"""Parameters with respect to which steps are also differentiated."""
MUJOCO_STATES = 8
DIFFERENCE = 1e-6
"""Step of MuJoCo's forward differences, which are twice as fast as central differences."""
LINEARIZE = {"in flight": 13.0, "standing": 25.0}
LARGEST = {"backward": 3.0, "parameters": 1.3}
LEAST_OVER_MUJOCO = 80.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path of a robot with feet")
    parser.add_argument("--dt", type=float, default=0.005, help="sub-step [s]")
    parser.add_argument("--num-envs", type=int, default=256, help="robots in our batch")
    parser.add_argument("--rounds", type=int, default=9, help="how often each side is timed")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    competitors.silence_mujoco()
    report, robot = Report("derivatives"), stand.bare(load_robot(arguments.robot), "foot")
    sides: dict[str, Competitor] = {}
    for level in progress(LEVELS, "set up"):
        sides |= _ours(Model(robot, level), arguments)
    sides |= _mujoco(robot, LEVELS[1], arguments.dt)
    _steps(sides, interleaved(sides, arguments.rounds, time.thread_time), report)
    _dynamics(robot, arguments, report)
    report.remarks.append(
        f"ce_gym: {arguments.num_envs} robots a call, float64, Python calls and records included; `backward` makes "
        f"iterations again; parameters are {', '.join(PARAMETERS)}. MuJoCo: forward differences, from a Python loop."
    )
    return report


def _ours(model: Model, arguments: argparse.Namespace) -> dict[str, Competitor]:
    """Return steps and their linearisation; at level `exact` also the backward pass."""
    sides: dict[str, Competitor] = {}
    for scene in SCENES:
        where = f"{model.transmission}, {scene}"
        for what, parameters in (("", ()), (" with parameters", PARAMETERS)):
            if parameters and model.transmission != LEVELS[0]:
                continue
            sim, target = _standing(model, arguments, parameters)
            if scene == SCENES[0]:
                sim.set_state(sim.q + HIGH * (np.arange(model.nq) == 2), sim.v)
            derivatives = StepDerivatives(sim)
            sides[f"step{what}, {where}"] = Competitor(_stepping(derivatives, target), WINDOW * sim.num_envs)
            if model.transmission == LEVELS[0]:
                sides[f"backward{what}, {where}"] = Competitor(_back(derivatives, target), WINDOW * sim.num_envs)
            if not parameters:
                linearize = partial(derivatives.linearize, target)
                sides[f"linearize, {where}"] = Competitor(linearize, sim.num_envs)
    return sides


def _standing(model: Model, arguments: argparse.Namespace, parameters: tuple[str, ...]) -> tuple[Simulator, np.ndarray]:
    """Return robots after a time of standing with jittering targets, and the last targets."""
    sim = Simulator(model, arguments.num_envs, arguments.dt, parameters=parameters, outputs=())
    jitter = stand.targets(model.robot, sim.num_envs, round(stand.SETTLE / stand.HOLD), seed=1)
    for i in range(jitter.shape[1]):
        sim.step(jitter[:, i], round(stand.HOLD / arguments.dt))
    return sim, np.ascontiguousarray(jitter[:, -1])


def _stepping(derivatives: StepDerivatives, target: np.ndarray) -> Callable[[], object]:
    """Return a function that steps robots from their current state."""
    start = derivatives.state()

    def step() -> None:
        derivatives.restore(start)
        derivatives.simulator.step(target, WINDOW)

    return step


def _back(derivatives: StepDerivatives, target: np.ndarray) -> Callable[[], object]:
    """Return a function for the backward pass through the same steps."""
    sim, rng = derivatives.simulator, np.random.default_rng(0)
    weights = {name: rng.normal(size=(sim.num_envs, sim.model.nv)) for name in ("q", "v")}
    derivatives.step(target, WINDOW)
    return partial(derivatives.backward, weights, derivatives.take())


def _mujoco(robot: Robot, level: str, dt: float) -> dict[str, Competitor]:
    """Return steps and finite differences of robots that stand, and of robots in the air."""
    settings, batch, _ = mujoco_settings.fastest(robot, level, dt)
    sides: dict[str, Competitor] = {}
    for scene in SCENES:
        states = batch.states[:MUJOCO_STATES].copy()
        states[:, 3] += HIGH * (scene == SCENES[0])  # time, x, y, z
        name = f"{level}, {scene}"
        step, differentiate = _mujoco_calls(batch, states, stand.targets(robot, MUJOCO_STATES, 1, seed=2)[:, 0])
        sides[f"mj_step, {name} ({settings})"] = Competitor(step, MUJOCO_STATES)
        sides[f"mjd_transitionFD, {name}"] = Competitor(differentiate, MUJOCO_STATES)
    return sides


def _mujoco_calls(
    batch: Batch, states: np.ndarray, targets: np.ndarray
) -> tuple[Callable[[], object], Callable[[], object]]:
    model, datas = batch.model, [mujoco.MjData(batch.model) for _ in states]
    A, B = np.zeros((2 * model.nv, 2 * model.nv)), np.zeros((2 * model.nv, model.nu))

    def put() -> None:
        for data, state, target in zip(datas, states, targets, strict=True):
            mujoco.mj_setState(model, data, state, STATE)
            data.ctrl[:] = target

    def step() -> None:
        put()
        for data in datas:
            mujoco.mj_step(model, data)

    def differentiate() -> None:
        put()
        for data in datas:
            mujoco.mjd_transitionFD(model, data, DIFFERENCE, False, A, B, None, None)

    return step, differentiate


def _steps(sides: dict[str, Competitor], timings: dict[str, Timing], report: Report) -> None:
    """Add times of steps and their derivatives, and the requirements, to the report."""
    rows: list[tuple[Cell, ...]] = []
    mujoco_steps = {name.split(" (")[0]: name for name in sides if name.startswith("mj_step")}
    for name, timing in timings.items():
        what, where = name.split(" (")[0].split(", ", 1)
        own = mujoco_steps[f"mj_step, {where}"] if what.startswith("mj") else f"step, {where}"
        compared = ratio(timing, timings[own])
        settings = name.split(" (")[1][:-1] if " (" in name else ""
        rows.append((what, *where.split(", "), 1e6 * timing.best, compared.of_best, compared.median, settings))
    columns = ("what", "level", "scene", "best [us]", "times a step", "by rounds", "settings")
    report.tables.append(Table("Steps and their derivatives, for one robot and sub-step", columns, tuple(rows)))
    for scene in SCENES:
        here = f"exact, {scene}"
        for claim, slow, fast, most in (
            ("linearize / step", "linearize", "step", LINEARIZE[scene]),
            ("backward / step", "backward", "step", LARGEST["backward"]),
            ("backward with parameters / without", "backward with parameters", "backward", LARGEST["parameters"]),
        ):
            found = ratio(timings[f"{slow}, {here}"], timings[f"{fast}, {here}"])
            claim = f"{claim}, {here}, at most {most:g}"
            report.requirements.append(Requirement(claim, str(found), max(found.of_best, found.median) <= most))
        here = f"armature, {scene}"
        found = ratio(timings[f"mjd_transitionFD, {here}"], timings[f"linearize, {here}"])
        claim = f"mjd_transitionFD / linearize, {here}, at least {LEAST_OVER_MUJOCO:g}"
        report.requirements.append(Requirement(claim, str(found), found.cautious >= LEAST_OVER_MUJOCO))


def _dynamics(robot: Robot, arguments: argparse.Namespace, report: Report) -> None:
    """Add times of forward dynamics and its derivatives by q, v and tau, compared with Pinocchio, to the report."""
    n = 64
    model = Model(robot, "armature")
    given = [competitors.random_states(model, n)[name] for name in ("q", "v", "tau")]
    sides = {
        "forward dynamics, compiled": competitors.forward_dynamics(robot, "armature", n),
        "derivatives, compiled": competitors.forward_dynamics(robot, "armature", n, derivatives=True),
        "Model.forward_dynamics_derivatives": Competitor(lambda: model.forward_dynamics_derivatives(*given), n),
    }
    try:
        sides |= competitors.pinocchio_peer(robot)
    except RobotError as error:
        report.remarks.append(f"Pinocchio: {error}")
    timings = interleaved(sides, arguments.rounds, time.thread_time)
    first = timings["derivatives, compiled"]
    rows = [(name, 1e6 * timing.best, ratio(timing, first).median) for name, timing in timings.items()]
    title = f"Forward dynamics and its derivatives, {robot.name} armature, double precision"
    report.tables.append(Table(title, ("side", "best [us]", "times ours, compiled"), tuple(rows)))
