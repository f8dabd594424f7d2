"""The reference learner alone: resuming from files, seeds, evaluation."""

import base64
import contextlib
import json
import os
import pickle
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from point_mass import ID
from saved import load_learner
from toy import FAST, job

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.learn.evaluate.evaluation import evaluate
from ce_gym.learn.evaluate.transfer import main as transfer_main
from ce_gym.learn.learners.sb3 import main, make_learner, train
from ce_gym.learn.learners.sb3_callbacks import AdaptiveLearningRate
from ce_gym.learn.runs.progress import read_curve
from ce_gym.model.mechanism import LEVELS
from ce_gym.policies import PolicyError, load_policy

QUICK = ["--no-tensorboard", "--episodes", "4", "--threads", "1"]
ADAPTED = ["num_envs=16", "epochs=1", "target_kl=0.01", "learning_rate=1e-3"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(job(tmp_path_factory.mktemp("run"), 512, settings=ADAPTED)).policy


def test_a_damaged_curve_is_one_line(tmp_path):
    (tmp_path / "curve.csv").write_text("steps,seconds\n1,2\n")
    with pytest.raises(ValueError, match="expected the columns steps, seconds, reward, length"):
        read_curve(tmp_path / "curve.csv")
    assert read_curve(tmp_path / "none.csv") == []


def test_seeds_differ_and_the_same_seed_trains_the_same_policy(tmp_path):
    argv = ["--env", ID, "--steps", "2000", "--seeds", "5", "1", "--out", str(tmp_path), *FAST]
    assert main(argv) == 0
    first, other = (load_learner(tmp_path / f"seed_{seed}" / "policy.zip")[0] for seed in (5, 1))
    again = train(job(tmp_path / "again", 2000, seed=5)).model
    first, other, again = (model.policy.state_dict() for model in (first, other, again))
    for key, value in first.items():
        assert np.array_equal(value, again[key]), key
    assert not np.array_equal(first["action_net.weight"], other["action_net.weight"])


def test_levels_reach_the_environment(trained, capsys):
    assert transfer_main([str(trained), "--episodes", "8", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)["policies"][0]["results"]
    assert tuple(results) == LEVELS
    assert results["exact"] == results["coupled"]  # the toy does not tell these two apart
    assert results["exact"]["reward"] != results["none"]["reward"]
    assert transfer_main([str(trained), "--episodes", "8"]) == 0
    assert "exact *" in capsys.readouterr().out


def test_evaluation_is_repeatable_and_measures_speed_itself(trained):
    """The toy reports its own error; the evaluation's, measured from the state, must agree with it."""
    model = load_learner(trained)[0]
    result = evaluate(model, ID, episodes=32)
    assert result == evaluate(model, ID, episodes=32)
    # The toy counts the 50th step of each episode, whose state the evaluation no longer sees.
    assert result["forward_error"] == pytest.approx(result["metrics/velocity_error"], rel=0.05)


@pytest.mark.parametrize(("kl", "factor"), [(0.05, 1 / 1.5), (0.001, 1.5), (0.01, 1.0)])
def test_learning_rate_follows_the_divergence(kl, factor):
    callback = AdaptiveLearningRate(0.01)
    optimizer = SimpleNamespace(param_groups=[{"lr": 1e-3}])
    logger = SimpleNamespace(name_to_value={"train/approx_kl": kl})
    callback.model = SimpleNamespace(policy=SimpleNamespace(optimizer=optimizer), logger=logger, lr_schedule=None)
    callback._on_rollout_start()
    assert callback.model.lr_schedule(1.0) == pytest.approx(1e-3 * factor)


def test_resuming_reads_arrays_only(trained, tmp_path):
    """Objects that are pickled into a policy.zip are not made: `PPO.load` would make this folder."""

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    evil = tmp_path / "evil" / "policy.zip"
    evil.parent.mkdir()
    with zipfile.ZipFile(trained) as old, zipfile.ZipFile(evil, "w") as new:
        data = json.loads(old.read("data"))
        data["clip_range"] = {":type:": "object", ":serialized:": base64.b64encode(pickle.dumps(Evil())).decode()}
        for name in old.namelist():
            new.writestr(name, json.dumps(data) if name == "data" else old.read(name))
    evil.with_suffix(".json").write_bytes(trained.with_suffix(".json").read_bytes())
    assert main(["--resume", str(evil), "--steps", "1024", "--out", str(tmp_path / "out"), *QUICK]) == 0
    assert not (tmp_path / "sprung").exists()
    with contextlib.suppress(AssertionError):  # of what its call gave
        load_learner(evil)  # it was a trap
    assert (tmp_path / "sprung").exists()


def test_resuming_restores_all_that_learning_changes(trained, tmp_path):
    theirs, record = load_learner(trained)
    ours = make_learner(make_sb3_vec_env(ID, 16), job(tmp_path, 512, settings=ADAPTED, resume=trained))
    assert ours.num_timesteps == theirs.num_timesteps == record["steps"] == 512
    assert ours.lr_schedule(1.0) == theirs.policy.optimizer.param_groups[0]["lr"] != ours.learning_rate
    for key, value in theirs.policy.state_dict().items():
        assert torch.equal(ours.policy.state_dict()[key], value), key
    mine, other = (model.policy.optimizer.state_dict()["state"] for model in (ours, theirs))
    assert mine.keys() == other.keys() != set()
    for i, state in other.items():
        assert state["step"] > 0
        assert all(torch.equal(mine[i][key], state[key]) for key in state)


def test_resuming_goes_on_with_environment_and_settings_of_the_run(trained, tmp_path, capsys):
    assert main(["--resume", str(trained.parent), "--steps", "1024", "--out", str(tmp_path), *QUICK]) == 0
    assert "forward speed error" in capsys.readouterr().out
    record = load_policy(tmp_path).record
    assert record["env"] == ID
    assert record["settings"] == load_policy(trained).record["settings"] | {"steps": 1024}
    model = train(job(tmp_path / "done", 512, settings=ADAPTED, resume=trained)).model
    assert model.num_timesteps == 512, "nothing was left to learn"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("hidden=[8]", "hidden: trained with [16], requested [8]; expected the same"),
        ("hidden=[16, 16]", "hidden: trained with [16], requested [16, 16]"),
        ("activation=ReLU", "activation: trained with Tanh, requested ReLU"),
    ],
)
def test_resuming_with_another_network_is_refused(trained, tmp_path, capsys, change, words):
    out = tmp_path / "out"
    assert main(["--resume", str(trained), "--steps", "1024", "--out", str(out), "--set", change, *QUICK]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not list(out.glob("policy*"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"steps": "many"}, "steps: 'many'; expected the steps"),
        ({"settings": None}, "hidden: trained with None"),
        ({"settings": {"hidden": 3}}, "hidden: trained with 3"),
    ],
)
def test_resuming_a_policy_with_another_record(trained, tmp_path, change, words):
    policy = tmp_path / "policy.zip"
    policy.write_bytes(trained.read_bytes())
    record = json.loads(trained.with_suffix(".json").read_text())
    policy.with_suffix(".json").write_text(json.dumps(record | change))
    with pytest.raises(PolicyError, match=words):
        make_learner(make_sb3_vec_env(ID, 16), job(tmp_path, 1024, settings=ADAPTED, resume=policy))


def test_resuming_in_another_environment_is_refused(trained, tmp_path):
    policy = tmp_path / "policy.zip"
    policy.write_bytes(trained.read_bytes())
    record = json.loads(trained.with_suffix(".json").read_text())
    policy.with_suffix(".json").write_text(json.dumps(record | {"env": "CartPole-v1"}))
    assert main(["--resume", str(policy), "--out", str(tmp_path / "out"), *QUICK]) == 2
