"""Policies as files: commands take saved policies, and a specification describes their observations."""

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from point_mass import ID

import ce_gym
from ce_gym.__main__ import main
from ce_gym.policies import ACTIVATIONS, load_policy, save

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
sb3 = pytest.importorskip("stable_baselines3")
from ce_gym.adapters.sb3 import make_sb3_vec_env  # noqa: E402
from ce_gym.learn.evaluation.evaluation import evaluate  # noqa: E402

ROBOT_ENV = next(iter(ce_gym.environment_ids()))


def network(n_obs: int, n_actions: int, activation: str = "ELU", *last):
    torch.manual_seed(0)
    layers = torch.nn.Linear(n_obs, 32), getattr(torch.nn, activation)(), torch.nn.Linear(32, n_actions)
    return torch.nn.Sequential(*layers, *last)


def saved(file: Path, env=ID, **options) -> Path:
    """Save a random policy."""
    envs = gymnasium.make_vec(env, 1, vectorization_mode="vector_entry_point", **options)
    sizes = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    return save(network(*sizes), envs, file)


def command(*arguments) -> int:
    return main([str(argument) for argument in arguments])


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_onnx_acts_as_the_network(activation, tmp_path):
    module = network(2, 1, activation)
    module[0].weight.data *= 5
    module[2].weight.data *= 5
    policy = save(module, make_sb3_vec_env(ID, 1), tmp_path / "walk.npz")
    assert command("export", policy, "--out", tmp_path / "out.onnx") == 0
    obs = 3 * np.random.default_rng(0).standard_normal((500, 2)).astype(np.float32)
    with torch.no_grad():
        expected = module(torch.from_numpy(obs)).clamp(-1, 1).numpy()
    assert np.abs(expected).max() == 1.0  # some are clipped
    assert np.abs(expected).min() < 0.5
    for file in (policy, tmp_path / "out.onnx"):
        np.testing.assert_allclose(load_policy(file).predict(obs)[0], expected, rtol=0, atol=1e-5)


def test_the_specification_lies_in_the_file_and_beside_it(tmp_path):
    assert command("export", saved(tmp_path / "walk.npz", ROBOT_ENV), "--out", tmp_path / "out.onnx") == 0
    beside = json.loads((tmp_path / "out.json").read_text())
    entries = {entry.key: entry.value for entry in onnx.load(tmp_path / "out.onnx").metadata_props}
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


def test_a_saved_policy_has_the_results_of_the_original(tmp_path, capsys):
    envs = make_sb3_vec_env(ID, 4)
    learner = sb3.PPO("MlpPolicy", envs, device="cpu", seed=0)
    learner.policy.action_net.weight.data *= 30
    learner.policy.action_net.bias.data += 0.3
    learner.save(tmp_path / "walk.zip")
    expected = evaluate(learner, ID, episodes=64, seed=5)
    assert expected["falls"] > 0.1
    files = [save(learner, envs, tmp_path / name) for name in ("a.npz", "a.onnx")]
    assert command("export", files[0], "--out", tmp_path / "b.onnx") == 0
    named = ["--env", ID, "--env-arg", "horizon=50"]
    for arguments in ([files[0]], [files[1]], [tmp_path / "b.onnx"], [tmp_path / "walk.zip", *named]):
        capsys.readouterr()
        assert command("evaluate", *arguments, "--episodes", "64", "--seed", "5", "--json") == 0
        result = json.loads(capsys.readouterr().out)
        for key in ("falls", "velocity_error", "episode_length", "reward"):
            assert result[key] == pytest.approx(expected[key], rel=1e-4)


def test_an_onnx_file_is_exported_as_it_is(tmp_path):
    policy = save(network(2, 1, "SiLU", torch.nn.Tanh()), make_sb3_vec_env(ID, 1), tmp_path / "walk.onnx")
    assert command("export", policy) == 0
    assert (tmp_path / "exported.onnx").read_bytes() == policy.read_bytes()
    assert json.loads((tmp_path / "exported.json").read_text()) == load_policy(policy).record["policy_spec"]


def test_mistakes_are_one_line(tmp_path, capsys):
    path = saved(tmp_path / "policy.npz")
    (tmp_path / "not.onnx").write_bytes(b"not onnx")
    sb3.PPO("MlpPolicy", make_sb3_vec_env(ID, 1), device="cpu").save(tmp_path / "walk.zip")
    capsys.readouterr()
    cases = [
        (["export", tmp_path / "missing.zip"], "missing.zip: no such policy"),
        (["export", path, "--out", path.with_suffix(".onnx")], "not the policy's own"),
        (["export", path, "--out", tmp_path / "nowhere" / "out.onnx"], "cannot be written"),
        (["card", path], "policy.npz: resumed_from: missing; expected a policy that `python -m ce_gym train` wrote"),
        (["export", tmp_path / "not.onnx"], "not.onnx: not an ONNX file"),
        (["export", tmp_path / "walk.zip"], "walk.json: no such file: an archive of Stable-Baselines3"),
        (["evaluate", tmp_path / "walk.zip"], "walk.json: no such file: an archive of Stable-Baselines3"),
        (["evaluate", tmp_path / "walk.zip", "--env", ROBOT_ENV], "a layer takes 2 numbers; expected 48"),
        (["evaluate", tmp_path / "not.onnx"], "not.onnx"),
        (["evaluate", tmp_path / "no.onnx"], "no.onnx: no such policy"),
    ]
    for arguments, words in cases:
        assert command(*arguments) == 2
        error = capsys.readouterr().err.strip()
        assert words in error
        assert "\n" not in error
