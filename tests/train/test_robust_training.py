"""Training that is interrupted, misled or out of room: one line, and a policy if there was one. Toy task, seconds."""

import base64
import contextlib
import errno
import json
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import ppo
import pytest
import torch
from card import main as card_main
from evaluate import main as evaluate_main
from fast_ppo import train as train_fast
from job import Job
from point_mass import ID
from ppo import main, make_learner, train
from saved import load_learner
from settings import config_file, load_settings
from sim2sim import main as sim2sim_main
from transfer import main as transfer_main

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import PolicyError, load_policy, write_npz
from ce_gym.policies.actor import Actor

SMALL = ["num_envs=16", "rollout=16", "hidden=[16]", "epochs=1", "minibatches=2", "target_kl=0.01", "gamma=0.9"]
QUICK = ["--no-tensorboard", "--episodes", "4", "--threads", "1"]


def job(out, steps=512, **changes):
    settings = load_settings(config_file(ID), [*changes.pop("settings", SMALL), f"steps={steps}"])
    return Job(ID, settings, out, env_kwargs={}, tensorboard=False, **changes)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(job(tmp_path_factory.mktemp("run"))).policy


def one_line(argv, capsys, run=main) -> str:
    """What a mistake prints; it ends with exit code 2."""
    try:
        code = run(argv)
    except SystemExit as leaving:
        code = leaving.code
    printed = capsys.readouterr()
    assert code == 2
    assert printed.err.count("\n") == 1, printed.err
    assert "training" not in printed.out
    return printed.err


# What resuming reads


def test_resuming_reads_arrays_only(trained, tmp_path, capsys):
    """Objects that are pickled into a policy.zip are not made: `PPO.load` would make this folder."""

    class Evil:
        def __reduce__(self):
            import os

            return os.mkdir, (str(tmp_path / "sprung"),)

    evil = tmp_path / "evil" / "policy.zip"
    evil.parent.mkdir()
    with zipfile.ZipFile(trained) as old, zipfile.ZipFile(evil, "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
        data = json.loads(old.read("data"))
    data["clip_range"] = {":type:": "object", ":serialized:": base64.b64encode(pickle.dumps(Evil())).decode()}
    with zipfile.ZipFile(trained) as old, zipfile.ZipFile(evil, "w") as new:
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
    envs = make_sb3_vec_env(ID, 16)
    ours = make_learner(envs, job(tmp_path, resume=trained))
    assert ours.num_timesteps == theirs.num_timesteps == record["steps"] == 512
    assert ours.lr_schedule(1.0) == theirs.policy.optimizer.param_groups[0]["lr"] != ours.learning_rate
    for key, value in theirs.policy.state_dict().items():
        assert torch.equal(ours.policy.state_dict()[key], value), key
    mine, other = (model.policy.optimizer.state_dict()["state"] for model in (ours, theirs))
    assert mine.keys() == other.keys() != set()
    for i, state in other.items():
        assert state["step"] > 0
        assert all(torch.equal(mine[i][key], state[key]) for key in state)


def test_resuming_goes_on_with_the_settings_of_the_run(trained, tmp_path):
    assert main(["--resume", str(trained.parent), "--steps", "1024", "--out", str(tmp_path), *QUICK]) == 0
    settings = load_policy(tmp_path).record["settings"]
    assert settings == load_policy(trained).record["settings"] | {"steps": 1024}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("hidden=[8]", "hidden: trained with [16], asked for [8]; expected the same"),
        ("hidden=[16, 16]", "hidden: trained with [16], asked for [16, 16]"),
        ("activation=ReLU", "activation: trained with Tanh, asked for ReLU"),
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
        ({"env": "CartPole-v1"}, "refused"),
    ],
)
def test_resuming_a_policy_with_another_record(trained, tmp_path, capsys, change, words):
    policy = tmp_path / "policy.zip"
    policy.write_bytes(trained.read_bytes())
    record = json.loads(trained.with_suffix(".json").read_text())
    policy.with_suffix(".json").write_text(json.dumps(record | change))
    with pytest.raises(PolicyError, match=words):
        make_learner(make_sb3_vec_env(ID, 16), job(tmp_path, resume=policy)) if "env" not in change else raising(policy)


def raising(policy):
    """The environment of the record takes other arguments and gives other observations."""
    if main(["--resume", str(policy), "--out", str(policy.parent / "out"), *QUICK]) == 2:
        raise PolicyError("refused")
    pytest.fail("resumed in another environment")


# Whose module is imported


@pytest.mark.parametrize("run", [evaluate_main, transfer_main, sim2sim_main, card_main, main])
def test_no_module_is_imported_because_a_file_names_it(run, tmp_path, capsys, monkeypatch):
    layers = ((np.zeros((1, 2), np.float32), np.zeros(1, np.float32)),)
    record = {"env": f"trap:{ID}", "env_kwargs": {}, "transmission": "exact", "observation_size": 2, "action_size": 1}
    record |= {"activation": "Tanh", "policy_spec": {"robot": "a", "task": "b"}, "seed": 0, "steps": 0}
    write_npz(Actor(layers, "Tanh"), record, tmp_path / "policy.npz")
    (tmp_path / "trap.py").write_text(f"open({str(tmp_path / 'sprung')!r}, 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    argv = [str(tmp_path / "policy.npz")]
    error = one_line(["--resume", *argv] if run is main else argv, capsys, run)
    assert f"--env trap:{ID}" in error
    assert not (tmp_path / "sprung").exists()
    if run is evaluate_main:
        assert run([*argv, "--env", f"trap:{ID}", "--episodes", "4"]) == 0  # by the user's own words it is
        assert (tmp_path / "sprung").exists()
        sys.modules.pop("trap")


def test_arguments_that_an_environment_does_not_take_are_one_line(tmp_path, capsys):
    layers = ((np.zeros((12, 48), np.float32), np.zeros(12, np.float32)),)
    record = {"env": "ce_gym/MiniCheetahVelocity-v0", "env_kwargs": {"num_envs": 3}, "transmission": "exact"}
    record |= {"observation_size": 48, "action_size": 12, "activation": "Tanh", "policy_spec": {}}
    write_npz(Actor(layers, "Tanh"), record, tmp_path / "policy.npz")
    assert "num_envs" in one_line([str(tmp_path / "policy.npz")], capsys, evaluate_main)


# Room


class FullDisk:
    """Makes writing files whose path has a word in it fail."""

    def __init__(self, monkeypatch, word: str) -> None:
        self.write = Path.write_bytes
        self.word = word
        monkeypatch.setattr(Path, "write_bytes", lambda path, data: self._write_bytes(path, data))

    def _write_bytes(self, path: Path, data: bytes) -> int:
        if self.word not in str(path):
            return self.write(path, data)
        self.write(path, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))


both = pytest.mark.parametrize("learn", [train, train_fast], ids=["reference", "fast"])


@pytest.mark.slow
@both
def test_training_goes_on_if_there_is_no_room_for_a_checkpoint(learn, tmp_path, capsys, monkeypatch):
    FullDisk(monkeypatch, "checkpoints")
    result = learn(job(tmp_path, 2048))
    assert load_policy(result.policy).record["steps"] >= 2048
    warnings = [line for line in capsys.readouterr().err.splitlines() if "No space left on device" in line]
    assert len(warnings) >= 3
    assert all("training goes on" in line for line in warnings)
    assert not [path for path in (tmp_path / "checkpoints").glob("*") if path.is_file()]


@both
def test_a_policy_that_has_no_room_goes_elsewhere(learn, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    FullDisk(monkeypatch, "/run/")
    result = learn(job(tmp_path / "run"))
    assert load_policy(result.policy).record["steps"] >= 512
    assert result.policy.parent.parent == tmp_path
    assert f"saving to {result.policy.parent}" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize(
    ("learn", "file"), [(train, "curve.csv"), (train_fast, "curve.csv"), (train_fast, "progress.csv")]
)
def test_training_goes_on_if_there_is_no_room_for_its_curve(learn, file, tmp_path, capsys):
    (tmp_path / file).symlink_to("/dev/full")
    assert learn(job(tmp_path, 4096)).policy.exists()
    assert "No space left on device; training goes on" in capsys.readouterr().err


def test_training_goes_on_if_there_is_no_room_for_its_log(tmp_path, capsys, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("stable_baselines3.common.logger.CSVOutputFormat.write", full)
    assert train(job(tmp_path, 4096)).policy.exists()
    assert "No space left on device; training goes on" in capsys.readouterr().err


# Interruptions


def test_ctrl_c_before_learning_starts_is_one_line(tmp_path, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("ppo.make_sb3_vec_env", interrupted)
    assert main(["--env", ID, "--out", str(tmp_path), *QUICK]) == 130
    assert capsys.readouterr().err == "ppo.py: interrupted\n"


# Command lines


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--num-envs", "1e12"], "num_envs: 1000000000000.0; expected a positive whole number, at most"),
        (["--num-envs", "1e6", "--set", "rollout=1e4"], "num_envs * rollout: 10000000000; expected at most"),
        (["--set", "minibatches=1e9"], "minibatches: 1000000000.0; expected a positive whole number, at most"),
        (["--set", "num_envs=1", "rollout=4", "minibatches=4"], "expected at least 2 samples in each"),
        (["--set", "num_envs=5", "rollout=1", "minibatches=2", "hidden=[4"], "--set hidden: cannot be read as YAML"),
        (["--set", "num_envs=7", "rollout=1", "minibatches=4"], "minibatches: 4 of 7 samples"),
        (["--set", "hidden=" + "[" * 5000], "--set hidden: cannot be read as YAML"),
        (["--set", "hidden=2020-99-99"], "--set hidden: cannot be read as YAML"),
        (["--set", "hidden='64'"], "hidden: '64'; expected a list"),
        (["--set", "hidden={1: 2}"], "hidden: {1: 2}; expected a list"),
        (["--set", "hidden=[1e9]"], "hidden: 1000000000.0; expected a positive whole number, at most"),
        (["--set", "activation=[Tanh]"], "activation: ['Tanh']; expected one of"),
        (["--set", "gamma=2"], "gamma: 2; expected a number from 0 to 1"),
        (["--set", "gamma=-0.1"], "gamma: -0.1; expected a number from 0 to 1"),
        (["--set", "gae_lambda=.nan"], "gae_lambda: nan; expected a number from 0 to 1"),
        (["--set", "initial_std=0"], "initial_std: 0; expected a number from"),
        (["--set", "learning_rate=.inf"], "learning_rate: inf; expected"),
        (["--set", "epochs=true"], "epochs: True; expected"),
        (["--minutes", "nan"], "--minutes: 'nan'; expected a number above 0"),
        (["--minutes", "-1"], "--minutes: '-1'; expected a number above 0"),
        (["--threads", "0"], "--threads: '0'; expected a whole number from 1 to"),
        (["--episodes", "0"], "--episodes: '0'; expected a whole number from 1 to"),
        (["--seed", "-1"], "--seed: '-1'; expected a whole number from 0 to"),
        (["--seed", "1e30"], "--seed: '1e30'; expected a whole number"),
        (["--config", "/"], "/: cannot be read as YAML"),
        (["--frobnicate"], "--frobnicate"),
    ],
)
def test_command_lines_that_make_no_sense_are_one_line(argv, words, tmp_path, capsys):
    error = one_line(["--env", ID, "--out", str(tmp_path / "out"), *argv], capsys)
    assert words in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("inside", ["", "/deeper"])
def test_a_folder_that_is_a_file_is_one_line(inside, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    error = one_line(["--env", ID, "--out", f"{tmp_path}/out{inside}", *QUICK], capsys)
    assert str(tmp_path / "out") in error
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("program", ["ppo.py", "rsl_rl_ppo.py"])
def test_ctrl_c_while_torch_is_imported(program, tmp_path):
    """A torch that somebody interrupts stands in for the real one."""
    (tmp_path / "torch.py").write_text("raise KeyboardInterrupt\n")
    command = [sys.executable, str(Path(ppo.__file__).parent / program), "--help"]
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert done.stderr == f"{program}: interrupted\n"
