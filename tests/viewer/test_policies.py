"""Policies of Stable-Baselines3, read without torch and without running code that they may carry; `play`."""

from __future__ import annotations

import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ce_gym.__main__ import main
from ce_gym.viewer import Rollout, ViewerError
from ce_gym.viewer.policies import policy_file, read_policy

ENV = "ce_gym/MiniCheetahVelocity-v0"


def write_zip(folder: Path, weights: bytes | None = None, **changes: object) -> Path:
    """A policy that stands, as Stable-Baselines3 would save it: only its last bias is not zero."""
    torch = pytest.importorskip("torch")
    rng = torch.Generator().manual_seed(0)
    tensors = {
        "log_std": torch.zeros(12),
        "mlp_extractor.policy_net.0.weight": torch.randn(8, 48, generator=rng),
        "mlp_extractor.policy_net.0.bias": torch.randn(8, generator=rng),
        "mlp_extractor.value_net.0.weight": torch.randn(8, 48, generator=rng),
        "action_net.weight": torch.zeros(12, 8),
        "action_net.bias": torch.full((12,), 0.05),
    }
    buffer = io.BytesIO()
    torch.save(tensors, buffer)
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / "policy.zip", "w") as archive:
        archive.writestr("policy.pth", buffer.getvalue() if weights is None else weights)
    record = {"env": ENV, "env_kwargs": {"transmission": "exact"}, "observation_size": 48, "activation": "ELU"}
    (folder / "policy.json").write_text(json.dumps(record | changes), encoding="utf-8")
    return folder / "policy.zip"


def test_weights_are_those_that_torch_saved(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    file = write_zip(tmp_path)
    rng = torch.Generator().manual_seed(0)
    weight, bias = torch.randn(8, 48, generator=rng), torch.randn(8, generator=rng)
    last = torch.linspace(-1, 1, 96).reshape(12, 8)
    buffer = io.BytesIO()
    names = ("mlp_extractor.policy_net.0.weight", "mlp_extractor.policy_net.0.bias", "action_net.weight")
    tensors = {**dict(zip(names, (weight, bias, last), strict=True)), "action_net.bias": torch.zeros(12)}
    torch.save(tensors, buffer)
    write_zip(tmp_path, buffer.getvalue())
    obs = 0.1 * np.random.default_rng(0).standard_normal((20, 48)).astype(np.float32)
    expected = torch.nn.functional.elu(torch.from_numpy(obs) @ weight.T + bias) @ last.T
    act, record = read_policy(file)
    np.testing.assert_allclose(act(obs), expected.clamp(-1, 1).numpy(), atol=1e-6)
    assert record["env"] == ENV


class Evil:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.target),)


def test_code_in_a_policy_is_refused(tmp_path: Path) -> None:
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps({"action_net.weight": Evil(tmp_path / "done")}))
    with pytest.raises(ViewerError, match=r"policy\.zip: not a policy that can be run: .*mkdir is no part") as caught:
        read_policy(write_zip(tmp_path, inner.getvalue()))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "done").exists()


@pytest.mark.parametrize("damage", ["weights", "record", "truncated"])
def test_damage_is_one_line(tmp_path: Path, damage: str) -> None:
    file = write_zip(tmp_path, b"nothing" if damage == "weights" else None)
    if damage == "record":
        (tmp_path / "policy.json").write_text("{")
    if damage == "truncated":
        file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(ViewerError, match=r"policy\.zip: not a policy that can be run") as caught:
        read_policy(file)
    assert "\n" not in str(caught.value)


def test_play_needs_no_torch(tmp_path: Path) -> None:
    file = write_zip(tmp_path)
    code = """
import sys
sys.modules["torch"] = None
from pathlib import Path
from ce_gym.viewer.policies import read_policy
read_policy(Path(sys.argv[1]))
"""
    done = subprocess.run([sys.executable, "-c", code, file], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_play_shows_levels_as_ghosts_of_the_same_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("meshcat")
    monkeypatch.chdir(tmp_path)
    folder = write_zip(tmp_path / "stander").parent
    assert policy_file(folder) == folder / "policy.zip"
    command = ["play", "stander", "--transmission", "exact", "armature", "--command", "0.4", "0.5", "0", "0"]
    assert main([*command, "--save", "kept"]) == 0
    assert capsys.readouterr().out.split() == ["kept/stander_exact.npz", "kept/stander_armature.npz", "stander.html"]
    exact, armature = (Rollout.load(f"kept/stander_{level}.npz") for level in ("exact", "armature"))
    assert (exact.transmission, armature.transmission) == ("exact", "armature")
    assert (exact.label, armature.label) == ("exact", "armature")
    np.testing.assert_array_equal(exact.q[0], armature.q[0])
    assert not np.array_equal(exact.q[-1], armature.q[-1])
    assert len(exact) == 20
    assert np.abs(exact.torques[1:]).max() > 0
    text = Path("stander.html").read_text(encoding="utf-8")
    assert '"ghost": true' in text
    assert ">armature</label>" in text


def test_play_shows_many_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("meshcat")
    monkeypatch.chdir(tmp_path)
    write_zip(tmp_path / "stander")
    assert main(["play", "stander", "--robots", "9", "--seed", "3", "--command", "0.1", "0", "0", "0"]) == 0
    text = Path("stander.html").read_text(encoding="utf-8")
    assert ">seed 3</label>" in text
    assert ">and 5 more</label>" in text


def test_play_refuses_robots_and_levels_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_zip(tmp_path)
    assert main(["play", str(file), "--robots", "2", "--transmission", "exact", "none"]) == 2
    assert "--robots 2: expected 1, or one level" in capsys.readouterr().err


def test_unknown_environment_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["play", str(write_zip(tmp_path, env="CartPole-v1"))]) == 2
    error = capsys.readouterr().err
    assert "environment 'CartPole-v1'; expected one of this package's" in error
    assert error.count("\n") == 1
