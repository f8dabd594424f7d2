"""Motors with limits of their own: torque, torque-speed line and friction act at rotors, whatever lies between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.dry_friction import STICK_SPEED
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Body, Inertial, Joint, LinearConstraint, Motor, Placement, Robot, load_robot
from ce_gym.model.mechanism import LEVELS

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

MOMENT = 1e-12
"""A step so short that what happens in it does not matter [s]."""
RATIO, LINK, ROTOR = 8.0, 0.02, 1e-4
"""Of the turntable: gear ratio, and moments of inertia of link and rotor [kg m^2]."""
WHOLE = LINK + RATIO**2 * ROTOR
"""What the turntable's joint feels [kg m^2]."""


def turntable(motor: Motor) -> Robot:
    """One geared joint on the world, without gravity or friction but the motor's."""

    def inertial(mass: float, moment: float) -> Inertial:
        return Inertial(mass, (0.0, 0.0, 0.0), tuple(map(tuple, np.diag([moment] * 3).tolist())))

    joint = Joint("revolute", (0.0, 0.0, 1.0))
    table = Body("table", "link", None, Placement(), joint, inertial(1.0, LINK))
    rotor = Body("rotor", "rotor", None, Placement(), joint, inertial(0.1, ROTOR))
    gear = LinearConstraint("gear", (("rotor", 1.0), ("table", -RATIO)))
    return Robot("turntable", (table, rotor), (gear,), ("table",), motors=(motor,), gravity=(0.0, 0.0, 0.0))


def stepper(model: Model, dt: float, outputs: tuple[str, ...] = (), **options):
    """Return a step from rows q, v, target to the named results."""
    function = step_function(model.mechanism, StepOptions(dt, **{"motors": "limited", **options}), outputs)
    guess = {"dependent": model.guess} if "dependent" in function.name_in() else {}

    def step(q, v, target) -> dict[str, np.ndarray]:
        if guess:
            guess["dependent"] = model.dependent_guess(q)
        results = function(q=q, v=v, diverged=0.0, target=target, **guess)
        return {name: value.full().ravel() for name, value in results.items()}

    return step


@lru_cache
def turntable_step(motor: Motor) -> Callable[..., dict[str, np.ndarray]]:
    return stepper(Model(turntable(motor)), MOMENT, ("torque",), control="torque")


def turntable_torque(motor: Motor, speed: float, asked: float) -> float:
    """Joint torque of the turntable at a joint speed [rad/s], for a torque asked at the joint [N m]."""
    return turntable_step(motor)([0.3], [speed], [asked])["torque"][0]


def test_torque_limit_is_the_rotor_s():
    motor = Motor("rotor", torque=1.5)
    assert turntable_torque(motor, 0.0, 100.0) == pytest.approx(1.5 * RATIO)
    assert turntable_torque(motor, 20.0, -100.0) == pytest.approx(-1.5 * RATIO)
    assert turntable_torque(motor, 20.0, 3.0) == pytest.approx(3.0)


@pytest.mark.parametrize("torque", [1.5, np.inf], ids=["current limit", "none"])
@pytest.mark.parametrize("stall", [None, 1.0, 4.0])
@pytest.mark.parametrize("asked", [100.0, 5.0, -100.0])
def test_torque_speed_line(torque: float, stall: float | None, asked: float):
    """As in textbooks: the voltage leaves `stall (1 - speed / velocity)`, the current `torque`, and nothing brakes."""
    velocity = 50.0
    motor = Motor("rotor", torque=torque, velocity=velocity, stall=stall)
    start = torque if stall is None else stall
    for speed in np.linspace(-70.0, 70.0, 8):  # of the rotor, standstill not among them
        towards = speed * np.sign(asked)
        with np.errstate(invalid="ignore"):
            line = start * (1 - towards / velocity) if np.isfinite(start) else np.inf
        most = max(0.0, min(torque, line))
        expected = np.sign(asked) * min(abs(asked) / RATIO, most) * RATIO
        assert turntable_torque(motor, speed / RATIO, asked) == pytest.approx(expected, abs=1e-6), speed


@pytest.mark.parametrize("speed", [-9.0, -0.01, 0.02, 5.0])
def test_friction_of_the_motor(speed: float):
    motor, damping, friction = Motor("rotor"), 0.003, 0.2
    lossy = replace(motor, damping=damping, friction=friction)
    rotor = RATIO * speed
    expected = RATIO * (damping * rotor + friction * np.sign(rotor))
    lost = turntable_torque(motor, speed, 2.0) - turntable_torque(lossy, speed, 2.0)
    assert lost == pytest.approx(expected, rel=1e-6)
    assert lost * speed > 0


@pytest.mark.parametrize("dt", [1e-4, 0.01, 0.1])
def test_a_motor_runs_up_to_its_no_load_speed_and_not_beyond(dt: float):
    """On its torque-speed line a motor is a linear damper, and a step is the implicit Euler step of an exponential."""
    stall, velocity = 2.0, 60.0
    step = stepper(Model(turntable(Motor("rotor", torque=stall, velocity=velocity))), dt, control="torque")
    q, v, speed, rate = [0.0], np.zeros(1), 0.0, RATIO**2 * stall / (velocity * WHOLE)
    for _ in range(50):
        result = step(q, v, [1e3])
        q, v = result["q_next"], result["v_next"]
        speed = (speed + dt * RATIO * stall / WHOLE) / (1 + dt * rate)
        assert v[0] == pytest.approx(speed, rel=1e-12)
    assert RATIO * v[0] <= velocity * (1 + 1e-12)
    if dt == 0.1:
        assert RATIO * v[0] == pytest.approx(velocity, rel=1e-6)


FRICTION = 0.1
"""Dry friction of the rotor in the tests below [N m]; ten times that of a small gearbox, as Mini Cheetah's would be."""


@pytest.fixture(scope="module", params=["rotor", "joint"])
def rubbing(request) -> dict[float, Callable[..., dict[str, np.ndarray]]]:
    """Steps of the turntable with the same dry friction at its rotor or at its joint, by their length."""
    robot = turntable(Motor("rotor", friction=FRICTION * (request.param == "rotor")))
    if request.param == "joint":
        table, rotor = robot.bodies
        table = replace(table, joint=replace(table.joint, friction=RATIO * FRICTION))
        robot = replace(robot, bodies=(table, rotor))
    model = Model(robot)
    return {dt: stepper(model, dt, control="torque") for dt in (0.0005, 0.002, 0.01)}


def coulomb(v: float, load: float, time: float) -> tuple[float, float]:
    """Angle and speed of a mass under a constant load with Coulomb friction, in closed form from event to event."""
    most, q = RATIO * FRICTION, 0.0
    if v != 0.0:
        rate = (load - np.sign(v) * most) / WHOLE
        stop = -v / rate if v * rate < 0 else np.inf
        if stop >= time:
            return q + v * time + rate * time**2 / 2, v + rate * time
        q, time = q + v * stop + rate * stop**2 / 2, time - stop
    rate = np.sign(load) * max(0.0, abs(load) - most) / WHOLE
    return q + rate * time**2 / 2, rate * time


@pytest.mark.parametrize("dt", [0.0005, 0.002, 0.01])
@pytest.mark.parametrize("load", [0.3, 0.99, 1.01, 2.0, -5.0])
@pytest.mark.parametrize("v", [0.0, 2.0, -0.3])
def test_dry_friction_follows_coulombs_law(rubbing, dt: float, load: float, v: float):
    """From rest, from speed and through reversals, against the closed form: within 2 % of the friction impulse.

    The step in which the speed reverses may take friction for one direction or for the other, a part of one step.
    """
    q, speed, n = np.zeros(1), np.array([v]), round(0.1 / dt)
    for _ in range(n):
        result = rubbing[dt](q, speed, [load * RATIO * FRICTION])
        q, speed = result["q_next"], result["v_next"]
    _, expected = coulomb(v, load * RATIO * FRICTION, n * dt)
    taken = RATIO * FRICTION / WHOLE * n * dt
    reversal = 2 * taken / n if v * load < 0 else 0.0
    assert speed[0] == pytest.approx(expected, abs=0.02 * taken + reversal)
    if abs(load) < 1 and expected == 0:
        assert abs(speed[0]) <= STICK_SPEED


@pytest.mark.parametrize("dt", [0.0005, 0.01])
def test_dry_friction_holds_without_a_nanometre(rubbing, dt: float):
    """A load of 0.99 of the dry friction moves nothing, however long; a load of 1.01 moves the joint."""
    for load, moves in ((0.99, False), (-0.99, False), (1.01, True)):
        q, v = np.array([0.3]), np.zeros(1)
        for _ in range(300):
            result = rubbing[dt](q, v, [load * RATIO * FRICTION])
            q, v = result["q_next"], result["v_next"]
        assert (q[0] != 0.3) == moves


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.001, 0.01])
def test_what_a_knee_loses_from_rest(friction: float):
    """A light rotor accelerates within a step: its dry friction is still limited to the friction torque."""
    model = Model(lossy(load_robot("mini_cheetah"), friction=friction, velocity=np.inf))
    step = step_function(model.mechanism, StepOptions(None, control="torque", motors="limited"), ("torque",))
    knee = 2
    ratio = np.abs(model.actuator_matrix(model.standing_q)[..., 6 + knee]).max()
    asked = np.zeros(12)
    asked[knee] = 10.0
    for dt in (0.0005, 0.005, 0.01):
        result = step(q=model.standing_q, v=np.zeros(model.nv), diverged=0.0, target=asked, dt=dt)
        assert float(result["torque"][knee]) == pytest.approx(10.0 - ratio * friction, abs=0.02 * ratio * friction)


@pytest.mark.parametrize("joint", [1, 3])
def test_dry_friction_through_belts(joint: int):
    """Motors that share joints rub each by itself: what arrives at the joints is `W^T (tau_m - friction)`."""
    robot = lossy(load_robot("mit_humanoid_leg"), velocity=np.inf, friction=0.05)
    model = Model(robot)
    step = stepper(model, 0.001, ("torque", "motor_speed"), control="torque")
    W = model.actuator_matrix(model.standing_q)
    asked = np.zeros(len(model.joint_links))
    asked[joint] = 20.0
    result = step(model.standing_q, np.zeros(model.nv), asked)
    speed = result["motor_speed"]
    slips = np.abs(speed) > 2 * STICK_SPEED
    assert slips.any()
    lost = np.linalg.solve(W.T, asked - result["torque"])
    np.testing.assert_allclose(lost[slips], 0.05 * np.sign(speed[slips]), rtol=1e-6)
    assert (np.abs(lost[~slips]) <= 0.05 * (1 + 1e-6)).all()


def states(model: Model, count: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    q = np.tile(model.standing_q, (count, 1))
    q[:, 7 * model.robot.floating :] += rng.uniform(-0.15, 0.15, (count, len(model.joint_links)))
    return q, rng.normal(0, 3.0, (count, model.nv))


def lossy(robot: Robot, **changes) -> Robot:
    return replace(robot, motors=tuple(replace(motor, **changes) for motor in robot.motors))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mini_cheetah", "mit_humanoid_leg", "tello"])
def test_saturation_acts_at_the_motors(name: str):
    """Joint torques are shared out to the motors, clipped there, and carried back: `W^T clip(W^-T tau)`.

    With belts or a differential the clipped motors change the torque of a joint whose own was not too large; in loops
    `W` changes with the pose. The transmission level has no say in it.
    """
    models = [Model(lossy(load_robot(name), velocity=np.inf), level) for level in LEVELS]
    exact, first = models[0], 6 * models[0].robot.floating
    limits = np.array([motor.torque for motor in exact.robot.motors])
    steps = [stepper(model, MOMENT, ("torque",), control="torque") for model in models]
    q, v = states(exact)
    rng, clipped, ways = np.random.default_rng(1), 0, []
    for q_i, v_i, W in zip(q, v, exact.actuator_matrix(q)[..., first:], strict=True):
        asked = W.T @ (rng.uniform(-2, 2, len(limits)) * limits)
        wanted = np.linalg.solve(W.T, asked)
        clipped += (np.abs(wanted) > limits).sum()
        expected = W.T @ np.clip(wanted, -limits, limits)
        ways.append(W)
        for step in steps:
            np.testing.assert_allclose(step(q_i, v_i, asked)["torque"], expected, rtol=1e-6, atol=1e-5)
    assert clipped >= 5
    belts = name != "mini_cheetah"
    assert (np.abs(ways[0]).astype(bool).sum() > len(limits)) == belts, "some motor turns more than one joint"
    assert (np.ptp(ways, axis=0).max() > 1e-3) == (name == "tello"), "only the ways of loops vary"


@pytest.mark.parametrize("name", ["mit_humanoid", "tello"])
def test_power_balance(name: str):
    """The power of the joints is the power of the windings less the losses of the motors' friction."""
    robot = lossy(load_robot(name), damping=2e-4, friction=0.05)
    model = Model(robot)
    step = stepper(model, MOMENT, ("torque", "power", "motor_speed"), control="torque")
    for q, v in zip(*states(model), strict=True):
        W = model.actuator_matrix(q)[:, 6:]
        speed = W @ v[6:]
        asked = W.T @ np.random.default_rng(2).uniform(-9, 9, len(speed))
        winding = np.linalg.solve(W.T, asked)
        for motor, i in zip(robot.motors, range(len(speed)), strict=True):
            line = motor.torque * (1 + np.array([-1, 1]) * speed[i] / motor.velocity)
            high, low = (max(0.0, min(motor.torque, x)) for x in line)
            winding[i] = np.clip(winding[i], -low, high)
        loss = 2e-4 * speed**2 + 0.05 * np.abs(speed)
        result = step(q, v, asked)
        np.testing.assert_allclose(result["motor_speed"], speed, rtol=1e-4, atol=1e-4)
        assert result["power"].sum() == pytest.approx((winding * speed - loss).sum(), rel=1e-4)
        np.testing.assert_allclose(result["power"], result["torque"] * result["v_next"][6:], rtol=1e-12)


@pytest.mark.parametrize("level", LEVELS)
def test_stiff_gains_are_stable_at_a_coarse_step(level: str):
    """Gains that an explicit controller could not hold at 10 ms, through belts and motors with friction."""
    robot, kp, kd = lossy(load_robot("mit_humanoid_leg"), damping=1e-3), 5e3, 50.0
    names = robot.independent
    gains = replace(robot.gains, kp=tuple((n, kp) for n in names), kd=tuple((n, kd) for n in names))
    model, dt = Model(replace(robot, gains=gains), level), 0.01
    assert (dt * kd / np.diag(model.mass_matrix(model.standing_q))).max() > 4, "twice what an explicit step can take"
    step = stepper(model, dt, ("torque",))
    q, v, target = np.array(model.standing_q), np.zeros(model.nv), model.standing_q + 0.002
    for _ in range(300):
        result = step(q, v, target)
        q, v = result["q_next"], result["v_next"]
        assert np.abs(v).max() < 2.0
    assert np.abs(v).max() < 1e-6
    np.testing.assert_allclose(result["torque"], kp * (target - q), atol=1e-3)


def test_limited_motors_without_a_line_are_ideal_where_every_motor_has_its_joint():
    """Single gears: rotor limit times ratio is the joint's limit, so that both ways of saying it agree."""
    model = Model(lossy(load_robot("mini_cheetah"), velocity=np.inf))
    limited, ideal = (
        stepper(model, 0.005, ("torque", "power"), motors=motors, contacts=model.contact_names[:0])
        for motors in ("limited", "ideal")
    )
    q, v = states(model, 20)
    targets, saturated = q[:, 7:] + np.random.default_rng(3).normal(0, 1.0, (20, 12)), 0
    for row in zip(q, v, targets, strict=True):
        ours, theirs = limited(*row), ideal(*row)
        for name, value in theirs.items():
            np.testing.assert_allclose(ours[name], value, rtol=1e-10, atol=1e-10, err_msg=name)
        saturated += (np.abs(theirs["torque"]) > 17.9).sum()
    assert saturated > 10


def test_joints_without_motors_keep_their_own_limits():
    robot = turntable(Motor("rotor", torque=1.5))
    table = replace(robot.bodies[0], joint=replace(robot.bodies[0].joint, torque=5.0))
    bare = Model(replace(robot, bodies=(table, robot.bodies[1]), motors=()))
    step = stepper(bare, MOMENT, ("torque",), control="torque")
    assert step([0.0], [0.0], [100.0])["torque"][0] == pytest.approx(5.0)
