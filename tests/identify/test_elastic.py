"""Identification of elastic transmissions from logs of an independent simulation, and unidentifiable parameters.

The simulation has two links and two rotors in a plane: Lagrange's equations in steps of 50 us, without the package.
"""

from __future__ import annotations

import re
from dataclasses import replace
from math import cos, sin
from pathlib import Path

import numpy as np
import pytest

from ce_gym import Model, Robot, RobotError, Simulator, load_robot
from ce_gym.identify import Identified, Log, identify, simulate_log, to_yaml
from ce_gym.model import Gains, Joint

pytest.importorskip("scipy")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")]

URDF = """\
<robot name="arm">
  <link name="bench"/>
  <link name="upper"><inertial><origin xyz="0 0 -0.1"/><mass value="0.8"/>
    <inertia ixx="0.004" ixy="0" ixz="0" iyy="0.005" iyz="0" izz="0.002"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 -0.08"/><mass value="0.3"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.0005"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="bench"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.25"/>
    <axis xyz="0 1 0"/></joint>
</robot>
"""
YAML = """\
urdf: arm.urdf
base: fixed
rotors:
  first: {parent: bench, xyz: [0, 0, 0], axis: [0, 1, 0], mass: 0.1, ratios: {upper: 6},
    inertia: [1e-4, 0, 0, 6e-5, 0, 1e-4]}
  second: {parent: upper, xyz: [0, 0, -0.25], axis: [0, 1, 0], mass: 0.1, ratios: {lower: 9},
    inertia: [1e-4, 0, 0, 6e-5, 0, 1e-4]}
motors: {first: {torque: 5, damping: 2e-4}, second: {torque: 5, damping: 2e-4}}
elastic:
  first: {stiffness: 4, damping: 4e-3, backlash: 0.05}
  second: {stiffness: 3, damping: 3e-3, backlash: 0.04}
"""
SPIN, STIFFNESS, DAMPING, PLAY, LOSS = 6e-5, (4.0, 3.0), (4e-3, 3e-3), (0.05, 0.04), 2e-4
PLANTED = {
    "rotor_inertia:first": 1.2,
    "rotor_inertia:second": 0.8,
    "drive_stiffness:first": 1.3,
    "drive_stiffness:second": 0.75,
    "drive_damping:first": 0.8,
    "drive_damping:second": 1.25,
    "backlash:first": 0.7,
    "backlash:second": 1.4,
    "encoder_zero:upper": 0.006,
    "encoder_zero:lower": -0.004,
    "delay": 0.003,
}
DT, NOISE, STEP = 1e-3, 2e-4, 5e-5


def slope(z: list[float], torque: list[float]) -> list[float]:
    """Derivatives of [q, theta, qd, thetad] of the arm as planted."""
    q1, q2, theta1, theta2, v1, v2, w1, w2 = z
    J1, J2 = SPIN * PLANTED["rotor_inertia:first"], SPIN * PLANTED["rotor_inertia:second"]
    upper, lower, length, c1, c2, g = 0.8, 0.3, 0.25, 0.1, 0.08, 9.81
    I1 = 0.005 - (J2 - SPIN)  # the load on the upper link is unchanged
    I2 = 0.002 + lower * c2**2
    elbow = I2 + lower * length * c2 * cos(q2)
    M11 = I1 + upper * c1**2 + 0.1 * length**2 + J2 + lower * length**2 + 2 * elbow - I2
    mesh1, mesh2 = mesh("first", 0, theta1 - 6 * q1, w1 - 6 * v1), mesh("second", 1, theta2 - 9 * q2, w2 - 9 * v2)
    h, far = lower * length * c2 * sin(q2), lower * c2 * sin(q1 + q2)
    on1 = 6 * mesh1 + h * (2 * v1 * v2 + v2**2) - g * ((upper * c1 + (0.1 + lower) * length) * sin(q1) + far)
    on2 = 9 * mesh2 - h * v1**2 - g * far
    motor1, motor2 = torque[0] - mesh1 - LOSS * w1, torque[1] - mesh2 - LOSS * w2
    on1, M11 = on1 - motor2, M11 - J2  # the second rotor turns with its carrier: J2 (a1 + its own) = motor2
    a1 = (on1 - elbow / I2 * on2) / (M11 - elbow**2 / I2)
    return [v1, v2, w1, w2, a1, (on2 - elbow * a1) / I2, motor1 / J1, motor2 / J2 - a1]


def mesh(rotor: str, i: int, stretch: float, rate: float) -> float:
    """Torque of two flanks."""
    k, d = STIFFNESS[i] * PLANTED[f"drive_stiffness:{rotor}"], DAMPING[i] * PLANTED[f"drive_damping:{rotor}"]
    side = 1 if stretch > 0 else -1
    pressed = side * stretch - PLAY[i] * PLANTED[f"backlash:{rotor}"] / 2
    return side * max(0.0, k * pressed + d * side * rate) if pressed > 0 else 0.0


def log_of(seconds: float, amplitude: float, about: tuple[float, float] = (0.0, 0.0), fast: float = 15.0) -> Log:
    """Log of the arm under a controller of its motors, with encoders at joints and rotors and delayed torques."""
    rows, late = round(seconds / DT), round(PLANTED["delay"] / DT)
    z = [*about, 6 * about[0], 9 * about[1], 0.0, 0.0, 0.0, 0.0]
    seen, torques = np.zeros((rows, 4)), np.zeros((rows, 2))
    for i in range(rows):
        seen[i], t = z[:4], i * DT
        goals = about[0] + amplitude * sin(6 * t + fast * t**2), about[1] + amplitude * sin(20 * t + 0.7 * fast * t**2)
        torques[i] = 0.25 * (6 * goals[0] - z[2]) - 0.006 * z[6], 0.08 * (9 * goals[1] - z[3]) - 0.002 * z[7]
        now = torques[max(0, i - late)].tolist()
        for _ in range(round(DT / STEP)):
            a = slope(z, now)
            b = slope([x + STEP / 2 * y for x, y in zip(z, a, strict=True)], now)
            c = slope([x + STEP / 2 * y for x, y in zip(z, b, strict=True)], now)
            d = slope([x + STEP * y for x, y in zip(z, c, strict=True)], now)
            z = [x + STEP / 6 * (p + 2 * q + 2 * r + s) for x, p, q, r, s in zip(z, a, b, c, d, strict=True)]
    seen += np.random.default_rng(5).normal(0, NOISE, seen.shape)
    seen[:, :2] += [PLANTED["encoder_zero:upper"], PLANTED["encoder_zero:lower"]]
    measured = tuple(("angle", name) for name in ("upper", "lower", "first", "second"))
    return Log(DT, ("first", "second"), torques, measured, seen)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.urdf").write_text(URDF)
    (folder / "arm.yaml").write_text(YAML)
    return load_robot(folder / "arm.yaml")


KINDS = ("rotor_inertia", "drive_stiffness", "drive_damping", "backlash", "encoder_zero", "delay")
OPTIONS = {"control": "motor_torque", "transmission": "elastic"}


@pytest.fixture(scope="module")
def log() -> Log:
    return log_of(3.0, 0.3)


@pytest.fixture(scope="module")
def result(arm: Robot, log: Log) -> Identified:
    return identify(arm, log, kinds=KINDS, substep=2.5e-4, **OPTIONS)


def test_estimates_are_the_parameters_of_the_other_arm(result: Identified):
    names = [parameter.name for parameter in result.parameters]
    for name, value in PLANTED.items():
        assert result[name] == pytest.approx(value, rel=0.02), name
        assert abs(result[name] - value) < 4 * dict(zip(names, result.std, strict=True))[name], name
    assert result.warnings == ()
    assert result.held_out.max() < 1.1 * NOISE
    assert result.held_out_before.max() > 50 * NOISE


def only(log: Log, *names: str) -> Log:
    """The log of fewer encoders."""
    kept = [k for k, (_, name) in enumerate(log.measured) if name in names]
    return replace(log, measured=tuple(log.measured[k] for k in kept), values=log.values[:, kept])


def test_encoders_at_rotors_alone_are_enough(arm: Robot, log: Log):
    kinds = tuple(kind for kind in KINDS if kind != "encoder_zero")
    with pytest.raises(RobotError, match="kind is 'encoder_zero': expected a kind that arm and its log have"):
        identify(arm, only(log, "first", "second"), kinds=KINDS, **OPTIONS)
    result = identify(arm, only(log, "first", "second"), kinds=kinds, substep=5e-4, **OPTIONS)
    for parameter, value in zip(result.parameters, result.values, strict=True):
        assert value == pytest.approx(PLANTED[parameter.name], rel=0.02), parameter.name
    assert result.warnings == ()


def test_rigid_parameters_do_not_fit_and_cause_a_warning(arm: Robot, log: Log):
    kinds = ("rotor_inertia", "motor_damping", "link_inertia", "delay")
    result = identify(arm, log, control="motor_torque", kinds=kinds)
    assert re.match(
        r"the residual of angle:\w+ is \d+ times its noise: .*; intervals are not valid", result.warnings[0]
    )


def test_uncrossed_backlash_is_not_separable_from_an_encoder_offset(arm: Robot):
    """Without gravity, a long soft spring pressing flanks on each other, nothing else tells one from the other."""
    soft = 1e-4
    pulled = {name: Joint("revolute", (0, 1, 0), stiffness=soft, springref=2.0 / soft) for name in ("upper", "lower")}
    bodies = tuple(replace(b, joint=pulled.get(b.name, b.joint)) for b in arm.bodies)
    gains = Gains(kp=(("upper", 30.0), ("lower", 20.0)), kd=(("upper", 1.0), ("lower", 0.5)))
    pressed = replace(arm, bodies=bodies, gravity=(0.0, 0.0, 0.0), gains=gains)
    options = {"transmission": "elastic", "substep": 1e-3}
    planted = {"backlash:first": 0.7, "encoder_zero:upper": 0.006, "drive_stiffness:first": 1.3}
    log = simulate_log(pressed, 4.0, 1e-3, amplitude=0.05, planted=planted, noise=NOISE, encoders="both", **options)
    stretch = log.values[:, 2:] - [6, 9] * (log.values[:, :2] - [0.006, 0.0])
    assert (np.abs(stretch[500:]) > 0.01).all(), "on one flank"
    result = identify(pressed, log, kinds=("drive_stiffness", "backlash", "encoder_zero"), **options)
    held = {item.parameter.name: item.shifted for item in result.unidentifiable}
    assert held.keys() in ({"backlash:first", "backlash:second"}, {"encoder_zero:upper", "encoder_zero:lower"})
    assert all(held.values())
    assert result["drive_stiffness:first"] == pytest.approx(1.3, rel=0.02)


def test_the_written_file_loads_and_is_the_same_robot(arm: Robot, result: Identified, tmp_path: Path):
    (tmp_path / "result.yaml").write_text(text := to_yaml(result, arm.source))
    assert "the encoder of upper reads 0.006" in text
    laid, names = load_robot(tmp_path / "result.yaml"), [p.name for p in result.parameters if p.kind in KINDS[:4]]
    sims = [
        Simulator(Model(robot, "elastic"), motors="limited", parameters=p) for robot, p in ((laid, ()), (arm, names))
    ]
    for name in names:
        sims[1].set_parameter(name, result[name])
    bare = Simulator(Model(arm, "elastic"), motors="limited")
    for sim in (*sims, bare):
        sim.set_state(np.array([[0.3, -0.2, 0.03, -0.02]]), np.zeros((1, 4)))
        sim.step(np.array([[0.4, 0.1]]), 40)
    np.testing.assert_allclose(sims[0].q, sims[1].q, rtol=0, atol=1e-6)
    assert np.abs(bare.q - sims[1].q).max() > 1e-4


def test_parameters_without_a_value_in_the_file_are_refused(arm: Robot):
    stiff = replace(arm, elastic=tuple(replace(e, backlash=0.0, damping=0.0) for e in arm.elastic))
    log = simulate_log(arm, 4.0, transmission="elastic")
    with pytest.raises(RobotError, match="kind is 'backlash': expected a kind that arm and its log have"):
        identify(stiff, log, kinds=("backlash", "drive_damping"), transmission="elastic")
    with pytest.raises(RobotError, match="elastic is missing"):
        identify(replace(arm, elastic=()), log, transmission="elastic")
