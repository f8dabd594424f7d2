"""Arguments of environments: from the command line and settings files into the record, and back when a policy acts."""

from __future__ import annotations

import json
import re
import sys

import gymnasium
import pytest
import yaml
from point_mass import ID
from toy import jobs

import ce_gym
from ce_gym.__main__ import main
from ce_gym.learn.runs.settings import CONFIG_FOLDER, SettingsError, load_settings, read_file
from ce_gym.policies import load_policy

ROBOT_ENV = next(iter(ce_gym.environment_ids()))
SMALL = ["--num-envs", "8", "--steps", "64", "--threads", "1", "--episodes", "2", "--logs"]
SMALL += ["--set", "rollout=8", "minibatches=1", "epochs=1", "hidden=[8]", "training={}"]


def arguments_of(*words):
    (job,) = jobs(ID, *words)
    return job.env_kwargs


def test_arguments_of_the_command_line_hold_while_training():
    """Mappings are merged with the settings file by key; other values replace its values."""
    words = ["--set", "training={rewards: {near: 2.0, gait: 1.0}, push_period: 2.0, latency: [0, 1]}"]
    words += ["--env-arg", "rewards={near: 0.5}", "--env-arg", "push_period=0"]
    (job,) = jobs(ID, *words)
    acting = {**job.env_kwargs, **job.settings.training}
    assert acting == {"rewards": {"near": 0.5, "gait": 1.0}, "push_period": 0, "latency": [0, 1]}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("terrain=stairs", "stairs"),
        ('randomise={"friction": [0.5, 1.2]}', {"friction": [0.5, 1.2]}),
        ("rewards={gait: {weight: 1e-1}}", {"gait": {"weight": 0.1}}),
        ("heading=true", True),
        ("dt=5e-3", 0.005),
        ("critic=null", None),
        ("robot=a=b", "a=b"),
    ],
)
def test_values_are_json_or_yaml(text, expected):
    assert arguments_of("--env-arg", text) == {text.split("=")[0]: expected}


def test_the_command_line_goes_before_the_settings_file(tmp_path):
    file = tmp_path / "settings.yaml"
    own = yaml.safe_load((CONFIG_FOLDER / "default.yaml").read_text())
    file.write_text(yaml.safe_dump(own | {"env_args": {"terrain": "stairs", "transmission": "none", "heading": True}}))
    words = ["--config", str(file), "--transmission", "armature", "--env-arg", "terrain=slope"]
    assert arguments_of(*words) == {"terrain": "slope", "transmission": "armature", "heading": True}
    assert load_settings(file) == load_settings(CONFIG_FOLDER / "default.yaml")


def test_a_file_whose_aliases_multiply_is_refused(tmp_path):
    """A thousand million values in a few lines."""
    file = tmp_path / "settings.yaml"
    rows = [f"a{i + 1}: &a{i + 1} [{', '.join(10 * [f'*a{i}'])}]" for i in range(9)]
    file.write_text("a0: &a0 1\n" + "\n".join(rows) + "\nenv_args: {noise: *a9}\n")
    with pytest.raises(SettingsError, match="more than 50000 values"):
        read_file(file)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["stairs"], "env_args: .*expected arguments of the environment by name"),
        ({"seed": 3}, "env_args: seed: expected an argument of the environment alone"),
        ({"dt": float("nan")}, "env_args: dt: nan; expected finite numbers"),
        ({"day": yaml.safe_load("2020-01-01")}, "env_args: day: datetime.*expected finite numbers"),
    ],
)
def test_a_wrong_mapping_in_a_file_is_one_line(given, words, tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text(yaml.safe_dump({"env_args": given}))
    with pytest.raises(SettingsError, match=words) as caught:
        read_file(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("terrain", "'terrain'; expected KEY=VALUE"),
        ("=3", "'=3'; expected KEY=VALUE"),
        ("seed=3", "seed: expected an argument of the environment alone"),
        ("noise={a: ", "noise: line 1"),
        ("dt=.inf", "dt: inf; expected finite numbers"),
        ("rewards=!!python/object:os.system ls", "rewards: line 1: could not determine"),
        (f"noise={'[' * 30}{']' * 30}", "noise: .*expected finite numbers"),
    ],
)
def test_a_wrong_argument_is_one_line(text, words, capsys):
    for words_before in (["train", ID], ["evaluate", "x"]):
        with pytest.raises(SystemExit):
            main([*words_before, "--env-arg", text])
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert re.search(f"argument --env-arg: .*{words}", error)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("terain=stairs", "--env-arg terain: unexpected keyword argument 'terain'; expected one of rewards,"),
        ("dt=-1", "--env-arg dt=-1; expected a positive number"),
        ("randomise={friction: 3}", "--env-arg randomise['friction']=3; expected a list"),
    ],
)
def test_what_an_environment_does_not_take_is_one_line(text, words, tmp_path, capsys):
    assert main(["train", ROBOT_ENV, "--env-arg", text, "--out", str(tmp_path), *SMALL]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_a_policy_acts_in_the_environment_that_it_was_trained_in(tmp_path, capsys):
    assert main(["train", ID, "--env-arg", "horizon=20", "--out", str(tmp_path), *SMALL]) == 0
    assert load_policy(tmp_path).record["env_kwargs"] == {"horizon": 20}
    for words, seconds in (([], 0.4), (["--env-arg", "horizon=10"], 0.2)):
        capsys.readouterr()
        assert main(["evaluate", str(tmp_path), "--episodes", "2", "--json", *words]) == 0
        assert json.loads(capsys.readouterr().out)["episode_length"] == pytest.approx(seconds)
    (job,) = jobs("--resume", str(tmp_path))
    assert job.env_kwargs == {"horizon": 20}
    (job,) = jobs("--resume", str(tmp_path), "--env-arg", "horizon=30")
    assert job.env_kwargs == {"horizon": 30}


@pytest.mark.slow
def test_an_id_of_a_module_outside_the_package_trains_plays_and_is_judged(tmp_path, monkeypatch, capsys):
    """And its module is imported by the user's own words only."""
    pytest.importorskip("meshcat")
    robot = ce_gym.load_robot("mini_cheetah").source
    (tmp_path / "my_walkers.py").write_text(f"import ce_gym\nce_gym.register_robot({robot!r}, name='my_walker')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def forget():
        sys.modules.pop("my_walkers", None)
        for name in [name for name in gymnasium.registry if "MyWalker" in name]:
            del gymnasium.registry[name]

    env = "my_walkers:ce_gym/MyWalkerVelocity-v0"
    try:
        assert main(["train", env, "--env-arg", "max_episode_steps=5", "--out", "run", *SMALL]) == 0
        for words in (
            ["evaluate", "run", "--episodes", "2", "--json"],
            ["play", "run", "--command", "0.1", "0", "0", "0"],
            ["view", "run"],
        ):
            forget()
            capsys.readouterr()
            assert main(words) == 2
            assert f"name it yourself: --env {env}" in capsys.readouterr().err
            assert "my_walkers" not in sys.modules
            assert main([*words, "--env", env]) == 0
            if words[0] == "evaluate":
                assert json.loads(capsys.readouterr().out)["episode_length"] <= 0.1 + 1e-9
    finally:
        forget()
