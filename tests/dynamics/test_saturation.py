"""Motors at their limits in long steps: the torque is the commanded one at the end of the step, or the limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import ce_gym
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Body, Gains, Inertial, Joint, LinearConstraint, Motor, Placement, Robot

KP, KD, LIMIT, RATIO, DT = 40.0, 1.0, 3.0, 8.0, 0.005


def turntable(inertia: float, velocity: float = np.inf) -> Robot:
    """One geared joint with a limit, without gravity or friction; almost all inertia is the link's."""

    def inertial(moment: float) -> Inertial:
        return Inertial(1.0, (0.0, 0.0, 0.0), tuple(map(tuple, np.diag([moment] * 3).tolist())))

    joint = Joint("revolute", (0.0, 0.0, 1.0))
    table = Body("table", "link", None, Placement(), replace(joint, torque=LIMIT), inertial(inertia))
    rotor = Body("rotor", "rotor", None, Placement(), joint, inertial(1e-9))
    gear = LinearConstraint("gear", (("rotor", 1.0), ("table", -RATIO)))
    motors, gains = (Motor("rotor", LIMIT / RATIO, velocity),), Gains((("table", KP),), (("table", KD),))
    return Robot("turntable", (table, rotor), (gear,), ("table",), motors=motors, gains=gains, gravity=(0.0, 0.0, 0.0))


def most(v: float, velocity: float) -> tuple[float, float]:
    """Limits at the joint at the speed of the end of the step: current, and voltage that never brakes."""
    ends = (LIMIT * (1 - side * RATIO * v / velocity) for side in (1, -1))
    high, low = (max(0.0, min(LIMIT, line)) for line in ends)
    return high, -low


def root(rising: Callable[[float], float]) -> float:
    """Where a function passes zero, by halving."""
    low, high = -1e5, 1e5
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if rising(middle) < 0 else (low, middle)
    return (low + high) / 2


@pytest.mark.parametrize("motors", ["ideal", "limited"])
@pytest.mark.parametrize("inertia", [1e-5, 1e-4, 1e-3, 1e-2, 1.0])
@pytest.mark.parametrize("target", [-2.0, -0.3, 0.05, 0.1, 1.0])
def test_a_step_ends_where_torque_and_limit_agree(inertia: float, target: float, motors: str):
    """A root of one equation in the speed at the end, found without us; light links overshot ten times and more."""
    model = Model(turntable(inertia))
    step = step_function(model.mechanism, StepOptions(DT, motors=motors), ("torque",))
    for v in (-6.0, 0.0, 2.0):

        def torque(end: float) -> float:
            return float(np.clip(KP * (target - DT * end) - KD * end, -LIMIT, LIMIT))

        whole = inertia + RATIO**2 * 1e-9
        end = root(lambda end: whole * (end - v) / DT - torque(end))  # noqa: B023
        result = step(q=[0.0], v=[v], diverged=0.0, target=[target])
        assert float(result["v_next"]) == pytest.approx(end, rel=1e-9, abs=1e-9)
        assert float(result["torque"]) == pytest.approx(torque(end), rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("inertia", [1e-5, 1e-3, 0.1])
@pytest.mark.parametrize("target", [0.02, 0.4, 3.0])
def test_on_the_torque_speed_line_too(inertia: float, target: float):
    velocity = 60.0
    model = Model(turntable(inertia, velocity))
    step = step_function(model.mechanism, StepOptions(DT, motors="limited"), ("torque",))
    whole = inertia + RATIO**2 * 1e-9
    v = 0.0

    def excess(end: float) -> float:
        high, low = most(end, velocity)
        return whole * (end - v) / DT - max(low, min(high, KP * (target - DT * end) - KD * end))

    end = root(excess)
    result = step(q=[0.0], v=[v], diverged=0.0, target=[target])
    assert float(result["v_next"]) == pytest.approx(end, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "level"), [("mini_cheetah", "exact"), ("tello", "none"), ("tello", "exact")])
def test_no_robot_exceeds_its_limits_or_stays_below_for_nothing(robot: str, level: str):
    """Under random targets every torque is the commanded one at the end of the step, clipped.

    In flight a step corrects velocities afterwards, to keep the energy, by a percent or so.
    """
    model, n = Model(robot, level), 64
    sim = ce_gym.Simulator(model, n, outputs=("torque",))
    names = model.robot.independent
    limit = np.array([model.robot.body(name).joint.torque for name in names])
    gains = model.robot.gains
    kp, kd = (np.array([dict(pairs)[name] for name in names]) for pairs in (gains.kp, gains.kd))
    rng, joints, wrong, at_limit = np.random.default_rng(0), len(names), [], 0
    for i in range(40):
        if i % 4 == 0:
            target = model.standing_q[-joints:] + rng.uniform(-1.0, 1.0, (n, joints))
        y = sim.q[:, -joints:].copy()
        sim.step(target)
        end = sim.v[:, -joints:]
        asked = kp * (target - y - sim.dt * end) - kd * end
        given = np.clip(asked, -limit, limit)
        wrong.append(np.abs(sim.torque - given).max(1) > 0.05 * limit.max())
        at_limit += int((np.abs(asked) > limit).sum())
    assert sim.n_diverged == 0
    assert at_limit > 0
    assert np.mean(wrong) < 0.02  # steps that five iterations were not enough for; most on Tello without rotors
