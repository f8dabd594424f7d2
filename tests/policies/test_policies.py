"""Policies: found where they lie, read without torch and without running code, run as torch would."""

from __future__ import annotations

import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stander import BIAS, ENV, record, stander, write_small, write_zip

import ce_gym
from ce_gym.policies import (
    ACTIVATIONS,
    Actor,
    LevelWarning,
    PolicyError,
    find_policy,
    keep_map,
    load_policy,
    locate_policy,
    read_actor,
    write_npz,
)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_numpy_acts_as_torch(activation: str) -> None:
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(1)
    sizes = (48, 32, 16, 12)
    layers = [(rng.standard_normal((b, a)) / np.sqrt(a), rng.standard_normal(b)) for a, b in pairwise(sizes)]
    actor = Actor(tuple((np.float32(weight), np.float32(bias)) for weight, bias in layers), activation)
    obs = np.float32(rng.standard_normal((200, 48)))
    x = torch.from_numpy(obs)
    for i, (weight, bias) in enumerate(actor.layers):
        x = getattr(torch.nn, activation)()(x) if i else x
        x = torch.nn.functional.linear(x, torch.from_numpy(weight), torch.from_numpy(bias))
    np.testing.assert_allclose(actor(obs), x.clamp(-1, 1).numpy(), atol=3e-6)
    assert 0 < (np.abs(actor(obs)) == 1.0).mean() < 1
    np.testing.assert_allclose(actor(obs[0]), actor(obs)[0], atol=3e-6)
    assert actor(obs).dtype == np.float32


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_activations_take_any_number(activation: str) -> None:
    with np.errstate(all="raise", under="ignore"):
        out = ACTIVATIONS[activation](np.float32([-1e4, -50, 0, 50, 1e4]))
    assert np.isfinite(out).all()


def test_both_files_hold_the_same_policy(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    layers = (rng.standard_normal((8, 48)), rng.standard_normal(8)), (rng.standard_normal((12, 8)), np.zeros(12))
    actor = Actor(tuple((np.float32(weight), np.float32(bias)) for weight, bias in layers), "ELU")
    obs = 0.1 * rng.standard_normal((20, 48))
    write_npz(actor, record(), tmp_path / "policy.npz")
    for file in (tmp_path / "policy.npz", write_zip(tmp_path / "run", actor)):
        policy = load_policy(file)
        np.testing.assert_array_equal(policy.predict(obs)[0], actor(obs))
        np.testing.assert_array_equal(policy.predict({"policy": obs, "critic": 0})[0], actor(obs))
        assert policy.record["env"] == record()["env"]


def test_a_policy_drives_a_single_environment() -> None:
    policy = load_policy("mini_cheetah_velocity")
    env = gymnasium.make(policy.record["env"], **policy.record["env_kwargs"])
    obs, _ = env.reset(seed=0)
    for _ in range(50):
        obs, _, terminated, _, _ = env.step(policy.predict(obs)[0])
        assert not terminated


@pytest.mark.parametrize("rows", [np.zeros(47), np.zeros((3, 49)), np.zeros(()), np.zeros((48, 1))])
def test_observations_of_another_size_are_refused(tmp_path: Path, rows: np.ndarray) -> None:
    with pytest.raises(PolicyError, match="expected 48 numbers"):
        load_policy(write_small(tmp_path / "policy.npz")).predict(rows)


def test_nothing_is_drawn_at_random(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="mean actions only"):
        load_policy(write_small(tmp_path / "policy.npz")).predict(np.zeros(48), deterministic=False)


def test_another_level_is_said(tmp_path: Path) -> None:
    file = write_small(tmp_path / "policy.npz")
    with pytest.warns(LevelWarning, match="trained on 'exact', used on 'none'"):
        load_policy(file, "none")
    load_policy(file, "exact")


def test_names_folders_and_files_are_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ce_gym.policies.places.assets_folder", lambda: tmp_path)
    shipped = write_small(tmp_path / "policies" / "dog_walk_exact" / "policy.npz")
    for name in ("dog_walk_exact", "dog_walk", shipped, str(shipped.parent)):
        assert find_policy(name) == shipped
    assert ce_gym.shipped_policies() == ["dog_walk_exact"]
    assert find_policy(write_small(tmp_path / "any_name.npz")) == tmp_path / "any_name.npz"
    np.savez(tmp_path / "rollout.npz", q=np.zeros(3))
    for name in ("dog", "dog_walk.npz", tmp_path / "rollout.npz", tmp_path):
        assert find_policy(name) is None
    with pytest.raises(PolicyError, match=r"cat: no such policy; expected a file .* \(`python -m ce_gym list` shows"):
        locate_policy("cat")
    with pytest.raises(PolicyError, match=r"dog_wlak: no such policy; .* \(did you mean 'dog_walk'\?\)"):
        locate_policy("dog_wlak")


def test_what_training_wrote_goes_before_older_copies_of_it(tmp_path: Path) -> None:
    write_small(tmp_path / "policy.npz")
    trained = write_zip(tmp_path)
    assert find_policy(tmp_path) == trained


class Evil:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.target),)


def test_code_in_weights_is_refused(tmp_path: Path) -> None:
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps({"action_net.weight": Evil(tmp_path / "done")}))
    file = write_zip(tmp_path, weights=inner.getvalue())
    with pytest.raises(PolicyError, match=r"policy\.zip: no weights .*mkdir is no part") as caught:
        load_policy(file)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "done").exists()


def test_code_in_a_small_file_is_refused(tmp_path: Path) -> None:
    with np.load(write_small(tmp_path / "policy.npz")) as file:
        arrays = dict(file)
    bad = tmp_path / "bad.npz"
    for name in ("record", "weight_0"):
        np.savez(bad, **arrays | {name: np.array([Evil(tmp_path / "done")], dtype=object)})
        with pytest.raises(PolicyError, match=r"bad\.npz: no weights"):
            load_policy(bad)
    bad.write_bytes(pickle.dumps(Evil(tmp_path / "done")))
    with pytest.raises(PolicyError, match=r"bad\.npz: no weights"):
        load_policy(bad)
    assert not (tmp_path / "done").exists()


def test_weights_that_lie_otherwise_are_refused(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    buffer = io.BytesIO()
    torch.save({"action_net.weight": torch.zeros(8, 12).T, "action_net.bias": torch.zeros(12)}, buffer)
    with pytest.raises(PolicyError, match="stored row by row"):
        load_policy(write_zip(tmp_path, weights=buffer.getvalue()))


@pytest.mark.parametrize("damage", ["weights", "truncated", "empty"])
def test_a_damaged_zip_is_one_line(tmp_path: Path, damage: str) -> None:
    file = write_zip(tmp_path, weights=b"nothing" if damage == "weights" else None)
    if damage != "weights":
        file.write_bytes(file.read_bytes()[:300] if damage == "truncated" else b"")
    with pytest.raises(PolicyError, match=r"policy\.zip: no weights of an actor") as caught:
        load_policy(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [("{", "cannot be read as JSON"), ("[]", "env: missing"), (None, r"no such file: .*ce_gym\.policies\.save")],
)
def test_a_damaged_record_is_one_line(tmp_path: Path, text: str | None, words: str) -> None:
    file = write_zip(tmp_path)
    beside = tmp_path / "policy.json"
    beside.write_text(text) if text else beside.unlink()
    with pytest.raises(PolicyError, match=rf"policy\.json: .*{words}") as caught:
        load_policy(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"activation": "Nope"}, "activation: 'Nope'; expected one of Tanh"),
        ({"observation_size": 47}, "a layer takes 48 numbers; expected 47"),
        ({"observation_size": "many"}, "observation_size: 'many'; expected a whole number"),
        ({"action_size": 11}, "gives 12 numbers; expected the 11"),
    ],
)
def test_a_record_that_does_not_fit_is_one_line(tmp_path: Path, changes: dict, words: str) -> None:
    with pytest.raises(PolicyError, match=rf"policy\.npz: {words}") as caught:
        load_policy(write_small(tmp_path / "policy.npz", **changes))
    assert "\n" not in str(caught.value)


def test_layers_that_do_not_fit_are_one_line(tmp_path: Path) -> None:
    file = write_small(tmp_path / "policy.npz")
    whole = file.read_bytes()
    with np.load(file) as opened:
        arrays = dict(opened)
    end = whole.rindex(b"PK\x05\x06")  # of the list of contents, which is damaged in the last
    for content in (b"", b"nothing", whole[: len(whole) // 2], whole[: end - 40] + bytes(40) + whole[end:]):
        file.write_bytes(content)
        with pytest.raises(PolicyError, match=r"policy\.npz: no weights"):
            load_policy(file)
    for name in ("weight_0", "bias_0"):
        np.savez(file, **arrays | {name: arrays[name][:-1]})
        with pytest.raises(PolicyError, match="a layer takes"):
            load_policy(file)
    np.savez(file, **{name: arrays[name] for name in ("record", "weight_0", "bias_0")})
    with pytest.raises(PolicyError, match="gives 8 numbers; expected the 12"):
        load_policy(file)
    np.savez(file, record=arrays["record"])
    with pytest.raises(PolicyError, match="gives 48 numbers; expected the 12"):
        load_policy(file)


def test_no_torch_is_needed(tmp_path: Path) -> None:
    code = """
import sys
sys.modules["torch"] = None
import ce_gym, numpy
print(ce_gym.load_policy(sys.argv[1]).predict(numpy.zeros(48))[0][0])
"""
    done = subprocess.run(
        [sys.executable, "-c", code, write_zip(tmp_path)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(BIAS)


def test_the_record_survives(tmp_path: Path) -> None:
    actor, found = read_actor(write_small(tmp_path / "policy.npz", note="ä"))
    assert found == json.loads(json.dumps(record(note="ä")))
    for (weight, bias), (same_weight, same_bias) in zip(actor.layers, stander().layers, strict=True):
        np.testing.assert_array_equal(weight, same_weight)
        np.testing.assert_array_equal(bias, same_bias)


def test_a_policy_finds_its_height_map_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, run = tmp_path / "here", tmp_path / "there" / "run"
    here.mkdir()
    kwargs = {"terrain": {"kind": "map", "file": "maps/hill.npy", "cell": 0.5}}
    for file in ("policy.npz", "checkpoints/policy_100.npz"):
        write_small(run / file, env_kwargs=kwargs)
    monkeypatch.chdir(tmp_path)
    assert load_policy(run).record["env_kwargs"] == kwargs
    with pytest.raises(ValueError, match=r"terrain\['file'\]='maps/hill.npy'; expected .* looked for in '/.*' and"):
        gymnasium.make(ENV, **load_policy(run).record["env_kwargs"])

    (tmp_path / "maps").mkdir()
    hill = np.outer(np.hanning(20), np.ones(12))
    np.save(tmp_path / "maps/hill.npy", hill)
    for _ in range(2):  # the copy of a resumed run is already there
        keep_map(load_policy(run).record["env_kwargs"], run)
    keep_map({"terrain": "rough"}, run)
    monkeypatch.chdir(here)
    for file in (run, run / "checkpoints/policy_100.npz", Path("../there/run/policy.npz")):
        found = load_policy(file).record["env_kwargs"]
        assert found == {"terrain": {**kwargs["terrain"], "file": found["terrain"]["file"]}}
        np.testing.assert_array_equal(np.load(found["terrain"]["file"]), hill)
    assert sorted(file.name for file in run.iterdir()) == ["checkpoints", "hill.npy", "policy.npz"]


@pytest.mark.parametrize(
    "terrain", [3, "map", {"file": 3}, {"file": ""}, {"file": "\0"}, {"file": ".."}, {"file": "a" * 5000}]
)
def test_a_record_with_any_terrain_is_read(terrain: object, tmp_path: Path) -> None:
    kwargs = {"terrain": terrain}
    assert load_policy(write_small(tmp_path / "policy.npz", env_kwargs=kwargs)).record["env_kwargs"] == kwargs
    keep_map(kwargs, tmp_path)
