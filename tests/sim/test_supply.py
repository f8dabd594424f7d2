"""Heat, a battery and cogging in kernels: same numbers as the traced step, robots that differ, resets, episodes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import gymnasium
import numpy as np
import pytest

import ce_gym
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Battery, Heat, Robot

HEAT = Heat(2.0, 20.0, 1.5, 3.0)


def leg(**figures: Any) -> Robot:
    """A leg whose motors grow warm, cog and share a battery."""
    robot = ce_gym.load_robot("mit_humanoid_leg")
    more = {"velocity": 200.0, "motor_constant": 0.15, "heat": HEAT, "cogging": ((12, 0.01, 0.3),)} | figures
    motors = tuple(replace(motor, torque=min(motor.torque, 3.0), **more) for motor in robot.motors)
    return replace(robot, motors=motors, battery=Battery(24.0, 0.3, 24.0, 20.0))


def simulator(dtype: str = "float64", n: int = 5, **arguments: Any) -> ce_gym.Simulator:
    outputs = ("winding_temperature", "battery_voltage", "motor_torque")
    model = ce_gym.Model(leg())
    return ce_gym.Simulator(model, n, 0.002, dtype=dtype, motors="limited", outputs=outputs, **arguments)


@pytest.mark.parametrize(("dtype", "close"), [("float64", 1e-9), ("float32", 1e-3)])
def test_kernels_do_what_the_traced_step_does(dtype, close):
    sim = simulator(dtype)
    target = sim.model.standing_q[: len(sim.model.joint_links)] + 0.4
    options = StepOptions(motors="limited")
    function = step_function(sim.model.mechanism, options)
    state = {"q": ca.DM(sim.q[0].astype(float)), "v": ca.DM(sim.v[0].astype(float))}
    state |= {"motor_warmth": ca.DM.zeros(10), "battery_sag": ca.DM.zeros(1)}
    for _ in range(50):
        sim.step(target)
        after = function(**state, diverged=0, target=target, dt=0.002)
        state = {name: after[f"{name}_next"] for name in state}
    warmth, sag = state["motor_warmth"].full().ravel(), float(state["battery_sag"])
    np.testing.assert_allclose(sim.winding_temperature[0], 25.0 + warmth[:5], rtol=close)
    np.testing.assert_allclose(sim.battery_voltage[0], 24.0 - sag, rtol=close)
    assert sim.winding_temperature.max() > 25.5
    assert sim.battery_voltage.max() < 23.9
    assert (sim.q == sim.q[0]).all()
    sim.reset()
    sim.step(target)
    assert sim.winding_temperature.max() < 25.5


def test_robots_differ_by_air_and_battery():
    sim = simulator(n=2, parameters=("ambient", "battery_voltage", "cogging"))
    sim.set_parameter("ambient", [[25.0], [80.0]])
    sim.set_parameter("battery_voltage", [[24.0], [20.0]])
    sim.reset()
    sim.step(sim.model.standing_q[: len(sim.model.joint_links)] + 0.4, 20)
    assert sim.winding_temperature[1].min() > 80 > sim.winding_temperature[0].max()
    assert sim.battery_voltage[1] < 20 < sim.battery_voltage[0]


def test_explicit_methods_are_refused():
    with pytest.raises(ValueError, match="an implicit one: the state has the temperature above the air"):
        simulator(method="rk4")


def test_extrapolation_agrees_with_short_steps():
    """Heat and battery are updated once per step, from its last stage."""
    coarse, fine = simulator(method="extrapolated", n=1), simulator(n=1)
    target = coarse.model.standing_q[: len(coarse.model.joint_links)] + 0.1
    coarse.step(target, 20)
    fine.step(target, 20)
    np.testing.assert_allclose(coarse.winding_temperature, fine.winding_temperature, rtol=2e-2)
    np.testing.assert_allclose(coarse.battery_voltage, fine.battery_voltage, rtol=2e-2)


def test_an_environment_draws_and_shows_them(tmp_path):
    shutil.copytree(Path(ce_gym.load_robot("mini_cheetah").source).parent, tmp_path / "warm")
    file = tmp_path / "warm" / "mini_cheetah.yaml"
    more = "motor_constant: 0.15, cogging: [[12, 0.01]], heat: {winding_capacity: 2, housing_capacity: 20,"
    figures = f"&motor {{velocity: 240.0, {more} winding_to_housing: 1, housing_to_ambient: 2}}, torque: 3.0}}"
    text = file.read_text().replace("&motor {torque: 3.0, velocity: 240.0}", figures)
    file.write_text(f"{text}\nbattery: {{voltage: 24, resistance: 0.05}}\n")
    envs = gymnasium.make_vec(
        "ce_gym/MiniCheetahVelocity-v0",
        num_envs=8,
        robot=str(file),
        motors="limited",
        observations=["joint_positions", "winding_temperatures", "battery_sag"],
        randomise={"ambient": (10.0, 60.0), "battery_voltage": (0.9, 1.0), "cogging": (0.5, 1.5)},
    )
    seen, _ = envs.reset(seed=0)
    assert seen.shape == (8, 12 + 12 + 1)
    assert (seen[:, 12:] == 0).all()
    for _ in range(10):
        seen, *_ = envs.step(np.ones(envs.action_space.shape, np.float32))
    assert (seen[:, 12:24] > 0).all()
    assert (seen[:, 24] > 0).all()
    assert len(np.unique(seen[:, 24])) > 4
    envs.close()
