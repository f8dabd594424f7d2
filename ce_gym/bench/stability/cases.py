"""Tests of stability that others trust, and our own, each with the figure that decides it.

MuJoCo: engine tests of free bodies, of a spinning body in contact, and of resting penetration. SimBenchmark: rolling,
momentum and energy of a free robot, a humanoid on stiff position control. Drake: a block on an incline, a mass on a
spring. Where they give a step, ours is five times as long.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ce_gym.bench.stability import scenes
from ce_gym.bench.stability.scenes import GRAVITY, simulator
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot, load_robot
from ce_gym.sim import Simulator


@dataclass(frozen=True)
class Case:
    """A test and its outcome.

    Attributes:
        source: Whose test it is.
        name: What is done.
        required: The bar.
        measured: The figure.
        met: Whether it is enough.
    """

    source: str
    name: str
    required: str
    measured: str
    met: bool


def free_tumble() -> Case:
    """A body spinning about its middle axis, and one spinning fast about another, 20 000 steps of 25 ms."""
    sim = simulator(scenes.free_body(), 0.025, 2)
    sim.set_state(sim.model.standing_q, [[0.05, 5.0, 0.05, 0.0, 0.0, 0.0], [20.0, 0.2, 0.3, 0.0, 0.0, 0.0]])
    start, highest = kinetic(sim), np.zeros(2)
    for _ in range(200):
        sim.step(np.zeros(0), 100)
        highest = np.maximum(highest, kinetic(sim) / start)
    worst = math.inf if sim.diverged.any() else float(highest.max())
    return Case(
        "MuJoCo",
        "free body, middle axis at 5 rad/s and 20 rad/s, 20 000 steps of 25 ms (theirs: 5 ms)",
        "kinetic energy <= 1.01 of the start",
        f"{worst:.6f}",
        worst <= 1.01,
    )


def free_conservation() -> Case:
    """A tumbling body for 5 s at 50 ms: energy falls, but not far, and its angular momentum stays."""
    sim = simulator(scenes.free_body(), 0.05)
    sim.set_state(sim.model.standing_q, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    moments = np.diag((0.02, 0.03, 0.04))

    def momentum() -> np.ndarray:
        return sim.model.body_poses(sim.q[0])[1][0] @ moments @ sim.v[0, :3]

    first, energies = momentum(), [kinetic(sim)[0]]
    for _ in range(100):
        sim.step(np.zeros(0))
        energies.append(kinetic(sim)[0])
    left = energies[-1] / energies[0]
    lost = float(np.linalg.norm(momentum() - first) / np.linalg.norm(first))
    rises = float(np.diff(energies).max() / energies[0])
    return Case(
        "MuJoCo",
        "free body for 5 s at 50 ms (theirs: 10 ms)",
        "energy never rises, > 0.7 left, momentum within 0.05",
        f"largest rise {max(rises, 0.0):.1e}, {left:.3f} left, momentum off by {lost:.3f}",
        rises <= 1e-12 and left > 0.7 and lost < 0.05,
    )


def spinning_egg() -> Case:
    """A long body dropped spinning at 30 rad/s on a slope of 15 degrees, 5000 steps of 10 ms."""
    sim = simulator(scenes.egg(math.radians(15)), 0.01)
    sim.set_state([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 30.0, 0.0, 0.0, 0.0])
    fastest = 0.0
    for _ in range(5000):
        sim.step(np.zeros(0))
        fastest = max(fastest, float(np.linalg.norm(sim.v[0, :3])))
    ratio = math.inf if sim.diverged.any() else fastest / 30.0
    return Case(
        "MuJoCo",
        "long body spinning at 30 rad/s on a 15 degree slope, 5000 steps of 10 ms (theirs: 2 ms)",
        "angular speed < 2 times the start",
        f"{ratio:.3f} times",
        ratio < 2.0,
    )


def rest_penetration() -> Case:
    """A block rests where its springs carry it."""
    sim = simulator(scenes.block(), 0.01)
    sim.step(np.zeros(0), 3000)
    depth = 0.05 - float(sim.q[0, 2])
    expected = 10.0 * GRAVITY / (4 * scenes.GROUND.stiffness)
    error = abs(depth / expected - 1)
    return Case(
        "MuJoCo", "depth of a resting block at 10 ms", "weight over stiffness within 1e-6", f"{error:.1e}", error < 1e-6
    )


def rolling() -> Case:
    """A ball that starts sliding at 1 m/s rolls at 5/7 of that, and then keeps its speed."""
    sim = simulator(scenes.ball(), 0.005)
    sim.set_state(
        sim.model.standing_q - [0, 0, GRAVITY / scenes.GROUND.stiffness, 0, 0, 0, 0], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    )
    sim.step(np.zeros(0), 200)
    speed = float(np.linalg.norm(velocity(sim)[:2]))
    sim.step(np.zeros(0), 2000)
    later = float(np.linalg.norm(velocity(sim)[:2]))
    spin = float(np.linalg.norm(sim.v[0, :3])) * 0.1
    good = abs(speed / (5 / 7) - 1) < 0.05 and later <= speed * (1 + 1e-6) and abs(spin / later - 1) < 0.01
    return Case(
        "SimBenchmark",
        "ball set sliding at 1 m/s, 11 s at 5 ms",
        "rolls at 5/7 m/s within 5 %, v = R w, no gain",
        f"{speed:.4f} m/s, {later:.4f} m/s 10 s later, R w / v = {spin / later:.6f}",
        good,
    )


def free_robot() -> Case:
    """A robot in free fall that spreads its legs: the momentum it gets is gravity's."""
    model = Model("mini_cheetah")
    sim = Simulator(model, 1, 0.005, contacts=(), outputs=())
    v = np.zeros(model.nv)
    v[:3] = 1.0, -2.0, 3.0
    sim.set_state(model.standing_q, v)
    before = momentum_of(model, sim)
    target = model.standing_q[7:] + 0.3
    sim.step(target, 200)
    gained = momentum_of(model, sim) - before
    expected = np.array([0.0, 0.0, -GRAVITY * model.total_mass])
    error = float(np.linalg.norm(gained - expected) / np.linalg.norm(expected))
    return Case(
        "SimBenchmark",
        "momentum of a quadruped in free fall for 1 s at 5 ms, legs moving",
        "weight times time within 2 %",
        f"{100 * error:.2f} %",
        error < 0.02,
    )


def stiff_humanoid() -> Case:
    """A humanoid on position control of 5e4 N m/rad at five times SimBenchmark's step."""
    robot = load_robot("jvrc1")
    gains = replace(
        robot.gains,
        kp=tuple((name, 5e4) for name, _ in robot.gains.kp),
        kd=tuple((name, 5e2) for name, _ in robot.gains.kd),
    )
    model = Model(replace(robot, gains=gains))
    sim = Simulator(model, 1, 0.0025, outputs=())
    for _ in range(20):
        sim.step(model.standing_q[7:], 400)
    speed = math.inf if sim.diverged.any() else rms(sim.v)
    height = float(sim.q[0, 2] / model.standing_q[2])
    return Case(
        "SimBenchmark",
        "humanoid with gains of 5e4 N m/rad, 20 s at 2.5 ms (theirs: 0.5 ms)",
        "stands, rms speed <= 1e-6",
        f"{speed:.1e}, height {height:.4f} of the pose",
        speed <= 1e-6 and height > 0.95,
    )


def breakaway() -> Case:
    """A block pulled with 1.2 times its friction from rest."""
    mu = scenes.GROUND.friction
    ratio = _slid(1.2 * mu * GRAVITY, 0.0, 0.1) / (0.5 * 0.2 * mu * GRAVITY * 0.1**2)
    return _distance("block pulled with 1.2 times its friction, way in 0.1 s at 4 ms", ratio)


def slide() -> Case:
    """A block set sliding at 1 m/s stops where friction has eaten its energy."""
    ratio = _slid(0.0, 1.0, 1.0) * 2 * scenes.GROUND.friction * GRAVITY
    return _distance("block set sliding at 1 m/s, way until it stops at 4 ms", ratio)


def _slid(pull: float, speed: float, time: float) -> float:
    """Return how far the sole of a block slides under a constant acceleration [m/s^2], from its rest depth [m]."""
    sim = simulator(scenes.block(pull=pull), 0.004)
    q, v = sim.model.standing_q.copy(), np.zeros(6)
    q[2] -= sim.model.total_mass * GRAVITY / 4 / scenes.GROUND.stiffness
    v[3] = speed
    sim.set_state(q, v)
    start = sim.model.contact_points(q, v)[0][:, 0].mean()
    sim.step(np.zeros(0), round(time / sim.dt))
    return float(sim.model.contact_points(sim.q[0], sim.v[0])[0][:, 0].mean() - start)


def _distance(name: str, ratio: float) -> Case:
    """Judge a way by its ratio to the analytic one."""
    return Case("Drake, ours", name, "analytic within 5 %", f"{ratio:.4f} of it", abs(ratio - 1) <= 0.05)


def incline() -> Case:
    """A block on a slope of 0.8 of what it can hold does not creep."""
    sim = simulator(scenes.block(tilt=math.atan(0.4)), 0.004)
    sim.step(np.zeros(0), 5000)
    before = sim.q[0, :2].copy()
    sim.step(np.zeros(0), 2500)
    creep = float(np.linalg.norm(sim.q[0, :2] - before)) / 10.0
    return Case(
        "Drake, ours",
        "block on a slope, 0.8 of the friction cone",
        "creep <= 1e-9 m/s",
        f"{creep:.1e} m/s",
        creep <= 1e-9,
    )


def mass_ratios() -> Case:
    """A double pendulum with a child of 1e-4 to 1e4 times its parent's mass swings on undamped joints."""
    robots = [scenes.chain(2, ratio) for ratio in (1e-4, 1e-2, 1.0, 1e2, 1e4)]
    return swinging("double pendulum, mass ratios 1e-4 to 1e4, undamped, 5 s at 1 ms", robots, 5.0)


def chains() -> Case:
    """Chains of 2 to 100 rods swing from horizontal on undamped joints."""
    robots = [scenes.chain(n) for n in (2, 5, 10, 30, 100)]
    return swinging("chains of 2 to 100 rods, undamped, 1 s at 1 ms", robots, 1.0)


def swinging(name: str, robots: list[Robot], time: float) -> Case:
    """Let mechanisms swing, by the default method and by the one for smooth motion, which has to keep the energy."""
    euler, extrapolated = (max(passive_gain(r, 0.001, time, m) for r in robots) for m in ("euler", "extrapolated"))
    return Case(
        "ours",
        name,
        "finite; extrapolated gains <= 1 % of the energy",
        f"extrapolated {100 * extrapolated:.3f} %, euler {100 * euler:.1f} %",
        math.isfinite(euler) and extrapolated <= 0.01,
    )


def gears() -> Case:
    """A pendulum behind gears of any ratio swings with the period that its reflected inertia gives it."""
    worst = 0.0
    for ratio in (1.0, 6.0, 30.0, 100.0, 300.0, -1.0, -30.0, -300.0):
        sim = simulator(scenes.geared_pendulum(ratio), 0.002, outputs=())
        inertia = 1e-3 + 0.25 + 1e-5 * ratio**2
        quarter = math.pi / 2 * math.sqrt(inertia / (GRAVITY * 0.5))
        sim.set_state([0.01], [0.0])
        sim.step([0.0], round(quarter / 0.002))
        phase = round(quarter / 0.002) * 0.002 / quarter * math.pi / 2
        worst = max(worst, abs(float(sim.q[0, 0]) / 0.01 - math.cos(phase)))
    return Case(
        "ours",
        "pendulum behind gears of 1 to 300 and -1 to -300, at a quarter of its period, 2 ms",
        "angle within 1 %",
        f"{100 * worst:.2f} %",
        worst < 0.01,
    )


def light_foot() -> Case:
    """A foot of a gram under 2 kg on ground of 1e6 N/m."""
    sim = simulator(scenes.leg_with_light_foot(1e-3), 0.005)
    sim.set_state([0.3, 0.0], [0.0, 0.0])
    for _ in range(600):
        sim.step([0.0, -200.0 * float(sim.q[0, 1]) - 20.0 * float(sim.v[0, 1])], 1)
    speed = math.inf if sim.diverged.any() else rms(sim.v)
    return Case(
        "ours", "foot of 1 g under 2 kg on 1e6 N/m, 3 s at 5 ms", "rms speed <= 1e-6", f"{speed:.1e}", speed <= 1e-6
    )


def turning_linkage() -> Case:
    """A four-bar linkage through a thousand turns of its crank."""
    robot = scenes.four_bar(0.1, 0.3, 0.3, 0.25, damping=0.02)
    sim = simulator(robot, 0.001, outputs=("loop_gap",))
    gap, steps = 0.0, 0
    while abs(sim.q[0, 0]) < 1000 * 2 * math.pi and not sim.diverged.any() and steps < 4000:
        sim.step([1.0], 100)
        gap, steps = max(gap, float(sim.loop_gap[0])), steps + 1
    turns = abs(float(sim.q[0, 0])) / (2 * math.pi)
    return Case(
        "ours",
        "four-bar linkage at 50 rad/s, 1 ms",
        "1000 turns, loop closed to 1e-10 m",
        f"{turns:.0f} turns, {gap:.1e} m",
        turns >= 1000 and gap <= 1e-10,
    )


def thin_linkage() -> Case:
    """A four-bar linkage whose transmission angle falls to two degrees, turning through that pose."""
    crank, coupler, rocker = 0.1, 0.3, 0.25
    ground = crank + math.sqrt(coupler**2 + rocker**2 - 2 * coupler * rocker * math.cos(math.radians(2)))
    sim = simulator(
        scenes.four_bar(crank, ground, coupler, rocker, damping=0.02), 0.001, outputs=("loop_gap", "energy")
    )
    sim.set_state([1.5], [5.0])
    gap, before = 0.0, float(sim.q[0, 0])
    for _ in range(2000):
        sim.step([0.1])
        gap = max(gap, float(sim.loop_gap[0]))
    turned = abs(float(sim.q[0, 0]) - before) / (2 * math.pi)
    return Case(
        "ours",
        "four-bar linkage through a transmission angle of 2 degrees, 1 ms",
        "turns through, loop closed to 1e-10 m",
        f"{turned:.1f} turns, {gap:.1e} m",
        not sim.diverged.any() and turned >= 1 and gap <= 1e-10,
    )


CASES: tuple[Callable[[], Case], ...] = (
    *(free_tumble, free_conservation, spinning_egg, rest_penetration, rolling, free_robot, stiff_humanoid),
    *(breakaway, slide, incline, mass_ratios, chains, gears, light_foot, turning_linkage, thin_linkage),
)


def passive_gain(robot: Robot, dt: float, time: float, method: str) -> float:
    """Return how far a mechanism let go from horizontal rises above its energy, as a share of what it can lose."""
    sim = simulator(robot, dt, method=method)
    n = len(robot.independent)
    q = np.zeros(n)
    q[: min(2, n)] = math.pi / 2
    sim.set_state(q, np.zeros(n))
    start = float(np.sum(sim.model.energy(q, np.zeros(n))))
    lowest = float(np.sum(sim.model.energy(np.zeros(n), np.zeros(n))))
    highest = -math.inf
    for _ in range(round(time / dt)):
        sim.step(np.zeros(n))
        highest = max(highest, float(sim.energy[0]))
    return math.inf if sim.diverged.any() else (highest - start) / (start - lowest)


def kinetic(sim: Simulator) -> np.ndarray:
    """Return kinetic energies [J], shape (num_envs,)."""
    return sim.model.energy(sim.q, sim.v)[0]


def momentum_of(model: Model, sim: Simulator) -> np.ndarray:
    """Return the linear momentum of the first robot in the world [kg m/s], shape (3,)."""
    R = model.body_poses(sim.q[0])[1][0]
    return R @ (model.mass_matrix(sim.q[0]) @ sim.v[0])[3:6]


def velocity(sim: Simulator) -> np.ndarray:
    """Return the velocity of the first base in the world [m/s], shape (3,)."""
    return sim.model.body_poses(sim.q[0])[1][0] @ sim.v[0, 3:6]


def rms(x: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(x, dtype=np.float64))))
