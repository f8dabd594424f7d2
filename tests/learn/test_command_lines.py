"""Commands of `python -m ce_gym` that train, evaluate and export: help, wrong values, interruption, trust."""

import argparse
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from point_mass import ID
from toy import FAST

from ce_gym.__main__ import _parser, main
from ce_gym.policies import RobotWarning, environment_of, load_policy, write_npz
from ce_gym.policies.actor import Actor

LEARNING = ("train", "evaluate", "transfer", "sim2sim", "export", "card")


def one_line(argv, capsys) -> str:
    """The error message of a command line that ends with exit code 2."""
    try:
        code = main(argv)
    except SystemExit as leaving:
        code = leaving.code
    printed = capsys.readouterr()
    assert code == 2
    assert printed.err.count("\n") == 1, printed.err
    return printed.err.removeprefix("ce_gym: ")


def subcommands() -> dict[str, argparse.ArgumentParser]:
    (choices,) = (a.choices for a in _parser()._actions if isinstance(a, argparse._SubParsersAction))
    return choices


@pytest.mark.parametrize("name", LEARNING)
def test_help_has_examples_that_parse(name):
    text = subcommands()[name].format_help()
    lines = re.findall(r"^  python -m ce_gym (.*)$", text, re.MULTILINE)
    assert len(lines) >= 2
    for line in lines:
        assert line.split()[0] == name
        _parser().parse_args(line.split())


def test_an_option_of_several_commands_looks_the_same_in_all():
    shapes: dict[str, set] = {}
    for name in LEARNING:
        for action in subcommands()[name]._actions:
            for option in action.option_strings:
                kind = action.metavar if option == "--out" else (action.metavar, action.nargs)
                shapes.setdefault(option, set()).add(kind)
    different = {option: kinds for option, kinds in shapes.items() if len(kinds) > 1}
    assert different == {"--out": {"FOLDER", "FILE"}, "--transmission": {("LEVEL", None), ("LEVEL", "+")}}


@pytest.mark.parametrize("name", ["evaluate", "transfer", "sim2sim", "card", "train"])
def test_no_module_is_imported_because_a_file_names_it(name, tmp_path, capsys, monkeypatch):
    layers = ((np.zeros((1, 2), np.float32), np.zeros(1, np.float32)),)
    record = {"env": f"trap:{ID}", "env_kwargs": {}, "transmission": "exact", "observation_size": 2, "action_size": 1}
    record |= {"activation": "Tanh", "policy_spec": {"robot": "a", "task": "b"}, "seed": 0, "steps": 0}
    write_npz(Actor(layers, "Tanh"), record, tmp_path / "policy.npz")
    (tmp_path / "trap.py").write_text(f"open({str(tmp_path / 'sprung')!r}, 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    argv = [str(tmp_path / "policy.npz")]
    error = one_line([name, *(["--resume"] if name == "train" else []), *argv], capsys)
    assert f"--env trap:{ID}" in error
    assert not (tmp_path / "sprung").exists()
    if name == "evaluate":
        assert main([name, *argv, "--env", f"trap:{ID}", "--episodes", "4"]) == 0  # by the user's own words it is
        assert (tmp_path / "sprung").exists()
        sys.modules.pop("trap")


def test_arguments_that_an_environment_does_not_take_are_one_line(tmp_path, capsys):
    layers = ((np.zeros((12, 48), np.float32), np.zeros(12, np.float32)),)
    record = {"env": "ce_gym/MiniCheetahVelocity-v0", "env_kwargs": {"num_envs": 3}, "transmission": "exact"}
    record |= {"observation_size": 48, "action_size": 12, "activation": "Tanh", "policy_spec": {}}
    write_npz(Actor(layers, "Tanh"), record, tmp_path / "policy.npz")
    assert "num_envs" in one_line(["evaluate", str(tmp_path / "policy.npz")], capsys)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["train", "mini_cheetah_velocity"], "mini_cheetah_velocity: is a policy; expected the id of an environment"),
        (["train", "MiniCheetahVelocity-v0"], "did you mean ce_gym/MiniCheetahVelocity-v0?"),
        (["evaluate", "study"], "study: no such policy; expected a run in this folder, such as study/seed_0"),
        (["evaluate", "walk.npz"], "walk.npz: is not a policy, perhaps a rollout, which `view` shows"),
        (["card", "mini_cheetah_velocity"], "is a policy of the package; expected --out FOLDER"),
        (["train", "ce_gym/TelloVelocity-v0", "--algo", "distill"], "teacher: missing; expected --set teacher=POLICY"),
        (["evaluate", "mini_cheetah_backflip", "--suites"], "--suites: ce_gym/MiniCheetahBackflip-v0 has no commanded"),
        (["train", ID, "--out", ""], "argument --out: ''; expected a name"),
    ],
)
def test_mistakes_have_the_right_advice(argv, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study" / "seed_0").mkdir(parents=True)
    (tmp_path / "study" / "seed_0" / "policy.json").touch()
    np.savez(tmp_path / "walk.npz", header=np.zeros(1))
    assert words in one_line(argv, capsys)


def test_a_policy_of_another_robot_gives_a_warning():
    record = {"env": "ce_gym/Go1Velocity-v0", "policy_spec": {"robot": "go1"}}
    with pytest.warns(RobotWarning, match="trained on robot 'go1', used on 'mini_cheetah'"):
        environment_of(record, "ce_gym/MiniCheetahVelocity-v0")


def test_the_module_of_an_id_is_imported_and_recorded(tmp_path, monkeypatch):
    (tmp_path / "my_points.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["train", f"my_points:{ID}", "--out", str(tmp_path / "run"), *FAST]) == 0
    assert load_policy(tmp_path / "run").record["env"] == f"my_points:{ID}"
    monkeypatch.delitem(sys.modules, "my_points")


def test_ctrl_c_before_learning_starts_is_one_line(tmp_path, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("gymnasium.make_vec", interrupted)
    assert main(["train", ID, "--out", str(tmp_path), *FAST]) == 130
    assert capsys.readouterr().err == "ce_gym: interrupted\n"


def test_ctrl_c_while_numba_is_imported_is_one_line(tmp_path):
    """A numba that somebody interrupts stands in for the real one."""
    (tmp_path / "numba.py").write_text("raise KeyboardInterrupt\n")
    command = [sys.executable, "-m", "ce_gym", "train", "ce_gym/MiniCheetahStand-v0", "--out", str(tmp_path / "out")]
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "ce_gym: interrupted\n")


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--num-envs", "1e12"], "argument --num-envs: '1e12'; expected a whole number from 1 to 1048576"),
        (["--steps", "2.5"], "argument --steps: '2.5'; expected a whole number from 1"),
        (["--num-envs", "1e6", "--set", "rollout=1e4"], "--set num_envs * rollout = 10000000000; expected at most"),
        (["--set", "gamma=2"], "--set gamma=2; expected a number between 0 and 1"),
        (["--set", "gama=0.9"], "--set gama: unknown setting; expected one of"),
        (["--set", "num_envs=7", "rollout=1", "minibatches=4"], "--set minibatches=4 of 7 samples"),
        (["--set", "num_envs=5", "--set", "hidden=[4"], "--set hidden: cannot be read as YAML"),
        (["--set", "hidden=" + "[" * 5000], "--set hidden: cannot be read as YAML"),
        (["--set", "gamma"], "--set gamma: expected KEY=VALUE"),
        (["--seconds", "nan"], "--seconds: 'nan'; expected a number above 0"),
        (["--seconds", "-1"], "--seconds: '-1'; expected a number above 0"),
        (["--threads", "0"], "--threads: '0'; expected a whole number from 1 to"),
        (["--episodes", "0"], "--episodes: '0'; expected a whole number from 1 to"),
        (["--seed", "-1"], "--seed: '-1'; expected a whole number from 0 to"),
        (["--seed", "1e30"], "--seed: '1e30'; expected a whole number"),
        (["--transmission", "belt"], "argument --transmission: invalid choice: 'belt' (choose from"),
        (["--algo", "sac"], "argument --algo: invalid choice: 'sac' (choose from"),
        (["--logs", "paper"], "argument --logs: invalid choice: 'paper' (choose from"),
        (["--config", "/"], "--config /: cannot be read as YAML"),
        (["--config", "short.yaml"], "--config short.yaml: steps='many'; expected a whole number"),
        (["--resume", "missing.zip"], "--resume missing.zip: no such policy"),
        (["--frobnicate"], "--frobnicate"),
    ],
)
def test_command_lines_that_make_no_sense_are_one_line(argv, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.yaml").write_text("steps: many\n")
    error = one_line(["train", ID, "--out", str(tmp_path / "out"), *argv], capsys)
    assert words in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["train"], "ENV: missing; expected an environment id"),
        (["train", "nobody/Nothing-v0"], "Namespace nobody not found"),
        (["train", f"absent:{ID}"], "no module named 'absent'; expected a module on PYTHONPATH"),
        (["train", "ce_gym/MiniCheetaVelocity-v0"], "Did you mean: `MiniCheetahVelocity`?"),
        (["train", "--resume", "mini_cheetah_velocity", "--out", "x"], "--resume "),
        (["sim2sim", "mini_cheetah_backflip"], "has no commanded velocities; expected a task with them"),
        (["transfer"], "the following arguments are required: POLICY"),
        (["transfer", "."], ".: no such policy"),
        (["sim2sim", "nothing"], "nothing: no such policy"),
    ],
)
def test_missing_things_are_one_line(argv, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert words in one_line(argv, capsys)


@pytest.mark.parametrize("inside", ["", "/deeper"])
def test_a_folder_that_is_a_file_is_one_line(inside, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    error = one_line(["train", ID, "--out", f"{tmp_path}/out{inside}", *FAST], capsys)
    assert error.startswith(f"--out {tmp_path}/out")
    assert (tmp_path / "out").read_text() == "mine"
