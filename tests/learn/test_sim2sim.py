"""A policy acts in MuJoCo: same start, same observations, same commands, same evaluation."""

import json
import sys
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")
import mujoco
from tripod import TRIPOD

import ce_gym
from ce_gym.__main__ import main
from ce_gym.export.mujoco_twin import MujocoTwin
from ce_gym.learn import train
from ce_gym.learn.evaluation.episodes import UNLIMITED, open_environments
from ce_gym.learn.evaluation.sim2sim import (
    MujocoEnvs,
    _check_ratios,
    comparison_table,
    play,
    random_commands,
    verdicts,
)
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot, RobotError
from ce_gym.policies import Policy

ROBOT_ENV = next(iter(ce_gym.environment_ids()))


@pytest.fixture
def twins():
    """A function that returns the same robots in MuJoCo and in ce_gym, and their first observations."""
    with ExitStack() as stack:

        def make(level, n=3, seed=0, **kwargs):
            kwargs |= {"command_period": 1e6, "max_episode_steps": UNLIMITED}
            envs, obs = stack.enter_context(open_environments(ROBOT_ENV, n, seed, **kwargs))
            return MujocoEnvs(envs.unwrapped, obs, level), envs.unwrapped, obs

        yield make


@pytest.mark.slow
@pytest.mark.parametrize("level", ["armature", "exact"])
def test_robots_start_in_the_same_state(level, twins):
    made, native, obs = twins(level)
    state = native.state()
    q, v = made.twin.state()
    np.testing.assert_allclose(q, state["q"], atol=1e-12)
    np.testing.assert_allclose(v, state["v"], atol=1e-12)
    frame, failed = made.native.look({**state, "action": np.zeros((3, 12))})
    np.testing.assert_array_equal(frame, obs)
    assert not failed.any()
    rotors = [body for body in made.native.model.robot.bodies if body.kind == "rotor"] if level == "exact" else []
    assert made.twin.model.njnt == 1 + 12 + len(rotors)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cassie"])
def test_robots_with_loops_start_closed_and_stand_as_ours_do(name):
    """Dependent joints and rotors are where loops put them; springs without actuators get no targets."""
    model, rng = ce_gym.Model(name), np.random.default_rng(0)
    q, v = np.tile(model.standing_q, (2, 1)), np.zeros((2, model.nv))
    q[1, 7:] += rng.uniform(-0.02, 0.02, model.nq - 7)
    v[1] = rng.normal(size=model.nv)
    twin = MujocoTwin(model.robot, "exact", 2)
    twin.start(q, v)
    np.testing.assert_allclose(np.hstack(twin.state()), np.hstack([q, v]), atol=1e-12)
    nq, data = twin.model.nq, mujoco.MjData(twin.model)
    for state in twin._batch.states:
        data.qpos[:], data.qvel[:] = state[1 : 1 + nq], state[1 + nq : 1 + nq + twin.model.nv]
        mujoco.mj_forward(twin.model, data)
        held = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert held.sum() > 10
        np.testing.assert_allclose(data.efc_pos[held], 0.0, atol=1e-9)
        np.testing.assert_allclose(data.efc_vel[held], 0.0, atol=1e-7)
    twin.start(q[:1].repeat(2, 0), 0 * v)
    sim = ce_gym.Simulator(model, 1)
    for _ in range(20):
        twin.step(np.tile(model.standing_q[7:], (2, 1)), 0.02)
    sim.step(model.standing_q[7:], 80)
    np.testing.assert_allclose(twin.state()[0][0], sim.q[0], atol=0.02)


LOOP = """<mujoco model="looped"><worldbody><body name="trunk" pos="0 0 0.6"><freejoint/>
  <geom type="box" size="0.1 0.1 0.1" mass="4"/>
  <body name="thigh" pos="0 0.08 0"><joint name="hip" axis="0 1 0" armature="0.02" range="-1 1"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.8"/>
    <body name="crank" pos="0 0.03 0"><joint name="knee" axis="0 1 0" armature="0.01" range="-1 1"/>
      <geom type="capsule" size="0.01" fromto="0 0 0 -0.05 0 0" mass="0.05"/>
      <body name="rod" pos="-0.05 0 0"><joint name="rod" axis="0 1 0"/>
        <geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.24" mass="0.05"/></body></body>
    <body name="shank" pos="0 0 -0.25"><joint name="shank" axis="0 1 0"/>
      <geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.25" mass="0.4"/></body></body>
  <body name="tail" pos="-0.1 0 0.02"><joint name="tail" type="ball"/>
    <geom type="box" size="0.05 0.02 0.03" pos="-0.05 0 0" mass="0.3"/></body></body></worldbody>
  <equality><connect body1="rod" body2="shank" anchor="0.01 0 -0.24"/></equality>
  <actuator><position joint="hip" kp="60" kv="1.5"/><position joint="knee" kp="60" kv="1.5"/></actuator></mujoco>"""


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_a_robot_with_loops_and_armature_starts_closed(tmp_path):
    """At `armature` rotors have no joint in MuJoCo; its equalities say whether dependent joints are in place."""
    (tmp_path / "looped.xml").write_text(LOOP)
    model, rng = ce_gym.Model(tmp_path / "looped.xml"), np.random.default_rng(0)
    q, v = np.tile(model.standing_q, (3, 1)), rng.normal(size=(3, model.nv))
    q[:, 7:11] = rng.normal(size=(3, 4))
    q[:, 7:11] /= np.linalg.norm(q[:, 7:11], axis=1, keepdims=True)
    q[:, 11:] += rng.uniform(-0.3, 0.3, (3, model.nq - 11))
    twin = MujocoTwin(model.robot, "armature", 3)
    twin.start(q, v)
    np.testing.assert_allclose(np.hstack(twin.state()), np.hstack([q, v]), atol=1e-12)
    nq, data = twin.model.nq, mujoco.MjData(twin.model)
    for state in twin._batch.states:
        data.qpos[:], data.qvel[:] = state[1 : 1 + nq], state[1 + nq : 1 + nq + twin.model.nv]
        mujoco.mj_forward(twin.model, data)
        held = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert held.sum() >= 3
        np.testing.assert_allclose(data.efc_pos[held], 0.0, atol=1e-9)
        np.testing.assert_allclose(data.efc_vel[held], 0.0, atol=1e-9)
    twin.step(np.tile(model.standing_q[11:], (3, 1)), 0.01)
    assert np.isfinite(np.hstack(twin.state())).all()
    assert not twin.diverged.any()


@pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
def test_rotors_of_unknown_ratio_are_no_bodies(tmp_path):
    """Armature alone says no ratio; an actuator's gear and `gears:` do, however large they are."""
    (tmp_path / "looped.xml").write_text(LOOP)
    robot = ce_gym.load_robot(tmp_path / "looped.xml")
    assert robot.unknown_ratios == ("thigh_rotor", "crank_rotor")
    with pytest.raises(RobotError, match="looped gives no gear ratio for thigh_rotor, crank_rotor; `gears:` in a YAML"):
        _check_ratios(robot)
    (tmp_path / "looped.yaml").write_text("mjcf: looped.xml\ngears: {thigh: 9, crank: 2000}\n")
    known = ce_gym.load_robot(tmp_path / "looped.yaml")
    assert known.unknown_ratios == ()
    _check_ratios(known)
    assert not any(ce_gym.load_robot(name).unknown_ratios for name in ce_gym.robots())


def ball(stiffness, damping, mass):
    inertia = Inertial(mass, (0.0, 0.0, 0.0), ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01)))
    body = Body("ball", "link", None, Placement(), Joint("free"), inertia)
    material = ContactMaterial(stiffness, damping)
    return Robot("ball", (body,), contacts=(ContactSphere("ball", "ball", (0.0, 0.0, 0.0), 0.1),), material=material)


def depths_of(robot, speed, steps):
    """How deep a ball that lands at a speed [m/s] is after every step of 1 ms [m]."""
    twin, depths = MujocoTwin(robot, "exact", 1), []
    touching = [[0.0, 0.0, 0.1 - 1e-9, 1.0, 0.0, 0.0, 0.0]]  # MuJoCo finds contacts at the start of a step
    twin.start(np.array(touching), np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -speed]]))
    for _ in range(steps):
        twin.step(np.zeros((1, 0)), 0.001)
        depths.append(0.1 - twin.state()[0][0, 2])
    return depths


@pytest.mark.parametrize(("stiffness", "damping"), [(2e4, 200.0), (5e4, 500.0)])
def test_the_ground_gives_way_as_ours_does(stiffness, damping):
    """A ball of 2 kg that lands at 0.5 m/s: how deep it goes, by the closed form of a spring and a damper."""
    depths = depths_of(ball(stiffness, damping, 2.0), 0.5, 20)
    decay, speed = damping / 4.0, np.sqrt(stiffness / 2.0 - (damping / 4.0) ** 2)
    deepest = np.arctan2(speed, decay) / speed
    expected = 0.5 / speed * np.exp(-decay * deepest) * np.sin(speed * deepest)
    assert max(depths) == pytest.approx(expected, rel=0.15)  # a step is 1 ms


@pytest.mark.parametrize("mass", [2.0, 20.0])
def test_the_ground_carries_a_weight_as_ours_does(mass):
    """A ball at rest has sunk by its weight over the stiffness, however heavy it is."""
    depths = depths_of(ball(2e4, 200.0, mass), 0.0, 1500)
    assert depths[-1] == pytest.approx(mass * 9.81 / 2e4, rel=1e-3)


def test_a_step_on_the_ground_is_one_of_ours():
    """Once both are in the ground, MuJoCo's step on it is ours to rounding, as long as the ground pushes."""
    robot = ball(5e4, 500.0, 2.0)
    ours, twin = ce_gym.Simulator(ce_gym.Model(robot), 1, dt=0.001), MujocoTwin(robot, "exact", 1)
    q, v = np.array([[0.0, 0.0, 0.0995, 1.0, 0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -0.2]])
    ours.set_state(q, v)
    twin.start(q, v)
    for _ in range(4):
        ours.step(np.zeros((1, 0)))
        twin.step(np.zeros((1, 0)), 0.001)
        np.testing.assert_allclose(twin.state()[1], ours.v, atol=1e-9)
    assert ours.v[0, 5] > -0.1


@pytest.mark.slow
@pytest.mark.parametrize("level", ["armature", "exact"])
def test_both_fly_alike(level, twins):
    """High above the ground, where there are no contacts to differ in, and at small steps."""
    made, native, _ = twins(level, transmission=level, dt=0.0005, n_substeps=40)
    made.twin.model.opt.timestep = 0.0005
    state = native.state()
    state["q"][:, 2] += 5.0
    native.batch.write("q", state["q"])
    made.twin.start(state["q"], state["v"])
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(-0.5, 0.5, (3, 12)).astype(np.float32)
        theirs, _, failed, _, _ = made.step(action)
        obs, _, fallen, _, _ = native.step(action)
    v, v_ours = made.state()["v"], native.state()["v"]
    assert not failed.any()
    assert not fallen.any()
    assert np.abs(v_ours[:, 6:]).max() > 5.0  # joints have moved fast
    np.testing.assert_allclose(v[:, :6], v_ours[:, :6], atol=0.05)
    np.testing.assert_allclose(v[:, 6:], v_ours[:, 6:], atol=0.3)
    np.testing.assert_allclose(theirs[:, 12:24], obs[:, 12:24], atol=0.01)  # joint positions


@pytest.mark.slow
def test_a_history_is_kept_newest_first(twins):
    made, _, obs = twins("armature", robot=TRIPOD, history=3)
    size = obs.shape[1] // 3
    first = made.step(np.zeros((3, 2), np.float32))[0]
    np.testing.assert_array_equal(first[:, size:], obs[:, : 2 * size])
    second = made.step(np.zeros((3, 2), np.float32))[0]
    np.testing.assert_array_equal(second[:, size : 2 * size], first[:, :size])
    np.testing.assert_array_equal(second[:, 2 * size :], obs[:, :size])


def test_commands_last_a_period_and_stay_in_range():
    policy_spec = {"control_dt": 0.02, "command": {"range": [[-1, 1], [0, 0.5], [2, 2]]}}
    first = np.full((200, 3), 9.0)
    assert (random_commands(policy_spec, first, 0.5, every=np.inf, seed=1) == first).all()
    drawn = random_commands(policy_spec, first, 0.5, every=0.1, seed=1)
    assert drawn.shape == (26, 200, 3)
    assert (drawn[:5] == first).all()
    assert (drawn[5:10] == drawn[5]).all()
    assert not (drawn[10] == drawn[5]).all()
    moving = drawn[5][drawn[5].any(axis=1)]
    assert 0 < 200 - len(moving) < 50
    assert (moving[:, 2] == 2).all()
    assert moving[:, 1].min() >= 0


def test_judgement_ends_with_a_fall():
    """Robot 1 falls at the third step; later steps do not count."""
    v, taken, no = np.zeros((2, 7)), iter(range(100)), np.zeros(2, bool)

    def step(action):
        k = next(taken)
        v[:, 3] = 0.5, 100.0 if k >= 2 else 0.5
        return np.zeros((2, 1), np.float32), np.zeros(2), np.array([False, k == 2]), no, {}

    native = SimpleNamespace(set_command=lambda command: None, state=lambda: {"v": v})
    policy = Policy(lambda obs: obs, {"observation_size": 1})
    envs = SimpleNamespace(step=step, unwrapped=native)
    result = play(policy, envs, np.zeros((2, 1), np.float32), np.ones((11, 2, 3)), control_dt=0.1)
    assert result["falls"] == 0.5
    assert result["episode_length"] == pytest.approx(0.5 * (1.0 + 0.2))
    assert result["forward_error"] == pytest.approx(0.5)
    assert result["yaw_rate_error"] == pytest.approx(1.0)
    assert result["velocity_error"] == pytest.approx(np.hypot(0.5, 1.0))


def test_standing_robots_stand_and_tilted_ones_fall(twins):
    stand = Policy(lambda obs: np.zeros((len(obs), 12), np.float32), {"observation_size": 48})
    made, native, obs = twins("armature", n=2)
    state = native.state()
    state["q"][1, 3:7] = (np.cos(0.6), np.sin(0.6), 0.0, 0.0)  # rolled by 69 degrees
    assert not made.native.look({**state, "action": np.zeros((2, 12))})[1].any()
    made.twin.start(state["q"], state["v"])
    commands = random_commands(made.policy_spec, np.zeros((2, 3)), 1.0, every=1.0, seed=0)
    result = play(stand, made, obs, commands, control_dt=0.02)
    assert result["falls"] == 0.5


def figures(velocity, yaw, falls):
    return {"velocity_error": velocity, "yaw_rate_error": yaw, "falls": falls}


@pytest.mark.parametrize(
    ("theirs", "passes"),
    [
        (figures(0.149, 0.29, 0.04), True),
        (figures(0.149, 0.29, 0.06), False),
        (figures(0.151, 0.29, 0.0), False),
        (figures(0.149, 0.31, 0.0), False),
        (figures(float("nan"), float("nan"), 0.0), False),
    ],
)
def test_the_verdict_compares_like_with_like(theirs, passes):
    """Rotors as bodies with our exact level, armature with our armature, whatever the policy was trained on."""
    bad, ours = figures(9.0, 9.0, 1.0), figures(0.1, 0.2, 0.0)
    simulations = {
        "ce_gym, none": bad,
        "ce_gym, exact": ours,
        "ce_gym, armature": bad,
        "MuJoCo, armature": bad,
        "MuJoCo, rotors as bodies": theirs,
    }
    found = verdicts(simulations)
    assert found["MuJoCo, rotors as bodies"]["passed"] is passes
    assert not found["MuJoCo, armature"]["passed"]  # nobody is on its feet
    assert found["MuJoCo, armature"]["error_ratio"] == 1.0
    text = comparison_table(
        {"simulations": simulations | {n: x | BLANK for n, x in simulations.items()}, "verdict": found}
    )
    assert ("passed" in text) is passes
    assert "FAILED" in text


BLANK = {"forward_error": 0.0, "lateral_error": 0.0, "episode_length": 1.0}


@pytest.mark.slow
def test_the_program_compares_four_simulations(tmp_path, capsys):
    small = ["num_envs=16", "rollout=8", "steps=300", "minibatches=2", "training={}"]
    policy = train(ROBOT_ENV, out=tmp_path, settings=small).policy
    capsys.readouterr()
    arguments = ["sim2sim", str(policy), "--episodes", "2", "--seconds", "0.2", "--json"]
    code = main(arguments)
    result = json.loads(capsys.readouterr().out)
    assert main([*arguments, str(tmp_path / "result.json")]) == code
    assert "Required in MuJoCo: at least" in capsys.readouterr().out
    assert result == json.loads((tmp_path / "result.json").read_text())
    simulations = result["simulations"]
    assert list(simulations) == ["ce_gym, exact", "ce_gym, armature", "MuJoCo, armature", "MuJoCo, rotors as bodies"]
    assert all(figures["episode_length"] == pytest.approx(0.2) for figures in simulations.values())
    assert result["passed"] is (code == 0)


@pytest.mark.slow
def test_mistakes_are_one_line(tmp_path, capsys, twins):
    assert main(["sim2sim", str(tmp_path / "missing.zip")]) == 2
    assert "\n" not in capsys.readouterr().err.strip()
    with pytest.raises(ValueError, match="expected one of armature, exact"):
        MujocoTwin(ce_gym.load_robot("mini_cheetah"), "none", 1)
    with pytest.raises(ValueError, match="expected 'joint_pd'"):
        twins("armature", robot=TRIPOD, actions="joint_torque")


def test_without_mujoco_it_says_what_to_install(monkeypatch, capsys):
    for name in (
        "mujoco",
        *(f"ce_gym.export.mujoco_{part}" for part in ("batch", "coordinates", "model", "twin")),
    ):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert main(["sim2sim", "mini_cheetah_velocity"]) == 2
    assert capsys.readouterr().err == 'ce_gym: needs mujoco, which is not installed: pip install "ce_gym[mjcf]"\n'
