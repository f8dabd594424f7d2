"""Evaluation of policies: the seed from their weights, suites of commands and pushes, levels of the ground."""

import hashlib
import json
import subprocess
import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from point_mass import ID, PointMassVectorEnv

import ce_gym
from ce_gym.__main__ import main
from ce_gym.learn.evaluation.episodes import (
    EVALUATION_SEED,
    LEVEL,
    open_environments,
    play,
    run_policy,
    weights_seed,
    without_curricula,
)
from ce_gym.learn.evaluation.evaluation import evaluate, report
from ce_gym.learn.evaluation.suites import SUITES, driver
from ce_gym.learn.evaluation.tables import suite_table
from ce_gym.policies import Actor, Policy, write_npz

RANGES = np.array([[-1.0, 2.0], [-0.5, 0.5], [-0.7, 0.9]])
DT = 0.02
RESTING = Policy(lambda rows: np.zeros((len(rows), 1), "f4"), {"observation_size": 2})


def test_the_seed_is_of_the_weights_and_of_nothing_else():
    rng = np.random.default_rng(0)
    layers = tuple((rng.standard_normal((4, 3)).astype("f4"), rng.standard_normal(4).astype("f4")) for _ in range(2))
    raw = b"".join(array.tobytes() for layer in layers for array in layer)
    expected = int(hashlib.sha256(raw).hexdigest()[:8], 16)
    policies = [Policy(Actor(layers, "Tanh"), {"seed": seed}) for seed in (0, 1)]
    assert [weights_seed(policy) for policy in policies] == [expected, expected]
    layers[1][1][2] = np.nextafter(layers[1][1][2], np.float32(9))
    assert weights_seed(policies[0]) != expected
    assert weights_seed(Policy(lambda rows: rows, {})) == EVALUATION_SEED


class Recorder:
    """Environments that record the calls of a driver."""

    def __init__(self, n):
        self.num_envs, self.metadata = n, {"render_fps": 1 / DT}
        self.commands, self.pushes, self.v = [], [], np.zeros((n, 7))
        self.batch = SimpleNamespace(rows=lambda _: np.zeros((n, 7)), write=self._write)

    def set_command(self, command):
        self.commands.append(command)

    def _write(self, name, rows):
        assert name == "v"
        self.pushes.append(rows)


def driven(name, seconds=20.0):
    native = Recorder(500)
    drive = driver(SUITES[name], native, RANGES, seed=1)
    for step in range(round(seconds / DT)):
        drive(step)
    return np.array(native.commands), np.array(native.pushes)


def test_suites_ask_for_what_they_say():
    for name, (low, high) in {
        "jumping": (RANGES[:, 0], RANGES[:, 1]),
        "standing": ([0, 0, 0], [0, 0, 0]),
        "turning": ([0, 0, -0.7], [0, 0, 0.9]),
        "backwards": ([-1, 0, 0], [-0.5, 0, 0]),
        "pushes": (RANGES[:, 0], RANGES[:, 1]),
    }.items():
        commands, pushes = driven(name)
        assert len(commands) == (20 if name == "jumping" else 4), name
        np.testing.assert_allclose(commands.min(axis=(0, 1)), low, atol=0.02, err_msg=name)
        np.testing.assert_allclose(commands.max(axis=(0, 1)), high, atol=0.02, err_msg=name)
        assert (commands >= np.array(low) - 1e-12).all(), name
        assert len(pushes) == (8 if name == "pushes" else 0), name
    assert np.abs(pushes[..., 3:5]).max() == pytest.approx(0.5, abs=0.01)
    assert not pushes[..., [0, 1, 2, 5, 6]].any()
    assert set(SUITES) == {"jumping", "standing", "turning", "backwards", "pushes"}


def test_who_is_never_sent_backwards_is_asked_to_stand():
    native = Recorder(3)
    driver(SUITES["backwards"], native, np.array([[0.5, 1.0], [0, 0], [0, 0]]), seed=0)(0)
    assert not np.array(native.commands).any()


def test_a_shipped_policy_is_judged_by_suite(capsys):
    """A robot that is told to stand moves less than one that is told to walk, and one that is pushed more."""
    assert main(["evaluate", "mini_cheetah_velocity", "--episodes", "8", "--suites", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["seed"] == weights_seed(ce_gym.load_policy("mini_cheetah_velocity"))
    suites = result["suites"]
    assert list(suites) == list(SUITES)
    assert all(suites["standing"]["velocity_error"] < suites[name]["velocity_error"] for name in ("jumping", "pushes"))
    assert suites["jumping"]["velocity_error"] > result["velocity_error"]
    assert "new commands every second" in suite_table(suites)


class OnLevels(PointMassVectorEnv):
    """Three levels of ground in turn."""

    def _ending(self, done):
        infos = super()._ending(done)
        infos["episode_terms"][LEVEL] = (np.arange(self.num_envs) % 3).astype(float)
        return infos


def test_falls_and_errors_are_told_by_level():
    gymnasium.register("test/OnLevels-v0", vector_entry_point=OnLevels)
    try:
        fleeing = Policy(lambda rows: np.float32(np.arange(len(rows)) % 3 == 2)[:, None], {"observation_size": 2})
        result = evaluate(fleeing, "test/OnLevels-v0", episodes=10)
    finally:
        del gymnasium.registry["test/OnLevels-v0"]
    levels = result["levels"]
    assert [(row["level"], row["episodes"], row["falls"]) for row in levels] == [(0, 4, 0.0), (1, 3, 0.0), (2, 3, 1.0)]
    seen = round(result["episode_length"] * 50 * 10) - 10  # the last step of an episode is not
    steps = [4 * 49, 3 * 49, seen - 7 * 49]
    assert np.average([row["forward_error"] for row in levels], weights=steps) == pytest.approx(result["forward_error"])
    assert levels[2]["forward_error"] > levels[0]["forward_error"]
    assert "| 2     |" in report(result)
    assert "levels" not in evaluate(fleeing, ID, episodes=2)


def test_environments_of_other_packages_are_evaluated():
    """Gymnasium's wrapper reports only return, length and time; time-outs and falls are distinguished all the same."""
    gymnasium.register(
        "test/Recorded-v0",
        vector_entry_point=lambda **kwargs: RecordEpisodeStatistics(PointMassVectorEnv(standard=True, **kwargs)),
    )
    try:
        fleeing = Policy(lambda rows: np.float32(np.arange(len(rows)) % 4 == 3)[:, None], {"observation_size": 2})
        result = evaluate(fleeing, "test/Recorded-v0", episodes=8, seed=3)
    finally:
        del gymnasium.registry["test/Recorded-v0"]
    own = evaluate(fleeing, ID, episodes=8, seed=3)
    assert (result["falls"], result["timed_out"], result["episodes"]) == (0.25, 0.75, 8)
    assert result["episode_length"] == pytest.approx(
        (6 * 50 + 2 * 15) / 8 / 50, abs=2 / 8 / 50
    )  # 15 or 16 steps of 0.2
    for key in ("forward_error", "episode_length", "falls"):
        assert result[key] == own[key], key
    assert result["reward"] == pytest.approx(own["reward"], rel=1e-5)


def test_a_robot_at_rest_has_the_error_of_its_command():
    with open_environments(ID, 5, 7) as (envs, _):
        commands = np.abs(envs.unwrapped.command)
    result = evaluate(RESTING, ID, episodes=5, seed=7)
    assert result["forward_error"] == pytest.approx(commands.mean())
    assert result["velocity_error"] == pytest.approx(commands.mean())
    assert result["lateral_error"] == result["yaw_rate_error"] == result["falls"] == 0.0
    assert result["reward"] == pytest.approx(50 * (1 - commands**2).mean(), rel=1e-5)
    assert result["episode_length"] == 1.0


def test_each_environment_counts_for_one_episode():
    """Environment 0 falls after 15 or 16 steps of 0.2 m/s, and then again after 30 or 31 steps of 0.1 m/s."""
    step = iter(range(100))

    def push(rows):
        force = np.zeros((len(rows), 1), "f4")
        force[0] = 1.0 if next(step) < 16 else 0.5
        return force

    result = evaluate(Policy(push, {"observation_size": 2}), ID, episodes=2)
    assert result["falls"] == 0.5
    assert result["episode_length"] in (65 / 2 / 50, 66 / 2 / 50)


def test_errors_refer_to_the_command_that_the_policy_has_seen():
    """The command before step k is k - 1, and the robot rests; the last of 50 steps does not count."""
    with open_environments(ID, 3, 0) as (envs, obs):
        native, first = envs.unwrapped, np.abs(obs[:, 1]).mean()

        def command(step):
            native.batch.write("command", np.full((3, 3), step))

        result = play(RESTING, envs, obs, command)
    assert result["forward_error"] == pytest.approx((first + sum(range(48))) / 49)


def test_progress_is_counted_in_steps_of_the_longest_episode(monkeypatch):
    bars = []

    def progress(items, label, total):
        bars.append((label, total))
        return iter(items)

    monkeypatch.setattr("ce_gym.learn.evaluation.episodes.progress", progress)
    evaluate(RESTING, ID, episodes=2, horizon=30)
    with open_environments(ID, 2, 0) as (envs, obs):
        assert len(list(run_policy(RESTING, envs, obs, steps=7, label="short"))) == 7
    assert bars == [("episodes", 30), ("short", 7)]


def test_evaluation_needs_neither_torch_nor_stable_baselines3():
    code = "import sys; sys.modules.update(torch=None, stable_baselines3=None); from ce_gym.__main__ import main; "
    code += "sys.exit(main(['evaluate', 'mini_cheetah_velocity', '--episodes', '2']))"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_judging_leaves_curricula_out():
    env_id = next(iter(ce_gym.environment_ids()))
    stairs = {"terrain": {"kind": "stairs", "rise": 0.08}, "command_curriculum": 0.3, "history": 2}
    changed = without_curricula(env_id, stairs)
    assert changed == stairs | {
        "terrain": {"kind": "stairs", "rise": 0.08, "curriculum": False},
        "command_curriculum": 1,
    }
    assert without_curricula(env_id, {"terrain": "rough"}) == {"terrain": {"kind": "rough", "curriculum": False}}
    assert without_curricula(env_id, {"terrain": "flat"}) == {"terrain": "flat"}
    gymnasium.register("test/Rough-v0", vector_entry_point=PointMassVectorEnv, kwargs={"terrain": "rough"})
    try:
        assert without_curricula("test/Rough-v0", {}) == {"terrain": {"kind": "rough", "curriculum": False}}
    finally:
        del gymnasium.registry["test/Rough-v0"]


def test_a_task_without_commands_has_no_suites(tmp_path, capsys):
    layers = ((np.zeros((1, 2), "f4"), np.zeros(1, "f4")),)
    record = {"env": ID, "env_kwargs": {}, "transmission": "exact", "observation_size": 2, "action_size": 1}
    write_npz(Actor(layers, "Tanh"), record | {"activation": "Tanh", "policy_spec": {}}, tmp_path / "policy.npz")
    assert main(["evaluate", str(tmp_path / "policy.npz"), "--episodes", "2", "--suites"]) == 2
    error = capsys.readouterr().err
    assert "has no commanded velocities" in error
    assert error.count("\n") == 1
