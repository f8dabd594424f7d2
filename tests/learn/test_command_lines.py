"""Command lines of the training scripts: nonsense and interruptions are one line; no file names a module to import."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from point_mass import ID
from toy import FAST

from ce_gym.learn.evaluate.card import main as card_main
from ce_gym.learn.evaluate.evaluation import main as evaluate_main
from ce_gym.learn.evaluate.sim2sim import main as sim2sim_main
from ce_gym.learn.evaluate.transfer import main as transfer_main
from ce_gym.learn.learners import sb3 as ppo
from ce_gym.learn.learners.sb3 import main
from ce_gym.policies import write_npz
from ce_gym.policies.actor import Actor


def one_line(argv, capsys, run=main) -> str:
    """The error message of a command line that ends with exit code 2."""
    try:
        code = run(argv)
    except SystemExit as leaving:
        code = leaving.code
    printed = capsys.readouterr()
    assert code == 2
    assert printed.err.count("\n") == 1, printed.err
    assert "training" not in printed.out
    return printed.err


@pytest.mark.parametrize("name", ["ppo", "fast_ppo", "evaluate", "transfer", "demo", "export", "sim2sim", "card"])
def test_every_script_explains_itself(name, capsys):
    with pytest.raises(SystemExit, match=r"^0$"):
        import_module(name).main(["--help"])
    assert "usage: " in capsys.readouterr().out


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


def test_ctrl_c_before_learning_starts_is_one_line(tmp_path, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("ppo.make_sb3_vec_env", interrupted)
    assert main(["--env", ID, "--out", str(tmp_path), *FAST]) == 130
    assert capsys.readouterr().err == "ppo.py: interrupted\n"


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
    error = one_line(["--env", ID, "--out", f"{tmp_path}/out{inside}", *FAST], capsys)
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
