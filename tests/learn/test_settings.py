"""Settings files: found by name, complete, and refused with one clear line."""

import json

import numpy as np
import pytest

from ce_gym.learn.runs.settings import Settings, SettingsError, config_file, load_settings
from ce_gym.learn.training import learner, make_job

SHIPPED = Settings.folder / "mini_cheetah_stairs.yaml"


@pytest.mark.parametrize("algo", ["ppo", "shac", "distill"])
def test_every_shipped_file_is_complete(algo):
    kind = learner(algo).Settings
    for path in sorted(kind.folder.glob("*.yaml")):
        settings = load_settings(path, (), kind)
        assert settings.num_envs * settings.rollout % settings.minibatches == 0, path
        assert json.loads(json.dumps(settings.as_dict()))["hidden"] == list(settings.hidden)


def test_a_level_id_takes_the_file_of_its_task():
    task = config_file("ce_gym/MiniCheetahVelocity-v0")
    assert task.name == "mini_cheetah_velocity.yaml"
    assert config_file("ce_gym:ce_gym/MiniCheetahVelocity-Armature-v3") == task
    assert config_file("other/Thing-v0").name == "default.yaml"


def test_the_command_line_wins():
    path = config_file("any/Thing-v0")
    settings = load_settings(path, ["steps=2e5", "hidden=[8, 8]", "learning_rate=1e-4"])
    assert (settings.steps, settings.hidden, settings.learning_rate) == (200_000, (8, 8), 1e-4)
    assert settings.gamma == load_settings(path).gamma


def test_a_file_is_named_with_or_without_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    by_name, by_path = (make_job("any/Thing-v0", config=config) for config in ("mini_cheetah_stairs", SHIPPED))
    assert by_name == by_path
    assert by_name.env_kwargs["terrain"]["kind"] == "stairs"
    assert str(by_name.out) == "runs/mini_cheetah_stairs"


def test_settings_are_given_by_name_or_as_text():
    path = config_file("any/Thing-v0")
    assert load_settings(path, {"gamma": 0.5, "hidden": (8,)}) == load_settings(path, ["gamma=0.5", "hidden=[8]"])
    assert load_settings(path, {"steps": np.float64(1e3)}).steps == 1000


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("gama=0.9", "gama: unknown setting; expected one of steps,"),
        ("gamma=high", "gamma='high'; expected a number between 0 and 1"),
        ("gamma=2", "gamma=2; expected a number between 0 and 1"),
        ("gae_lambda=.nan", "gae_lambda=nan; expected a number between 0 and 1"),
        ("initial_std=0", "initial_std=0; expected a positive number, at most 100"),
        ("epochs=2.5", "epochs=2.5; expected a whole number from 1 to 1000"),
        ("epochs=0", "epochs=0; expected a whole number from 1 to 1000"),
        ("epochs=true", "epochs=True; expected a whole number"),
        ("num_envs=1e12", "num_envs=1000000000000.0; expected a whole number from 1 to"),
        ("rollout=.inf", "rollout=inf; expected a whole number"),
        ("hidden=64", "hidden=64; expected a list of layer sizes"),
        ("hidden={1: 2}", "hidden={1: 2}; expected a list of layer sizes"),
        ("hidden=[a]", "hidden='a'; expected a whole number from 1"),
        ("hidden=[4", "hidden: cannot be read as YAML"),
        ("hidden=2020-99-99", "hidden: cannot be read as YAML"),
        ("gamma", "gamma: expected KEY=VALUE"),
        ("activation=GELU", "activation='GELU'; expected 'Tanh' or "),
        ("activation=[Tanh]", "activation=['Tanh']; expected 'Tanh' or "),
        ("training={seed: 3}", "training: seed: expected an argument of the environment alone"),
    ],
)
def test_a_bad_override_is_one_line(override, words):
    with pytest.raises(SettingsError, match=r"^settings: ") as caught:
        load_settings(config_file("any/Thing-v0"), [override])
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_minibatch_has_two_samples():
    """The variance of the advantages of one sample would be 0 / 0."""
    path = config_file("any/Thing-v0")
    for shape, valid in (((7, 1, 4), False), ((1, 4, 4), False), ((5, 1, 2), True), ((4, 1, 2), True)):
        given = dict(zip(("num_envs", "rollout", "minibatches"), shape, strict=True))
        if valid:
            assert load_settings(path, given).num_envs == shape[0]
        else:
            with pytest.raises(SettingsError, match="expected 2 samples or more in each"):
                load_settings(path, given)
    with pytest.raises(SettingsError, match=r"num_envs \* rollout = 10000000000; expected at most"):
        load_settings(path, {"num_envs": 10**6, "rollout": 10**4})


def test_a_file_with_a_missing_key_is_refused(tmp_path):
    file = tmp_path / "short.yaml"
    file.write_text("steps: 1e6\n")
    with pytest.raises(SettingsError, match=r"short\.yaml: num_envs: missing"):
        load_settings(file)
    with pytest.raises(SettingsError, match="cannot be read"):
        load_settings(tmp_path / "none.yaml")
    file.write_text("steps: many\n")
    with pytest.raises(SettingsError, match=r"short\.yaml: steps='many'; expected"):
        load_settings(file, ["gamma=0.5"])
