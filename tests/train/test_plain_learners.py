"""Learners of other libraries that `train/table.py` times: their runs give checkpoints and policies as ours do."""

import importlib

import numpy as np
import pytest
import torch
from job import Job
from point_mass import ID
from settings import config_file, load_settings
from table import LEARNERS, checkpoints, judge

from ce_gym.policies import load_policy

NEEDS = {"plain_sb3": "stable_baselines3", "plain_sbx": "sbx", "plain_rsl_rl": "rsl_rl", "clean_ppo": "torch"}
SETTINGS = ["steps=20000", "num_envs=64", "rollout=16", "hidden=[16]", "epochs=4", "minibatches=2", "gamma=0.9"]
SETTINGS += ["learning_rate=1e-2", "target_kl=0", "entropy=0"]


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", NEEDS)
def test_a_point_mass_is_learned_and_kept(tmp_path, name):
    pytest.importorskip(NEEDS[name])
    settings = load_settings(config_file(ID), SETTINGS)
    trained = importlib.import_module(LEARNERS[name]).train(Job(ID, settings, tmp_path, {}, seed=3))
    kept = [load_policy(path) for path in (*checkpoints(trained.policy), trained.policy)]
    steps = [policy.record["steps"] for policy in kept]
    assert len(steps) >= 8
    assert steps == sorted(steps)
    assert 20000 <= steps[-1] < 20000 + 64 * 16
    seen = np.random.default_rng(0).normal(size=(5, kept[-1].record["observation_size"]))
    np.testing.assert_allclose(kept[-1].act(seen), trained.model.act(seen))
    judged = [judge(path, ID, 64, {}) for path in (checkpoints(trained.policy)[0], trained.policy)]
    assert judged[1]["forward_error"] < 0.5 * judged[0]["forward_error"]
    assert sum(judged[1][kind] for kind in ("physics", "policy", "learning")) == pytest.approx(1)
