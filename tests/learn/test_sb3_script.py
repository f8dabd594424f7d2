"""The script to read and change: short, with settings from the command line, and a policy for all commands."""

import importlib
import sys
from dataclasses import field, make_dataclass
from pathlib import Path

import numpy as np
import ppo
import pytest
from point_mass import ID
from stable_baselines3 import PPO

from ce_gym.__main__ import main as ce_gym_main
from ce_gym.policies import load_policy

SMALL = ["--env", ID, "--num-envs", "64", "--n-steps", "16", "--batch-size", "512", "--n-epochs", "4", "--gamma", "0.9"]


def test_the_script_is_short():
    assert len(Path(ppo.__file__).read_text(encoding="utf-8").splitlines()) <= 160


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    options = ["--steps", "40_000", "--hidden", "16", "8", "--learning-rate", "1e-2", "--transmission", "armature"]
    assert ppo.main([*SMALL, *options, "--rewards", '{"speed": 2.0}', "--out", str(out)]) == 0
    return out


def test_settings_reach_the_policy(folder):
    policy = load_policy(folder)
    assert (policy.record["env"], policy.record["transmission"]) == (ID, "armature")
    assert policy.record["env_kwargs"] == {"transmission": "armature", "rewards": {"speed": 2.0}}
    assert [len(bias) for _, bias in policy.act.layers] == [16, 8, 1]
    model = PPO.load(folder / "model.zip", device="cpu")
    assert (model.gamma, model.n_steps, model.batch_size, model.n_epochs) == (0.9, 16, 512, 4)
    obs = np.random.default_rng(0).standard_normal((16, 2)).astype(np.float32)
    expected = model.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(policy.predict(obs)[0], expected, atol=1e-6)


def test_the_policy_learned_and_commands_take_it(folder, capsys):
    assert ce_gym_main(["evaluate", str(folder), "--episodes", "16", "--json"]) == 0
    result = capsys.readouterr().out
    assert '"falls": 0.0' in result
    error = next(line for line in result.splitlines() if '"forward_error"' in line)
    assert float(error.split(":")[1].strip(" ,")) < 0.1  # half a unit without learning


def test_progress_and_both_levels_are_printed(tmp_path, capsys):
    assert ppo.main([*SMALL, "--steps", "20_480", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "1,024 steps; rewards follow" in printed
    assert "20,480 steps  reward" in printed
    assert "velocity_error" in printed
    for level in ("exact", "armature"):
        assert f"on {level} transmissions" in printed
    assert f"python -m ce_gym play {tmp_path / 'policy.npz'}" in printed


def test_rewards_of_the_command_line_are_merged_with_the_defaults(monkeypatch):
    rewards = field(default_factory=lambda: {"a": 1, "b": 2}, metadata={"help": ""})
    changed = make_dataclass("Changed", [("rewards", dict, rewards)], bases=(ppo.Settings,))
    monkeypatch.setattr(ppo, "Settings", changed)
    assert ppo.parse_settings(["--rewards", '{"b": 3}']).rewards == {"a": 1, "b": 3}


def test_the_level_is_that_of_the_id():
    assert ppo.parse_settings([]).transmission is None


def test_the_module_of_the_id_is_recorded_and_not_imported_from_the_file(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_terms.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    env = f"my_terms:{ID}"
    assert ppo.main([*SMALL, "--steps", "1_024", "--env", env, "--out", str(tmp_path)]) == 0
    play = capsys.readouterr().out.splitlines()[-1]
    assert play == f"python -m ce_gym play {tmp_path / 'policy.npz'} --env {env}"
    command = ["evaluate", str(tmp_path), "--episodes", "4"]
    for missing in (False, True):
        monkeypatch.delitem(sys.modules, "my_terms")
        assert ce_gym_main(command) == 2
        assert f"name it yourself: --env {env}" in capsys.readouterr().err
        assert "my_terms" not in sys.modules
        if missing:
            (tmp_path / "my_terms.py").unlink()
            importlib.invalidate_caches()
            assert ce_gym_main([*command, "--env", env]) == 2
            assert capsys.readouterr().err == "ce_gym: no module named 'my_terms'; expected a module on PYTHONPATH\n"
        else:
            assert ce_gym_main([*command, "--env", env]) == 0


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--env", "nobody/Nothing-v0"], "nobody"),
        (["--env", f"absent:{ID}"], "no module named 'absent'; expected a module on PYTHONPATH"),
        (["--rewards", "torques=1"], """--rewards: 'torques=1'; expected JSON such as {"torques": -4e-4}"""),
        (["--rewards", "[1]"], """--rewards: '[1]'; expected JSON such as"""),
        (["--steps", "many"], "--steps: invalid int value: 'many'"),
        (["--env", "ce_gym/MiniCheetahVelocity-v0", "--rewards", '{"nothing": 1}'], "no reward term 'nothing'"),
    ],
)
def test_mistakes_are_one_line(argv, words, capsys, tmp_path):
    with pytest.raises(SystemExit, match=r"^2$"):
        raise SystemExit(ppo.run(ppo.in_one_line(lambda: ppo.main([*argv, "--out", str(tmp_path)]))))
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
