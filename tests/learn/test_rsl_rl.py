"""rsl_rl's own PPO learns on our environments, and leaves a policy that the other programs read."""

import json

import numpy as np
import pytest

pytest.importorskip("rsl_rl")
import torch
from point_mass import ID
from rsl_rl_ppo import actor_of, main, train
from toy import SMALL

from ce_gym.adapters.rsl_rl import make_rsl_rl_vec_env
from ce_gym.learn.evaluation.evaluation import evaluate
from ce_gym.learn.evaluation.evaluation import main as evaluate_main
from ce_gym.learn.runs.job import basic_record
from ce_gym.learn.runs.settings import config_file, load_settings
from ce_gym.policies import Policy, load_policy


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("obs_mode", ["vector", "dict"])
def test_it_learns(obs_mode, capsys):
    settings = load_settings(config_file(ID), [*SMALL, "steps=30e3"])
    envs = make_rsl_rl_vec_env(ID, settings.num_envs, obs_mode=obs_mode)
    runner = train(envs, settings, seed=0)
    assert runner.alg.critic.obs_groups == ["critic" if obs_mode == "dict" else "policy"]
    actor = actor_of(runner, settings.activation)
    policy = Policy(actor, basic_record(envs.envs.unwrapped, ID, {}, settings))
    result = evaluate(policy, ID, episodes=32)
    assert result["forward_error"] < 0.15  # half a unit without learning
    assert result["falls"] == 0.0
    obs = envs.get_observations()
    expected = runner.get_inference_policy()(obs).detach().clamp(-1, 1).numpy()
    np.testing.assert_allclose(actor(obs["policy"].numpy()), expected, atol=1e-6)


def test_the_program_leaves_a_policy_with_its_contract(tmp_path, capsys):
    arguments = ["--env", ID, "--steps", "3e3", "--episodes", "4", "--out", str(tmp_path), "--set", *SMALL]
    assert main(arguments) == 0
    assert capsys.readouterr().out.strip().splitlines()[-1] == str(tmp_path / "policy.onnx")
    assert load_policy(tmp_path / "policy.onnx").record["env"] == ID
    assert json.loads((tmp_path / "policy.json").read_text())["joints"] == ["slider"]
    assert evaluate_main([str(tmp_path / "policy.onnx"), "--episodes", "4"]) == 0
    assert list(tmp_path.glob("model_*.pt"))


def test_mistakes_are_one_line(capsys, tmp_path):
    assert main(["--env", "nobody/Nothing-v0", "--out", str(tmp_path)]) == 2
    assert "nobody" in capsys.readouterr().err
    assert main(["--env", ID, "--set", "gamma=x", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert "gamma" in error
    assert "\n" not in error
