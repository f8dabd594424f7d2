"""Torques and speeds of motors against the simulator's own; pushes that some robots survive."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym
from ce_gym.learn.evaluation.effort import Drives, effort, largest_power
from ce_gym.learn.evaluation.episodes import open_environments
from ce_gym.learn.evaluation.pushes import push_envelope
from ce_gym.learn.evaluation.tables import push_table
from ce_gym.model import Elasticity
from ce_gym.policies import Policy

WALKING = "ce_gym/MiniCheetahVelocity-v0"


def tripod():
    """A floating robot with two geared joints whose transmissions give way at level `elastic`."""
    robot = ce_gym.load_robot(TRIPOD)
    return replace(robot, elastic=tuple(Elasticity(rotor.name, 20.0) for rotor in robot.rotors()))


@pytest.mark.parametrize(
    ("robot", "stepped", "level"),
    [("tripod", "exact", "exact"), ("tripod", "exact", "none"), ("tello", "exact", "exact"), ("tello", "exact", "none")]
    + [("tripod", "elastic", "exact")],
)
def test_motors_turn_and_work_as_in_the_simulator(robot, stepped, level):
    described = tripod() if robot == "tripod" else robot
    sim = ce_gym.Simulator(ce_gym.Model(described, stepped), 4, dt=0.001, outputs=("torque", "motor_speed"))
    drives = Drives.of(ce_gym.Model(described, level))
    assert (drives.constant is None) == (robot == "tello")
    rng = np.random.default_rng(0)
    n = len(sim.model.joint_links)
    for _ in range(10):
        before = sim.q
        sim.step(sim.model.standing_q[7 : 7 + n] + 0.1 * rng.standard_normal((4, n)))
    yd, tau = sim.v[:, 6:], sim.torque
    torque, speed = drives.at_motors(sim.model, before, yd, tau)
    np.testing.assert_allclose(speed, sim.motor_speed, rtol=1e-9, atol=1e-9)
    if stepped == "exact":  # springs take part of the power
        np.testing.assert_allclose((torque * speed).sum(1), (tau * yd).sum(1), rtol=1e-9)
    assert np.abs(torque).max() < 0.5 * np.abs(tau).max()  # gears make motors faster and weaker


@pytest.mark.parametrize(
    ("torque", "stall", "velocity"), [(3.0, 3.0, 240.0), (3.0, 5.0, 100.0), (3.0, 30.0, 100.0), (7.0, 2.0, 50.0)]
)
def test_the_largest_power_is_the_best_point_of_the_torque_speed_line(torque, stall, velocity):
    speed = np.linspace(0, velocity, 100_001)
    given = np.minimum(torque, stall * (1 - speed / velocity))
    assert largest_power(torque, stall, velocity) == pytest.approx((given * speed).max(), rel=1e-6)


def test_an_unknown_motor_has_no_largest_power():
    assert math.isinf(largest_power(math.inf, math.inf, 10.0))


def policy(target, **kwargs):
    """A policy that holds one action, with the record of an environment."""
    with open_environments(WALKING, 1, 0, **kwargs) as (envs, _):
        spec = envs.unwrapped.policy_spec()
    record = {"env": WALKING, "policy_spec": spec, "observation_size": spec["observation"]["size"]}
    return Policy(lambda obs: np.full((len(obs), 12), target, np.float32), record)


def test_a_motor_is_beyond_its_limits_only_where_no_speed_of_the_sub_step_allows_its_torque():
    drives = Drives.of(ce_gym.Model("mini_cheetah"))  # 3 N m, a line from there to 240 rad/s
    cases = [  # torque, speed before, speed after, and whether that is too much
        (3.0, 0.0, 0.0, False), (3.02, 0.0, 0.0, False), (3.1, 0.0, 0.0, True), (-3.1, 0.0, 0.0, True),
        (3.0, 0.0, 200.0, False), (3.0, 200.0, 0.0, False), (3.0, 100.0, 200.0, True), (-3.0, 100.0, 200.0, False),
        (-3.0, -100.0, -200.0, True), (1.76, 100.0, 200.0, False), (1.79, 100.0, 200.0, True),
        (0.02, 300.0, 250.0, False), (0.04, 300.0, 250.0, True), (3.75, 95.0, -60.0, True),
    ]  # fmt: skip
    tau, before, after, wanted = (np.tile(np.array(column)[:, None], 12) for column in zip(*cases, strict=True))
    np.testing.assert_array_equal(drives.beyond(tau, after, before), wanted)


def test_a_robot_that_stands_costs_little_and_carries_its_weight():
    found = effort(policy(0.0), episodes=4, seconds=2.0)
    motors = found["motors"]
    assert len(motors) == 12
    assert found["seconds"] == pytest.approx(4 * 2.0)  # every sub-step of every robot
    knees = [figures for name, figures in motors.items() if "knee" in name]
    # four legs bent by 0.8 rad carry the weight: m g / 4 * 0.195 m * sin 0.8, through a gear of 9.33
    expected = 8.912 * 9.81 / 4 * 0.195 * math.sin(0.8) / 9.33
    assert np.mean([knee["mean_torque"] for knee in knees]) == pytest.approx(expected, rel=0.25)
    assert found["mean_torque"] == pytest.approx(np.mean([m["mean_torque"] / 3.0 for m in motors.values()]))
    assert found["peak_torque"] == pytest.approx(max(m["peak_torque"] for m in motors.values()) / 3.0)
    assert motors[found["peak_power_at"]]["peak_power"] == pytest.approx(found["peak_power"] * 3.0 * 240.0 / 4)
    assert found["power"] == pytest.approx(sum(m["mean_power"] for m in motors.values()))
    assert found["power"] < 5.0
    assert found["beyond_limits"] == 0.0
    ratio = found["power"] / (8.912 * 9.81 * found["speed"])
    assert found["cost_of_transport"] == pytest.approx(ratio, rel=1e-3)
    assert found["cost_of_transport_net"] < found["cost_of_transport"]


def test_sub_steps_show_peaks_that_control_steps_do_not():
    """Actions that change at every control step: the torque is largest right after a change."""
    still = policy(0.0)
    rng = np.random.default_rng(0)
    restless = Policy(lambda obs: rng.uniform(-0.5, 0.5, (len(obs), 12)).astype(np.float32), still.record)
    found = effort(restless, episodes=4, seconds=1.0)
    seen = 0.0
    with open_environments(WALKING, 4, 0, command_period=1e6) as (envs, _):
        for _ in range(50):
            envs.step(restless.predict(np.zeros((4, 48)))[0])
            seen = max(seen, np.abs(envs.unwrapped.batch.rows("torque")).max() / (3.0 * 9.33))
    assert found["peak_torque"] > 1.05 * seen


def test_latency_history_and_critic_do_not_matter():
    """Sub-steps are watched in an environment of their own, the policy sees its history all the same."""
    kwargs = {"latency": (1, 3), "history": 2, "obs_mode": "dict", "critic": ["contact_forces"]}
    found = effort(policy(0.0, **kwargs), episodes=2, seconds=0.2, **kwargs)
    assert found["power"] >= 0.0


def test_hard_pushes_throw_a_standing_robot_over():
    found = push_envelope(policy(0.0), speeds=(0.0, 0.2, 6.0), directions=4, repeats=3)
    survived = np.array(found["survived"])
    assert survived.shape == (4, 3)
    assert (survived[:, :2] == 1.0).all()
    assert survived[1, 2] == survived[3, 2] == 0.0  # from the side
    assert found["envelope"][1] == 0.2
    assert found["command"] == [0.5, 0.0, 0.0]
    text = push_table(found)
    assert [line.split()[1] for line in text.splitlines()[2:6]] == ["forward", "left", "back", "right"]
    assert "0.2 m/s" in text
