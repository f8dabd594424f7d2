"""Friction of drives under load and near rest: M1 to M6 as published, and in closed form.

The authors of the models publish figures of a servo (Dynamixel MX-106), torques and speeds at its
output: github.com/Rhoban/bam, bam/params/mx106 at 1b5a1ce. Here they are taken through a gear to a rotor.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from elastic_robots import differential

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.motors import most_friction
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import (
    Body,
    DriveFriction,
    Elasticity,
    Inertial,
    Joint,
    LinearConstraint,
    Motor,
    Placement,
    Robot,
    load_robot,
)

FIGURES = ("Kc", "Kv", "Kcs", "speed", "alpha", "Km", "Ke", "Kms", "Kes", "Kmq", "Keq", "armature")
"""As the paper names them, of M6; the other models are M6 with some of them 0."""
SERVO = {
    "m1": (0.103520, 0.0352024, 0, 1.0, 1.0, 0, 0, 0, 0, 0, 0, 0.0266092),
    "m2": (2.76856e-6, 0.0595894, 0.117421, 1.84878, 1.74139, 0, 0, 0, 0, 0, 0, 0.0268388),
    "m3": (0.113353, 0.0119445, 0, 1.0, 1.0, 0.108240, 0.108240, 0, 0, 0, 0, 0.0248469),
    "m4": (0, 0.0509608, 0.104911, 1.62329, 1.32349, 0.00915033, 0.00915033, 0.222359, 0.222359, 0, 0, 0.0245740),
    "m5": (0, 0.0506649, 0.122427, 1.74571, 1.13831, 0.207637, 0.0226844, 0.195193, 0.0849016, 0, 0, 0.0260182),
    "m6": (1.023e-5, 0.0507157, 0.121954, 1.74633, 1.14283, 0.19801, 0.022216, 0.1986, 0.0871, 0.01, 7e-5, 0.026),
}  # fmt: skip
SHARP = (0.05, 0.01, 0.1, 0.5, 2.0, 0.1, 0.2, 0.15, 0.05, 0.3, 0.2, 0.02)
"""All of M6 at once, far from what any servo has."""
RATIO = 20.0
LEVELS = ("exact", "coupled", "armature", "none")
MASS, LENGTH, GRAVITY = 0.7, 0.2, 9.81


def published(figures: np.ndarray, motor: np.ndarray, other: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """The largest dry friction by the published formula of M6 [N m], viscous friction left out."""
    Kc, _, Kcs, scale, alpha, Km, Ke, Kms, Kes, Kmq, Keq, _ = figures
    s = np.exp(-(np.abs(speed / scale) ** alpha))
    Q = np.where(np.abs(motor) > np.abs(other), Keq * other**2, Kmq * motor**2) * (np.sign(motor) != np.sign(other))
    Q = Q * (np.abs(motor) != np.abs(other))
    return Kc + np.abs(Km * motor - Ke * other) + s * (Kcs + np.abs(Kms * motor - Kes * other) + Q)


def at_rotor(figures: tuple[float, ...], ratio: float) -> Motor:
    """A motor with published figures behind a gear."""
    f = dict(zip(FIGURES, figures, strict=True))
    drive = DriveFriction(
        f["Kcs"] / ratio, ratio * f["speed"], f["alpha"], f["Km"], f["Ke"], f["Kms"], f["Kes"],
        ratio * f["Kmq"], ratio * f["Keq"],
    )  # fmt: skip
    return Motor("rotor", friction=f["Kc"] / ratio, damping=f["Kv"] / ratio**2, drive_friction=drive)


def geared(joint: Joint, inertial: Inertial, motor: Motor, spin: float) -> Robot:
    """A joint on the world whose rotor has a moment of inertia about the world's y axis, and no gravity of its own."""
    moment = ((spin, 0.0, 0.0), (0.0, spin, 0.0), (0.0, 0.0, spin))
    turned = Joint("revolute", (0.0, 1.0, 0.0))
    bodies = (
        Body("link", "link", None, Placement(), joint, inertial),
        Body("rotor", "rotor", None, Placement(), turned, Inertial(0.1, (0.0, 0.0, 0.0), moment)),
    )
    gear = LinearConstraint("gear", (("rotor", 1.0), ("link", -RATIO)))
    return Robot("geared", bodies, (gear,), ("link",), motors=(motor,), gravity=(0.0, 0.0, -GRAVITY))


def pendulum(motor: Motor, armature: float) -> Robot:
    """A mass on a rod without mass that hangs down at 0, and a motor behind a gear."""
    still = ((1e-12, 0.0, 0.0), (0.0, 1e-12, 0.0), (0.0, 0.0, 1e-12))
    inertial = Inertial(MASS, (0.0, 0.0, -LENGTH), still)
    return geared(Joint("revolute", (0.0, 1.0, 0.0)), inertial, motor, armature / RATIO**2)


def hoist(motor: Motor) -> Robot:
    """A weight that a motor lifts: a constant load."""
    solid = ((1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 1e-3))
    return geared(Joint("prismatic", (0.0, 0.0, 1.0)), Inertial(MASS, (0.0, 0.0, 0.0), solid), motor, 1e-5)


class Stepper:
    """A robot under torques at its joint, interpreted."""

    def __init__(self, robot: Robot, level: str = "exact") -> None:
        self.model = Model(robot, level)
        self.function = step_function(self.model.mechanism, StepOptions(control="torque", motors="limited"))
        self.reset(0.0, 0.0)

    def reset(self, q: float, v: float) -> None:
        carried = {"motor_load": ca.DM.zeros(3)} if "motor_load" in self.function.name_in() else {}
        self.state = {"q": ca.DM(q), "v": ca.DM(v), **carried}

    def step(self, torque: float, dt: float) -> None:
        after = self.function(**self.state, diverged=0, target=torque, dt=dt)
        self.state = {name: after[f"{name}_next"] for name in self.state}

    @property
    def q(self) -> float:
        return float(self.state["q"])

    @property
    def v(self) -> float:
        return float(self.state["v"])


@pytest.mark.parametrize("figures", [*SERVO.values(), SHARP], ids=[*SERVO, "sharp"])
def test_the_formula_is_the_published_one(figures: tuple[float, ...]):
    """At the rotor behind a gear, against the formula at the output."""
    at = np.array([-3.0, -1.0, -0.2, 0.0, 0.2, 1.0, 2.0])
    motor, other, speed = (x.ravel() for x in np.meshgrid(at, at, np.array([-5.0, -0.3, 0.0, 1e-3, 1.0, 20.0])))
    drive = at_rotor(figures, RATIO)
    m, e, w = ca.SX.sym("m"), ca.SX.sym("e"), ca.SX.sym("w")
    function = ca.Function("most", [m, e, w], [most_friction(drive.friction, drive.drive_friction, w, (m, e))])
    ours = RATIO * function.map(len(motor))(motor / RATIO, other / RATIO, RATIO * speed).full()[0]
    np.testing.assert_allclose(ours, published(np.array(figures), motor, other, speed), rtol=1e-12, atol=1e-15)


def commanded(t: float) -> float:
    """Torque that lifts the pendulum, lets it back and throws it to the other side [N m]."""
    return 1.6 * np.sin(6.0 * t) + 0.5 * np.sin(17.0 * t)


@lru_cache(maxsize=1)
def reference(duration: float = 1.0, dt: float = 1e-5) -> np.ndarray:
    """Angles every 10 ms by the authors' scheme, all models at once: what would stop it, up to what friction has."""
    figures = np.array([*SERVO.values(), SHARP]).T
    inertia = MASS * LENGTH**2 + figures[-1]
    q, v = np.full(figures.shape[1], 0.3), np.zeros(figures.shape[1])
    angles = []
    for i in range(round(duration / dt)):
        motor, other = np.full_like(q, commanded(i * dt)), -MASS * GRAVITY * LENGTH * np.sin(q)
        most = published(figures, motor, other, v) + figures[1] * np.abs(v)
        stopping = inertia * v / dt + motor + other
        v = v + dt / inertia * (motor + other - np.sign(stopping) * np.minimum(np.abs(stopping), most))
        q = q + dt * v
        if (i + 1) % round(0.01 / dt) == 0:
            angles.append(q)
    return np.array(angles)


def errors(name: str, steps: tuple[float, ...]) -> list[float]:
    """Largest error of the angle over a second in units of its range, with steps of several lengths [s]."""
    figures = (SERVO | {"sharp": SHARP})[name]
    stepper, found = Stepper(pendulum(at_rotor(figures, RATIO), figures[-1])), []
    expected = reference()[:, [*SERVO, "sharp"].index(name)]
    for dt in steps:
        stepper.reset(0.3, 0.0)
        angles = []
        for i in range(round(1.0 / dt)):
            stepper.step(commanded(i * dt), dt)
            if (i + 1) % round(0.01 / dt) == 0:
                angles.append(stepper.q)
        found.append(np.abs(np.array(angles) - expected).max() / np.ptp(expected))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SERVO, "sharp"])
def test_a_servo_moves_as_its_authors_models_say(name: str):
    """M1 to M6 with a servo's figures against the authors' scheme in steps of 10 us; errors go down with the step."""
    longest, coarse, fine = errors(name, (1e-2, 5e-3, 1e-3))
    assert coarse < 0.01
    assert fine < min(1e-3, 0.4 * longest)


def held(figures: tuple[float, ...], driving: bool) -> tuple[float, float]:
    """Load at the joint [N m] that a motor's torque of 1 N m is about to lift, or is about to be driven back by."""
    Kc, _, Kcs, _, _, Km, Ke, Kms, Kes, *_ = figures
    motor, other = Km + Kms, Ke + Kes
    way = 1 if driving else -1
    return (1 - way * motor) / (1 + way * other), way * (Kc + Kcs) / (1 + way * other)


@pytest.mark.parametrize("dt", [0.001, 0.01])
@pytest.mark.parametrize("driving", [True, False])
def test_it_holds_at_99_percent_of_what_breaks_it_away(driving: bool, dt: float):
    """A weight lies still at 0.99 of what friction has, to the bit, and moves at 1.01; up where the motor lifts it."""
    figures = (*SHARP[:9], 0, 0, SHARP[11])
    share, constant = held(figures, driving)
    load = MASS * GRAVITY
    balance, stepper = load, Stepper(hoist(at_rotor(figures, RATIO)))
    critical = (load + constant) / share  # of the motor, for this load
    for part, moves in ((0.99, False), (1.01, True)):
        torque = balance + part * (critical - balance)
        stepper.reset(0.0, 0.0)
        for _ in range(200):
            stepper.step(torque, dt)
        assert (stepper.q != 0.0) == moves
        assert np.sign(stepper.q) == (0 if not moves else 1 if driving else -1)
        assert (abs(stepper.v) > 1e-4) == moves


@pytest.mark.parametrize("driving", [True, False])
def test_efficiency_is_what_comes_out_over_what_goes_in(driving: bool):
    """A weight at a steady speed: its power over the motor's, or the other way round where it drives the motor."""
    drive = DriveFriction(efficiency=0.8, backdriving_efficiency=0.5)
    stepper, load, damping = Stepper(hoist(Motor("rotor", damping=0.01, drive_friction=drive))), MASS * GRAVITY, 4.0
    torque = 1.2 * load / 0.8 if driving else 0.3 * load
    for _ in range(400):
        stepper.step(torque, 0.01)
    winding = torque - damping * stepper.v
    assert abs(stepper.v) > 0.1
    assert (load / winding if driving else winding / load) == pytest.approx(0.8 if driving else 0.5, rel=1e-6)


def test_it_comes_to_rest_as_stribeck_has_it():
    """Time and angle until a wheel has stopped by itself, against quadrature of `J dv / f(v)`."""
    figures = (0.05, 0.0, 0.2, 1.5, 2.0, 0, 0, 0, 0, 0, 0, 0.02)
    motor = at_rotor(figures, RATIO)
    robot = replace(pendulum(motor, figures[-1]), gravity=(0.0, 0.0, 0.0))
    inertia = MASS * LENGTH**2 + figures[-1]
    v = np.linspace(0.0, 6.0, 20_001)
    slowing = inertia / published(np.array(figures), 0.0 * v, 0.0 * v, v)
    time, angle = np.trapezoid(slowing, v), np.trapezoid(v * slowing, v)
    stepper, dt, n = Stepper(robot), 5e-4, 0
    stepper.reset(0.0, 6.0)
    while abs(stepper.v) > 1e-3:
        stepper.step(0.0, dt)
        n += 1
    assert n * dt == pytest.approx(time, rel=2e-3)
    assert stepper.q == pytest.approx(angle, rel=2e-3)
    stopped = stepper.q
    stepper.step(0.0, dt)
    assert stepper.q == stopped


def test_all_levels_and_a_stretching_transmission_carry_the_same_load():
    """A weight that hangs still on its friction: the load on the rotor, with and without a spring between."""
    motor = Motor("rotor", friction=0.5, drive_friction=DriveFriction(load_motor=0.1, load_external=0.1))
    robot = replace(hoist(motor), elastic=(Elasticity("rotor", stiffness=50.0, damping=0.01),))
    for level in (*LEVELS, "elastic"):
        model = Model(robot, level)
        function = step_function(model.mechanism, StepOptions(control="torque", motors="limited"))
        state = {"q": ca.DM.zeros(model.nq), "v": ca.DM.zeros(model.nv), "motor_load": ca.DM.zeros(3)}
        for _ in range(400):
            after = function(**state, diverged=0, target=2.0, dt=0.005)
            state = {name: after[f"{name}_next"] for name in state}
        expected = [2.0 / RATIO, -MASS * GRAVITY / RATIO]
        np.testing.assert_allclose(state["motor_load"].full().ravel()[:2], expected, rtol=1e-6, err_msg=level)


def test_a_factor_on_it_is_a_parameter():
    """At 0 it is the Coulomb part alone, at 2 what twice the figures are."""
    motor = at_rotor(SHARP, RATIO)
    assert motor.drive_friction is not None
    twice = replace(motor, drive_friction=replace(motor.drive_friction, factor=2.0))
    names = StepOptions(control="torque", motors="limited", parameters=("drive_friction",))
    given = {"q": 0.4, "v": 1.5, "diverged": 0, "target": 1.0, "dt": 1e-3}
    loaded = given | {"motor_load": [0.05, -0.03, 1.0]}
    function = step_function(Model(pendulum(motor, 0.02)).mechanism, names)
    for factor, other in ((0.0, replace(motor, drive_friction=None)), (2.0, twice)):
        stepper = Stepper(pendulum(other, 0.02)).function
        expected = stepper(**(loaded if "motor_load" in stepper.name_in() else given))["v_next"]
        found = function(**loaded, parameters=factor)["v_next"]
        assert float(found) == pytest.approx(float(expected), rel=1e-12)
    assert float(function(**loaded, parameters=1.0)["v_next"]) != pytest.approx(float(found), rel=1e-6)


@pytest.mark.parametrize("exponent", [0.3, 0.99, 1.0, 2.0])
def test_gradients_at_rest_are_finite(exponent: float):
    """After a reset every rotor is at rest, where the derivative of a power below 1 is infinite."""
    motor = at_rotor((*SHARP[:4], exponent, *SHARP[5:]), RATIO)
    function = Stepper(pendulum(motor, 0.02)).function
    inputs = [ca.SX.sym(name, function.numel_in(name)) for name in function.name_in()]
    after = ca.vertcat(*function.call(inputs))
    weights = ca.SX.sym("weights", after.numel())
    back = ca.Function("back", [*inputs, weights], [ca.jtimes(after, ca.vertcat(*inputs[:-1]), weights, True)])
    given = {"q": 0.4, "v": 0.0, "diverged": 0, "motor_load": [0.05, -0.03, 1.0], "target": 3.0, "dt": 1e-3}
    for row in np.eye(weights.numel()):
        assert np.isfinite(back(*[given[name] for name in function.name_in()], row).full()).all()


def test_torques_go_to_the_rotors_of_a_differential():
    """Two rotors that turn two joints together: the load of each rotor is the joint torque through the inverse."""
    robot = differential()
    drive = DriveFriction(load_motor=0.1, load_external=0.1)
    motors = tuple(replace(motor, friction=10.0, drive_friction=drive) for motor in robot.motors)
    model = Model(replace(robot, motors=motors))
    function = step_function(model.mechanism, StepOptions(control="torque", motors="limited"))
    torque = np.array([0.7, -0.4])
    after = function(q=[0, 0], v=[0, 0], motor_load=ca.DM.zeros(5), diverged=0, target=torque, dt=0.005)
    W = np.array([[3.0, 4.0], [3.0, -4.0]])
    shares = np.linalg.solve(W.T, torque)
    np.testing.assert_allclose(after["motor_load_next"].full().ravel(), [*shares, 0.0, 0.0, 1.0], atol=1e-5)


@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_it_takes_energy_however_long_the_step(dt: float):
    """A leg whose drives lose more under load than servos do is thrown about without a motor's help, and lies still."""
    drive = DriveFriction(0.02, 5.0, 1.0, 0.3, 0.5, 0.2, 0.4, 0.1, 0.1, efficiency=0.5, backdriving_efficiency=0.3)
    robot = load_robot("mit_humanoid_leg")
    robot = replace(robot, motors=tuple(replace(motor, drive_friction=drive) for motor in robot.motors))
    model = Model(robot)
    function = step_function(model.mechanism, StepOptions(control="torque", motors="limited"), ("energy",))
    q, v = model.standing_q, np.array([3.0, -2.0, 4.0, -6.0, 5.0])
    state = {"q": q, "v": v, "motor_load": ca.DM.zeros(11)}
    energies = []
    for _ in range(round(1.0 / dt)):
        after = function(**state, diverged=0, target=ca.DM.zeros(5), dt=dt)
        state = {name: after[f"{name}_next"] for name in state}
        energies.append(float(after["energy"]))
    kinetic = 0.5 * v @ model.mass_matrix(q) @ v
    assert np.diff(energies).max() < 0.01 * kinetic
    assert np.abs(state["v"].full()).max() < 2e-3
