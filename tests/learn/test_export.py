"""Policies as files: ONNX acts as the learner does, and a specification describes its observation."""

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from point_mass import ID
from saved import load_learner
from toy import job

import ce_gym
from ce_gym.learn.evaluation.evaluation import evaluate
from ce_gym.learn.evaluation.evaluation import main as evaluate_main
from ce_gym.learn.learners.sb3 import train
from ce_gym.policies import ACTIVATIONS, load_policy

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
from ce_gym.learn.export import main  # noqa: E402

ROBOT_ENV = next(iter(ce_gym.environment_ids()))
SMALL = ["num_envs=16", "rollout=8", "minibatches=2", "epochs=1", "hidden=[32, 16]"]


def trained_policy(out: Path, *settings: str, env=ID, **env_kwargs) -> Path:
    return train(job(out, 300, env, [*SMALL, *settings], env_kwargs=env_kwargs)).policy


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A robot's policy, hardly trained, and its ONNX file."""
    path = trained_policy(tmp_path_factory.mktemp("robot"), "initial_std=2.0", env=ROBOT_ENV)
    assert main([str(path), str(path.parent / "out.onnx")]) == 0
    return path


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_onnx_acts_as_the_learner(activation, tmp_path):
    rate = 0.03 if activation == "Softplus" else 0.1  # fast enough that some are clipped, not so that all are
    path = trained_policy(tmp_path, f"activation={activation}", f"learning_rate={rate}", "target_kl=0")
    assert main([str(path), str(tmp_path / "out.onnx")]) == 0
    obs = 3 * np.random.default_rng(0).standard_normal((500, 2)).astype(np.float32)
    expected, _ = load_learner(path)[0].predict(obs, deterministic=True)
    assert np.abs(expected).max() == 1.0 or activation in ("Sigmoid", "Softplus")  # some are clipped
    assert np.ptp(expected) > 0.05
    for file in (path, tmp_path / "out.onnx"):
        actions, _ = load_policy(file).predict(obs)
        np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)


def test_onnx_of_a_robot_acts_as_the_learner(policy):
    size = load_policy(policy).record["observation_size"]
    obs = np.random.default_rng(1).standard_normal((64, size)).astype(np.float32)
    expected, _ = load_learner(policy)[0].predict(obs, deterministic=True)
    np.testing.assert_allclose(load_policy(policy.parent / "out.onnx").predict(obs)[0], expected, rtol=0, atol=1e-5)


def test_an_asymmetric_policy_needs_no_critic_to_act(tmp_path):
    path = trained_policy(tmp_path, obs_mode="dict")
    assert main([str(path), str(tmp_path / "out.onnx")]) == 0
    rng = np.random.default_rng(2)
    obs = {key: rng.standard_normal((9, size)).astype(np.float32) for key, size in (("policy", 2), ("critic", 3))}
    expected, _ = load_learner(path)[0].predict(obs, deterministic=True)
    np.testing.assert_allclose(load_policy(tmp_path / "out.onnx").predict(obs["policy"])[0], expected, atol=1e-5)


def test_the_specification_lies_in_the_file_and_beside_it(policy):
    beside = json.loads((policy.parent / "out.json").read_text())
    entries = {entry.key: entry.value for entry in onnx.load(policy.parent / "out.onnx").metadata_props}
    assert beside == gymnasium.make_vec(ROBOT_ENV, 1).unwrapped.policy_spec()
    assert json.loads(entries["joints"]) == beside["joints"]
    assert json.loads(entries["observation"]) == beside["observation"]
    assert entries["transmission"] == beside["transmission"] == "exact"
    assert json.loads(entries["ce_gym_policy"])["env"] == ROBOT_ENV


def test_the_specification_rebuilds_observations():
    """From the specification alone, and from the environment's own terms, on states the environment has been in."""
    envs = gymnasium.make_vec(ROBOT_ENV, 5).unwrapped
    envs.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        obs, *_ = envs.step(action)
    state = {**envs.state(), "action": action}
    np.testing.assert_array_equal(envs.look(state)[0], obs)
    start, found = 0, 0
    for block in envs.policy_spec()["observation"]["blocks"]:
        rows = slice(start, start + block["size"])
        start += block["size"]
        if "of" in block:
            rebuilt = np.array(block["offset"]) + np.array(block["scale"]) * state[block["of"]][:, block["rows"]]
            np.testing.assert_allclose(rebuilt, obs[:, rows], atol=1e-6)
            found += block["size"]
    assert start == obs.shape[1]
    assert found == start - 3  # all but the direction of gravity


def test_looking_needs_all_that_is_looked_at():
    envs = gymnasium.make_vec(ROBOT_ENV, 2).unwrapped
    with pytest.raises(ValueError, match="the state lacks command"):
        envs.look({"q": np.zeros((2, 19)), "v": np.zeros((2, 18)), "action": np.zeros((2, 12))})


def test_an_episode_that_ends_is_seen_to_end():
    envs = gymnasium.make_vec(ROBOT_ENV, 2).unwrapped
    envs.reset(seed=0)
    state = {**envs.state(), "action": np.zeros((2, 12))}
    state["q"][1, 3:7] = (0, 1, 0, 0)  # on its back
    assert envs.look(state)[1].tolist() == [False, True]


def test_an_onnx_file_is_judged_as_the_policy(tmp_path, capsys):
    path = trained_policy(tmp_path)
    assert main([str(path)]) == 0
    capsys.readouterr()
    assert evaluate_main([str(tmp_path / "exported.onnx"), "--episodes", "8", "--json"]) == 0
    judged = json.loads(capsys.readouterr().out)
    assert judged["reward"] == pytest.approx(evaluate(load_learner(path)[0], ID, episodes=8)["reward"], rel=1e-4)


def test_mistakes_are_one_line(tmp_path, capsys):
    path = trained_policy(tmp_path)
    (tmp_path / "not.onnx").write_bytes(b"not onnx")
    record = path.with_suffix(".json")
    capsys.readouterr()
    cases = [
        (main, [str(tmp_path / "missing.zip")], "missing.zip: no such policy"),
        (main, [str(path), str(path.with_suffix(".onnx"))], "not the policy's own"),
        (main, [str(path), str(tmp_path / "nowhere" / "out.onnx")], "cannot be written"),
        (evaluate_main, [str(tmp_path / "not.onnx")], "not.onnx"),
        (evaluate_main, [str(tmp_path / "no.onnx")], "no.onnx: no such policy"),
    ]
    for function, arguments, words in cases:
        assert function(arguments) == 2
        error = capsys.readouterr().err.strip()
        assert words in error
        assert "\n" not in error
    record.write_text(json.dumps({k: v for k, v in json.loads(record.read_text()).items() if k != "policy_spec"}))
    assert main([str(path)]) == 2
    assert "policy_spec: missing" in capsys.readouterr().err
