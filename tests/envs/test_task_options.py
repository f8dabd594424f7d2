"""What a task can be told: actions, latency, noise, history, randomisation, pushes, heading, terms of one's own."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.tasks import deployable

VELOCITY = "ce_gym/MiniCheetahVelocity-v0"


def make(n: int = 4, **arguments):
    envs = gymnasium.make_vec(VELOCITY, num_envs=n, autoreset_mode="SameStep", **{"robot": TRIPOD, **arguments})
    envs.reset(seed=0)
    return envs


def zeros(envs) -> np.ndarray:
    return np.zeros(envs.action_space.shape, np.float32)


@pytest.mark.slow
def test_a_term_of_ones_own():
    @ce_gym.reward
    def twice_the_height(s):
        return 2 * s.base_height

    envs = make(rewards={"twice_the_height": 3.0})
    _, _, _, _, infos = envs.step(zeros(envs))
    expected = 3.0 * 2 * envs.state()["q"][:, 2] * envs.dt
    np.testing.assert_allclose(infos["reward_terms"]["twice_the_height"], expected, rtol=1e-12)

    def other(s):
        return -s.base_height

    other.__name__ = "twice_the_height"
    ce_gym.reward(other)  # another function under the same name is another program
    changed = make(rewards={"twice_the_height": 3.0})
    _, _, _, _, infos = changed.step(zeros(changed))
    np.testing.assert_allclose(infos["reward_terms"]["twice_the_height"], -expected / 2, rtol=1e-12)
    with pytest.raises(ValueError, match="the package has one of this name"):

        @ce_gym.reward
        def torques(s):
            return 0


def test_joint_torques_as_actions():
    envs = make(actions="joint_torque", contacts=(), reset_noise={"joint_position": 0.0})
    limits = np.array([envs.model.robot.body(name).joint.torque for name in envs.model.joint_links])
    envs.step(zeros(envs) + 0.5)
    np.testing.assert_allclose(envs.batch.rows("torque"), np.tile(0.5 * limits, (4, 1)))


def test_only_some_joints_act():
    envs = make(action_joints=["fore*"])
    assert envs.single_action_space.shape == (1,)
    envs.step(zeros(envs) + 1.0)
    names = envs.model.joint_links
    torque = envs.batch.rows("torque")
    still = [i for i, name in enumerate(names) if not name.startswith("fore")]
    assert np.abs(torque[:, [i for i in range(2) if i not in still]]).min() > np.abs(torque[:, still]).mean()


@pytest.mark.slow
def test_late_actions():
    """A delay of all sub-steps is the action of the step before; of none, the present one."""
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 4, 2)).astype(np.float32)
    plain, late, punctual = make(), make(latency=(4, 4)), make(latency=(0, 0))
    held = zeros(plain)
    for action in actions:
        late.step(action)
        plain.step(held)
        held = action
        np.testing.assert_allclose(late.state()["q"], plain.state()["q"], atol=1e-12)
    assert "delay" not in punctual.batch.program.state_sizes
    drawn = make(256, latency=(0, 3)).batch.rows("delay")[:, 0]
    assert set(drawn) == {0.0, 1.0, 2.0, 3.0}


def test_history_shows_the_newest_first():
    envs = make(history=3)
    size = sum(envs.observation_structure.values())
    assert envs.single_observation_space.shape == (3 * size,)
    first, _ = envs.reset(seed=1)
    np.testing.assert_array_equal(first[:, :size], first[:, 2 * size :])
    second, *_ = envs.step(zeros(envs))
    third, *_ = envs.step(zeros(envs))
    np.testing.assert_array_equal(third[:, size : 2 * size], second[:, :size])
    np.testing.assert_array_equal(third[:, 2 * size :], first[:, :size])


def test_deployable_observations_are_those_of_the_task_without_unmeasured_ones():
    observed = {robot: make_program(robot, "velocity", observations="deployable") for robot in ("go2", "mit_humanoid")}
    blocks = ["gyro", "projected_gravity", "velocity_command", "joint_positions", "joint_velocities", "last_action"]
    assert list(observed["go2"].observation_sizes) == blocks
    assert list(observed["mit_humanoid"].observation_sizes) == [*blocks, "gait_phase"]
    named = {"base_height": {}, "joint_positions": {}, "base_angular_velocity": {"scale": 2.0}}
    assert deployable(named) == {"joint_positions": {}, "gyro": {"scale": 2.0}}
    assert deployable(("projected_gravity",)) == ("projected_gravity",)


@pytest.mark.slow
def test_noise_is_for_the_policy_only():
    arguments = {"critic": ["contact_forces", "rotor_speeds", "torques"], "obs_mode": "dict"}
    clean, noisy = make(512, **arguments), make(512, noise={"joint_positions": 0.05}, **arguments)
    a, *_ = clean.step(zeros(clean))
    b, *_ = noisy.step(zeros(noisy))
    structure = clean.observation_structure
    start = sum(n for name, n in list(structure.items())[: list(structure).index("joint_positions")])
    difference = b["policy"] - a["policy"]
    joints = difference[:, start : start + 2]
    assert np.abs(joints).max() <= 0.05 + 1e-6
    assert np.std(joints) == pytest.approx(0.05 / np.sqrt(3), rel=0.05)
    assert np.abs(np.delete(difference, np.arange(start, start + 2), axis=1)).max() == 0
    np.testing.assert_array_equal(a["critic"], b["critic"])
    np.testing.assert_array_equal(a["critic"][:, : sum(structure.values())], a["policy"])
    assert a["critic"].shape[1] == sum(structure.values()) + 4 + 2 + 2
    assert noisy.observation_space.contains(b)


def test_randomised_figures_change_the_motion_and_are_seen_by_the_critic():
    ranges = {"friction": (0.3, 1.2), "added_mass": (-1.0, 3.0), "com_shift": (-0.03, 0.03), "kp": (0.8, 1.2)}
    ranges |= {"motor_strength": (0.9, 1.1), "rotor_inertia": (0.5, 2.0), "ratio": (0.95, 1.05)}
    envs = make(1024, randomise=ranges, critic=["parameters"], obs_mode="dict")
    values = envs.batch.rows("parameters")
    assert values.shape == (1024, 1 + 1 + 3 + 2 + 1 + 1 + 1)
    assert 0.95 <= values[:, -1].min() < values[:, -1].max() <= 1.05
    assert 0.3 <= values[:, 0].min() < 0.35
    assert 1.15 < values[:, 0].max() <= 1.2
    np.testing.assert_allclose(values.mean(0)[:5], [0.75, 1.0, 0, 0, 0], atol=0.1)
    observation, *_ = envs.step(zeros(envs))
    seen = observation["critic"][:, -values.shape[1] :]
    np.testing.assert_allclose(seen[:, 0], (values[:, 0] - 0.75) / 0.45, atol=1e-6)
    before = values.copy()
    envs.reset(options={"reset_mask": np.arange(1024) < 10})
    changed = (envs.batch.rows("parameters") != before).any(1)
    assert changed[:10].all()
    assert not changed[10:].any()
    with pytest.raises(ValueError, match="randomise='colour'"):
        make(randomise={"colour": (0, 1)})


def test_pushes_come_on_time():
    calm, pushed = make(64), make(64, push_period=0.1, push_speed=1.0)
    for step in range(1, 11):
        calm.step(zeros(calm))
        pushed.step(zeros(pushed))
        difference = pushed.state()["v"] - calm.state()["v"]
        assert (np.abs(difference).max() > 0) == (step >= 5)
        if step == 5:
            assert np.abs(difference[:, [0, 1, 2, 5]]).max() == 0
            assert 0.8 < np.abs(difference[:, 3:5]).max() <= 1.0


def test_headings_are_turned_to():
    envs = make(256, heading=True, standing_fraction=0.0)
    envs.step(zeros(envs))
    state, heading = envs.state(), envs.batch.rows("heading")[:, 0]
    w, x, y, z = state["q"][:, 3:7].T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    error = np.angle(np.exp(1j * (heading - yaw)))
    np.testing.assert_allclose(state["command"][:, 2], np.clip(0.5 * error, -1, 1), atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"colour": 3}, "unexpected keyword argument 'colour'"),
        ({"actions": "telepathy"}, "actions='telepathy'; expected 'joint_pd'"),
        ({"history": 0}, "history=0; expected a whole number"),
        ({"latency": (2, 1)}, "latency=.*; expected a pair"),
        ({"noise": {"smell": 1.0}}, "noise='smell'; expected an observation"),
        ({"action_joints": ["*wing*"]}, "action_joints=.*; expected patterns"),
        ({"command_range": ((0, 1),)}, "command_range=.*; expected three pairs"),
        ({"push_period": -1}, "push_period=-1; expected a number, 0 or more"),
        ({"heading": 1}, "heading=1; expected true or false"),
        ({"rewards": {"torques": "much"}}, r"rewards\['torques'\]='much'; expected a finite number"),
        ({"rewards": ["torques"]}, r"rewards=\['torques'\]; expected weights, or mappings"),
        ({"rewards": {"torques": float("nan")}}, r"rewards\['torques'\]=nan; expected a finite number"),
        ({"observations": ["smell"]}, "no observation term 'smell'; expected one of"),
        ({"observations": []}, r"observations=\(\); expected at least one name"),
        ({"terminations": ["boredom"]}, "no termination term 'boredom'"),
        ({"metrics": ["luck"]}, "no metric term 'luck'"),
        ({"critic": ["luck"]}, "no observation term 'luck'"),
        ({"contacts": ["wing"]}, "contacts='wing'; expected 'all', groups or names"),
        ({"dt": 0.5}, "dt=0.5; expected a positive number, at most 0.1 s"),
        ({"standing_fraction": 2.0}, "standing_fraction=2.0; expected a number between 0 and 1"),
        ({"noise": {"joint_positions": -1.0}}, r"noise\['joint_positions'\]=-1.0; expected 0 or more"),
        ({"reset_noise": {"joint": 1.0}}, "reset_noise='joint'; expected one of joint_position"),
        ({"randomise": {"kp": (-2, 1)}}, r"randomise\['kp'\]=\(-2.0, 1.0\); expected 0 or more"),
        ({"randomise": {"ratio": (0, 0)}}, r"randomise\['ratio'\]=\(0.0, 0.0\); expected more than 0"),
        (
            {"randomise": {"added_mass": (-9, 0)}},
            r"randomise\['added_mass'\]=\(-9.0, 0.0\); expected more than -3 kg",
        ),
        ({"latency": (0, 9)}, "latency=.*; expected at most the 4 sub-steps"),
        ({"history": True}, "history=True; expected a whole number"),
        ({"num_threads": True}, "num_threads=True; expected a whole number"),
        ({"max_episode_steps": 0}, "max_episode_steps=0; expected a whole number"),
        ({"contact_forces": "yes"}, "contact_forces='yes'; expected true or false"),
        ({"task": ["velocity"]}, r"task=\['velocity'\]; expected one of"),
        ({"robot": 3}, "robot=3; expected the name of a robot"),
        ({"obs_mode": "image"}, "obs_mode='image'"),
    ],
)
def test_bad_arguments(arguments: dict, message: str):
    with pytest.raises(ValueError, match=message) as caught:
        make(**arguments)
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is None


@pytest.mark.slow
def test_steps_of_their_own():
    """Every environment to its tolerance: alone as among others, and to what finer steps of one length give."""
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 3, make(3).single_action_space.shape[0])).astype(np.float32)

    def ends(n: int, **arguments) -> tuple[np.ndarray, np.ndarray]:
        envs = make(n, contacts=("foot",), terminations=(), **arguments)
        for action in actions:
            rewards = envs.step(action[:n])[1]
        return envs.state()["q"], rewards

    adaptive = {"method": "adaptive", "tolerance": 1e-4, "dt": 0.02, "n_substeps": 1}
    (q, rewards), (fine, _) = ends(3, **adaptive), ends(3, method="extrapolated", dt=2e-5, n_substeps=1000)
    (alone, reward) = ends(1, **adaptive)
    np.testing.assert_array_equal(alone[0], q[0])
    np.testing.assert_array_equal(reward, rewards[:1])
    assert 0 < np.abs(q - fine).max() < 30e-4
    coarse, _ = ends(3, method="extrapolated", dt=0.02, n_substeps=1)
    assert np.abs(coarse - fine).max() > 10 * np.abs(q - fine).max()


def test_methods_that_do_not_fit():
    with pytest.raises(ValueError, match=r"tolerance=0.001; expected None, because method is 'euler'"):
        make(tolerance=1e-3)
    with pytest.raises(ValueError, match=r"method='leapfrog'; expected 'euler' or"):
        make(method="leapfrog")
    with pytest.raises(ValueError, match=r"control step with method='adaptive'; expected 'euler'"):
        make(method="adaptive").unwrapped.differentiable()
