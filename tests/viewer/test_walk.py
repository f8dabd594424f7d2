"""Policies on the viewer's command line: found, run by numpy alone, and refused in one line."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import ce_gym
from ce_gym.__main__ import main
from ce_gym.viewer import Rollout, ViewerError, drive
from ce_gym.viewer.policies import policy_file, read_policy
from ce_gym.viewer.walk import walk

ENV = "ce_gym/MiniCheetahVelocity-v0"
SIZES = (48, 8, 12)


def write(file: Path, **changes: object) -> Path:
    """A policy that stands: its last layer is zero."""
    record = {"env": ENV, "env_kwargs": {"transmission": "none"}, "observation_size": 48, "activation": "Tanh"}
    rng = np.random.default_rng(0)
    arrays = {"weight_0": rng.standard_normal((8, 48)), "bias_0": rng.standard_normal(8)}
    arrays |= {"weight_1": np.zeros((12, 8)), "bias_1": np.zeros(12)}
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(file, record=np.array(json.dumps(record | changes)), **arrays)
    return file


@pytest.mark.parametrize("activation", ["Tanh", "ReLU", "ELU"])
def test_numpy_acts_as_torch(tmp_path: Path, activation: str) -> None:
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(1)
    weights = [(rng.standard_normal((b, a)), rng.standard_normal(b)) for a, b in pairwise(SIZES)]
    record = {"env": ENV, "env_kwargs": {}, "observation_size": 48, "activation": activation}
    arrays = {
        f"{name}_{i}": x for i, layer in enumerate(weights) for name, x in zip(("weight", "bias"), layer, strict=True)
    }
    np.savez(tmp_path / "policy.npz", record=np.array(json.dumps(record)), **arrays)
    act, _ = read_policy(tmp_path / "policy.npz")
    obs = 0.1 * rng.standard_normal((20, 48))
    x = torch.from_numpy(obs)
    for i, (weight, bias) in enumerate(weights):
        x = getattr(torch.nn, activation)()(x) if i else x
        x = torch.nn.functional.linear(x, torch.from_numpy(weight), torch.from_numpy(bias))
    np.testing.assert_allclose(act({"policy": obs}), x.clamp(-1, 1).numpy(), atol=1e-6)
    assert 0 < (np.abs(act(obs)) == 1.0).mean() < 1


def test_a_policy_is_run_where_it_was_trained(tmp_path: Path) -> None:
    (rollout,) = walk(write(tmp_path / "stander" / "policy.npz"))
    assert (rollout.robot, rollout.transmission, rollout.label) == ("mini_cheetah", "none", "stander")
    np.testing.assert_allclose(np.unique(rollout.commands[:, 0]), [0.0, 0.5, 0.8, 1.0], rtol=1e-6)
    assert len(rollout) == 850
    assert np.ptp(rollout.q[:, 2]) < 0.2


def test_recording_ends_with_a_fall() -> None:
    rng = np.random.default_rng(0)
    rollout = drive(lambda obs: rng.normal(0, 0.8, (1, 12)).astype(np.float32), ENV, [(20.0, (1.0, 0.0, 0.0))])
    assert 1 < len(rollout) < 1000


def test_names_folders_and_files_are_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ce_gym.viewer.policies.assets_folder", lambda: tmp_path)
    shipped = write(tmp_path / "policies" / "dog_walk_exact" / "policy.npz")
    for name in ("dog_walk_exact", "dog_walk", str(shipped), str(shipped.parent)):
        assert policy_file(Path(name)) == shipped
    write(tmp_path / "rollout.npz")
    for name in ("dog", "dog_walk.npz", str(tmp_path / "rollout.npz"), str(tmp_path)):
        assert policy_file(Path(name)) is None


def test_view_writes_a_page_of_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("meshcat")
    folder = write(tmp_path / "stander" / "policy.npz").parent
    monkeypatch.chdir(tmp_path)
    assert main(["view", str(folder)]) == 0
    assert capsys.readouterr().out == "stander.html\n"
    assert not list(folder.glob("*.html"))


@pytest.mark.parametrize(
    "changes", [{"activation": "Nope"}, {"env": None, "observation_size": 47}, {"observation_size": "many"}]
)
def test_a_damaged_policy_is_one_line(tmp_path: Path, changes: dict) -> None:
    with pytest.raises(ViewerError, match=r"policy\.npz: not a policy that can be run") as caught:
        read_policy(write(tmp_path / "policy.npz", **changes))
    assert "\n" not in str(caught.value)


def test_bytes_that_are_no_policy_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "policy.npz").write_bytes(b"nothing")
    assert main(["view", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_rollouts_are_still_rollouts(tmp_path: Path) -> None:
    q = np.tile(ce_gym.Model("mini_cheetah").standing_q, (3, 1))
    rollout = Rollout(
        "mini_cheetah", "exact", 0.02, 0.02 * np.arange(3), q, np.zeros((3, 18)), np.zeros((3, 0, 3)), np.zeros((3, 3))
    )
    assert len(Rollout.load(rollout.save(tmp_path / "walk.npz"))) == 3
    assert policy_file(tmp_path / "walk.npz") is None
