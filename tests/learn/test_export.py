"""Policies as files: commands take saved policies, and a specification describes their observations."""

import ctypes
import json
import shutil
import subprocess
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from point_mass import ID

import ce_gym
from ce_gym.__main__ import main
from ce_gym.model.frames import rotation_matrix
from ce_gym.policies import ACTIVATIONS, Actor, load_policy, read_actor, save, write_npz
from ce_gym.policies.exports import WITHOUT_SOURCES

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
    state["gravity"] = -rotation_matrix(state["q"][:, 3:7])[:, 2]
    start, found = 0, 0
    for block in envs.policy_spec()["observation"]["blocks"]:
        rows = slice(start, start + block["size"])
        start += block["size"]
        if "of" in block:
            rebuilt = np.array(block["offset"]) + np.array(block["scale"]) * state[block["of"]][:, block["rows"]]
            np.testing.assert_allclose(rebuilt, obs[:, rows], atol=1e-6)
            found += block["size"]
    assert start == obs.shape[1]
    assert found == start


def test_the_gait_clock_of_the_specification():
    envs = gymnasium.make_vec("ce_gym/MitHumanoidVelocity-v0", 2, observations=["gait_phase"]).unwrapped
    envs.reset(seed=0)
    spec = envs.policy_spec()
    assert spec["observation"]["blocks"][0]["of"] == "gait"
    for step in range(1, 4):
        obs, *_ = envs.step(np.zeros(envs.action_space.shape, np.float32))
        phase = 2 * np.pi * step * spec["control_dt"] / spec["gait_period"]
        np.testing.assert_allclose(obs, np.tile([np.sin(phase), np.cos(phase)], (2, 1)), atol=1e-6)


def test_latency_is_in_seconds():
    envs = gymnasium.make_vec(ROBOT_ENV, 1, latency=(1, 3)).unwrapped
    assert envs.policy_spec()["latency"] == pytest.approx([0.005, 0.015])


def test_looking_needs_all_that_is_looked_at():
    envs = gymnasium.make_vec(ROBOT_ENV, 2).unwrapped
    with pytest.raises(ValueError, match="the state lacks command"):
        envs.look({"q": np.zeros((2, 19)), "v": np.zeros((2, 18)), "action": np.zeros((2, 12))})


def test_metadata_has_the_keys_of_mjlab(tmp_path):
    command("export", saved(tmp_path / "walk.npz", ROBOT_ENV), "--out", tmp_path / "out.onnx", tmp_path / "out.pt")
    spec, extra = json.loads((tmp_path / "out.json").read_text()), dict.fromkeys(("joint_names", "action_scale"), "")
    found = {entry.key: entry.value for entry in onnx.load(tmp_path / "out.onnx").metadata_props}
    assert found["joint_names"].split(",") == spec["joints"]
    expected = {"joint_stiffness": spec["kp"], "joint_damping": spec["kd"], "default_joint_pos": spec["default_pose"]}
    expected["action_scale"] = spec["action"]["scale"]
    for key, numbers in expected.items():
        np.testing.assert_array_equal([float(x) for x in found[key].split(",")], numbers)
    assert found["observation_names"].split(",") == [block["name"] for block in spec["observation"]["blocks"]]
    assert found["command_names"] == "velocity_command"
    torch.jit.load(tmp_path / "out.pt", _extra_files=extra)
    assert {key: x.decode() for key, x in extra.items()} == {key: found[key] for key in extra}


def compiled_act(header: Path):
    """Return `policy_act` of a header as a function of observations (n, n_obs)."""
    compiler = shutil.which("cc") or pytest.skip("needs a C compiler")
    source, library = header.with_suffix(".c"), header.with_suffix(".so")
    source.write_text(f'#include "{header.name}"\nvoid act(const float *x, float *y) {{ policy_act(x, y); }}\n')
    options = ["-std=c99", "-O2", "-Wall", "-Wno-unused", "-Wno-unused-const-variable", "-Werror", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, source, "-o", library, "-lm"], check=True)
    function = ctypes.CDLL(str(library)).act

    def act(observations):
        rows, pointer = np.ascontiguousarray(observations, np.float32), ctypes.POINTER(ctypes.c_float)
        actions = np.zeros((len(rows), 12), np.float32)
        for x, y in zip(rows, actions, strict=True):
            function(x.ctypes.data_as(pointer), y.ctypes.data_as(pointer))
        return actions

    return act


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("normalised", [False, True])
def test_every_format_acts_as_the_policy(activation, normalised, tmp_path):
    rng = np.random.default_rng(0)
    obs = 3 * rng.standard_normal((200, 48)).astype(np.float32)
    layers = tuple(
        (rng.standard_normal((n, m)) / 4, rng.standard_normal(n) / 4) for m, n in ((48, 16), (16, 16), (16, 12))
    )
    rows = np.stack([np.full(48, 0.3), np.full(48, 2.0), np.full(48, 1.0)]) if normalised else None
    actor = Actor(layers, activation, rows)
    policy = save(actor, gymnasium.make_vec(ROBOT_ENV, 1, vectorization_mode="vector_entry_point"), tmp_path / "w.npz")
    expected = load_policy(policy).predict(obs)[0]
    assert np.ptp(expected) > 0.5
    outs = [tmp_path / f"out{suffix}" for suffix in (".onnx", ".pt", ".h", ".npz")]
    assert command("export", policy, "--out", *outs) == 0
    scripted = torch.jit.load(outs[1])
    acts = [load_policy(outs[0]).act, lambda x: scripted(torch.from_numpy(x)).numpy(), compiled_act(outs[2])]
    for act in (*acts, load_policy(outs[3]).act):
        np.testing.assert_allclose(act(obs), expected, rtol=0, atol=1e-5)


def test_the_latency_of_training_is_exported(tmp_path):
    policy = saved(tmp_path / "walk.npz", ROBOT_ENV)
    actor, record = read_actor(policy)
    write_npz(actor, {**record, "settings": {"training": {"latency": [0, 4]}}}, policy)
    assert command("export", policy, "--out", tmp_path / "out.onnx") == 0
    assert json.loads((tmp_path / "out.json").read_text())["latency"] == pytest.approx([0, 0.02])


def test_what_c_lacks_is_said(tmp_path, capsys):
    for options, words in (
        ({"actions": "joint_torque"}, "actions='joint_torque'; expected 'joint_pd', for C"),
        ({"observations": ["torques"]}, "observation block torques: has no formula"),
    ):
        policy = saved(tmp_path / "walk.npz", ROBOT_ENV, **options)
        assert command("export", policy, "--out", tmp_path / "out.h") == 2
        assert words in capsys.readouterr().err


def test_an_older_policy_gets_sources_and_names_of_joints(tmp_path):
    policy = saved(tmp_path / "walk.npz", ROBOT_ENV)
    actor, record = read_actor(policy)
    spec = record["policy_spec"]
    old = {**spec, "format": WITHOUT_SOURCES, "joints": ["link"] * 12}
    write_npz(actor, {**record, "policy_spec": old}, policy)
    assert command("export", policy, "--out", tmp_path / "out.h") == 0
    assert json.loads((tmp_path / "out.json").read_text()) == spec


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
    (tmp_path / "record.json").write_text('{"env": "ce_gym/MiniCheetahStand-v0"}')
    sb3.PPO("MlpPolicy", make_sb3_vec_env(ID, 1), device="cpu").save(tmp_path / "walk.zip")
    capsys.readouterr()
    cases = [
        (["export", tmp_path / "missing.zip"], "missing.zip: no such policy"),
        (
            ["export", path, "--out", tmp_path / "record.onnx"],
            "record.json: cannot be written: exists already",
        ),
        (["export", path, "--out", tmp_path / "nowhere" / "out.onnx"], "cannot be written"),
        (
            ["export", path, "--out", tmp_path / "out.tflite"],
            "expected a name that ends in one of .onnx, .pt, .h",
        ),
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
