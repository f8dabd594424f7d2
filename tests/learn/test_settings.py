"""Settings files: found by name, complete, and refused with one clear line."""

import pytest

from ce_gym.learn.runs.settings import CONFIG_FOLDER, SettingsError, config_file, load_settings


@pytest.mark.parametrize("path", sorted(CONFIG_FOLDER.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_file_is_complete(path):
    settings = load_settings(path)
    assert settings.num_envs * settings.rollout % settings.minibatches == 0


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


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("gama=0.9", "gama: unknown setting"),
        ("gamma=high", "gamma: 'high'; expected a number"),
        ("epochs=2.5", "epochs: 2.5; expected a positive whole number"),
        ("epochs=0", "expected a positive whole number"),
        ("hidden=64", "hidden: 64; expected a list"),
        ("hidden=[a]", "hidden: 'a'; expected a positive"),
        ("gamma", "expected KEY=VALUE"),
        ("activation=GELU", "activation: 'GELU'; expected one of Tanh"),
    ],
)
def test_a_bad_override_is_one_line(override, words):
    with pytest.raises(SettingsError, match=words) as caught:
        load_settings(config_file("any/Thing-v0"), [override])
    assert "\n" not in str(caught.value)


def test_a_file_with_a_missing_key_is_refused(tmp_path):
    file = tmp_path / "short.yaml"
    file.write_text("steps: 1e6\n")
    with pytest.raises(SettingsError, match=r"short\.yaml: num_envs: missing"):
        load_settings(file)
    with pytest.raises(SettingsError, match="cannot be read"):
        load_settings(tmp_path / "none.yaml")
