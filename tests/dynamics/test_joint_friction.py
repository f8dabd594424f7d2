"""Dry friction of joints, dependent ones too, against virtual work and against MuJoCo's `frictionloss`.

Sticking and sliding are tested with the friction of rotors, in test_actuation.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from linkages import four_bar, link

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.dry_friction import STICK_SPEED
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import Robot

FRICTION = {"crank": 0.2, "coupler": 0.5, "rocker": 0.3, "motor": 0.02}


def rubbing(robot: Robot, friction: dict[str, float]) -> Robot:
    """A robot with dry friction at joints [N m]."""
    bodies = [replace(body, joint=replace(body.joint, friction=friction.get(body.name, 0.0))) for body in robot.bodies]
    return replace(robot, bodies=tuple(bodies))


@lru_cache
def stepper(robot: Robot, level: str = "exact") -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Return a step from q, v and torques to q and v, and of any length."""
    model = Model(robot, level)
    function = step_function(model.mechanism, StepOptions(control="torque"))

    def step(q, v, torque, dt: float):
        guess = {"dependent": model.dependent_guess(q)} if "dependent" in function.name_in() else {}
        after = function(q=q, v=v, diverged=0.0, target=torque, dt=dt, **guess)
        return after["q_next"].full().ravel(), after["v_next"].full().ravel()

    return step


def turning(model: Model, q: np.ndarray) -> np.ndarray:
    """How fast the joints with friction turn when the crank turns at 1 rad/s, from differences of assembled poses."""
    h = 1e-5
    before, after = (model.spanning(q + d, np.zeros(1))[0] for d in (-h, h))
    return (after - before)[[model.spanning_names.index(name) for name in FRICTION]] / (2 * h)


SMOOTH = four_bar(gravity=(0, 0, 0))
ROUGH = rubbing(SMOOTH, FRICTION)


def test_friction_of_joints_in_a_loop_follows_virtual_work():
    """`sum |dq_i / dy| f_i` against the motion, q_i dependent or not; the rotor's too, where the level has no rotor."""
    model, moment = Model(SMOOTH), 1e-6
    q = model.standing_q
    most = np.abs(turning(model, q)) @ list(FRICTION.values())
    for v in (3.0, -0.2):
        _, ours = stepper(ROUGH, "none")(q, [v], [1.0], moment)
        _, theirs = stepper(SMOOTH, "none")(q, [v], [1.0 - most * np.sign(v)], moment)
        assert ours[0] - v == pytest.approx(theirs[0] - v, rel=1e-6)


@pytest.mark.parametrize("dt", [0.0005, 0.01])
def test_friction_of_joints_in_a_loop_holds(dt: float):
    """The crank does not move at all below the sum of all friction torques, and slides above it."""
    model, step = Model(ROUGH), stepper(ROUGH)
    most = np.abs(turning(model, model.standing_q)) @ list(FRICTION.values())
    for load, moves in ((0.3, False), (0.99, False), (-0.99, False), (1.01, True)):
        q, v = model.standing_q, np.zeros(1)
        for _ in range(100):
            q, v = step(q, v, [load * most], dt)
        assert (q[0] != model.standing_q[0]) == (abs(v[0]) > STICK_SPEED) == moves


def arm(**friction: float) -> Robot:
    """Two links on the world, turning about skew axes."""
    bodies = (
        link("upper", None, (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
        link("fore", "upper", (0.3, 0.0, 0.0), (0.6, 0.8, 0.0)),
    )
    return rubbing(Robot("arm", bodies, independent=("upper", "fore")), friction)


def test_sliding_joints_accelerate_as_mujoco_s():
    mujoco = pytest.importorskip("mujoco")
    robot = arm(upper=0.8, fore=0.3)
    step = stepper(robot)
    peer = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    data, rng = mujoco.MjData(peer), np.random.default_rng(0)
    for _ in range(5):
        q, v, tau = rng.uniform(-1, 1, 2), rng.uniform(0.5, 2, 2) * rng.choice([-1, 1], 2), rng.normal(0, 3, 2)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, tau
        mujoco.mj_forward(peer, data)
        _, after = step(q, v, tau, 1e-7)
        np.testing.assert_allclose((after - v) / 1e-7, data.qacc, rtol=1e-4)


def test_no_joint_of_many_takes_more_than_it_has():
    """Six joints that stick, slip and reverse under random torques; friction torques by inverse dynamics."""
    axes = [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.6, 0.8, 0.0)] * 2
    names = [f"link{i}" for i in range(6)]
    bodies = [link(name, names[i - 1] if i else None, (0.2, 0.0, 0.0), axes[i]) for i, name in enumerate(names)]
    most = dict.fromkeys(names, 0.5)
    robot = rubbing(Robot("chain", tuple(bodies), independent=tuple(names), gravity=(0, 0, 0)), most)
    model, step, rng = Model(robot), stepper(robot), np.random.default_rng(0)
    q, v, dt, stuck, slid = np.zeros(6), np.zeros(6), 0.002, 0, 0
    for _ in range(400):
        tau = rng.normal(0, 0.6, 6)
        moved, after = step(q, v, tau, dt)
        taken = tau - model.inverse_dynamics(q, v, (after - v) / dt)
        assert np.abs(taken).max() <= 0.5 * 1.02
        stuck, slid = stuck + (moved == q).sum(), slid + (np.abs(taken) > 0.5 * 0.98).sum()
        q, v = moved, after
    assert min(stuck, slid) > 200


def test_a_falling_arm_moves_and_rests_as_mujoco_s():
    """A fall that friction ends. MuJoCo's friction creeps where it should stick; made as hard as it goes, little."""
    mujoco = pytest.importorskip("mujoco")
    robot, dt = arm(upper=4.0, fore=1.0), 0.0005
    step, peer = stepper(robot), mujoco.MjModel.from_xml_string(to_mjcf(robot, timestep=dt))
    peer.dof_solimp[:, :2] = 0.9999
    data = mujoco.MjData(peer)
    q, v, furthest = np.zeros(2), np.zeros(2), 0.0
    for _ in range(2400):
        q, v = step(q, v, np.zeros(2), dt)
        mujoco.mj_step(peer, data)
        furthest = max(furthest, np.abs(q - data.qpos).max())
    assert np.abs(v).max() <= STICK_SPEED
    assert furthest < 1e-3
    assert q[0] > 1.0
