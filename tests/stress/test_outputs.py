"""Command lines whose outputs are files that are there: what is read, and files of other kinds, stay as they are."""

import json
import random
import shutil
from pathlib import Path

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym.__main__ import main
from ce_gym.files import LOG, ONNX, PAGE, ROBOT, Kind, json_kind
from ce_gym.policies import Actor, write_npz
from ce_gym.viewer import Rollout

pytest.importorskip("meshcat")
pytest.importorskip("onnx")
pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

SPECIFICATION = json_kind(json.dumps({"robot": "x"}, indent=2))
ENV = "ce_gym/MiniCheetahStand-v0"


def fill(folder: Path) -> None:
    """Write a file of each kind, a link and a hard link."""
    for kind in (".yaml", ".urdf"):
        shutil.copy(Path(TRIPOD).with_suffix(kind), folder)
    rollout = Rollout("four_bar", "exact", 0.02, [0.0, 0.02], [[1.5], [1.5]], [[0.0], [0.0]])
    rollout.save(folder / "walk.npz")
    rollout.save(folder / "other.npz")
    layers = ((np.zeros((12, 48), np.float32), np.zeros(12, np.float32)),)
    specification = {"robot": "mini_cheetah", "task": "stand"}
    record = {"env": ENV, "env_kwargs": {}, "transmission": "exact", "observation_size": 48, "action_size": 12}
    write_npz(
        Actor(layers, "Tanh"), record | {"activation": "Tanh", "policy_spec": specification}, folder / "policy.npz"
    )
    (folder / "page.html").write_text("<!DOCTYPE html>\n<!-- ce_gym: a page -->\n")
    (folder / "mine.html").write_text("<html>my page</html>")
    (folder / "policy.json").write_text('{\n  "env": "x"\n}\n')
    (folder / "measured.csv").write_text("time,command:a,angle:a\n0,0,0\n")
    (folder / "notes").write_text("notes")
    (folder / "empty.html").touch()
    (folder / "link.html").symlink_to("walk.npz")
    (folder / "hard.html").hardlink_to(folder / "walk.npz")


def command(rng: random.Random, names: list[str]) -> tuple[list[str], set[str], dict[str, Kind]]:
    """Return a command line, the files that it reads, and the files that it may write with their kinds."""
    kind = rng.choice(("view", "view", "export", "new", "simulate"))
    target = rng.choice([*names, "new.html", "new.onnx", "no/folder.html"])
    if rng.random() < 0.4:
        target = rng.choice(["walk.npz", "hard.html", "link.html"] if kind == "view" else ["tripod.urdf"])
    if kind == "view":
        sources = rng.sample(["walk.npz", "other.npz"], rng.choice((1, 2)))
        return ["view", *sources, "--html", target], set(sources), {target: PAGE}
    if kind == "export":
        target = f"{Path(target).stem}.onnx"
        outputs = {target: ONNX, f"{Path(target).stem}.json": SPECIFICATION}
        return ["export", "policy.npz", "--out", target], {"policy.npz"}, outputs
    robot = next(name for name in names if name.endswith(".urdf"))
    if kind == "new":
        return ["new", robot, "--out", target], {robot}, {target: ROBOT}
    return ["identify", "planar_leg_linkage", target, "--simulate", "1"], set(), {target: LOG}


def content(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def test_files_over_each_other(tmp_path, monkeypatch, capsys):
    pytest.importorskip("scipy")
    fill(tmp_path)
    monkeypatch.chdir(tmp_path)
    original, written = content(tmp_path), 0
    links = {"link.html": "walk.npz", "hard.html": "walk.npz"}
    for seed in range(60):
        rng = random.Random(seed)
        argv, read, outputs = command(rng, sorted(original))
        force = rng.random() < 0.3
        code = main([*argv, *(["--force"] if force else [])])
        lines = [line for line in capsys.readouterr().err.splitlines() if "compiling" not in line]
        assert (code, len(lines)) in ((0, 0), (2, 1)), (argv, lines)
        outputs |= {"link.html": outputs["walk.npz"]} if "walk.npz" in outputs else {}
        outputs |= {"walk.npz": outputs["link.html"]} if "link.html" in outputs else {}
        now = content(tmp_path)
        written += code == 0
        for name, data in original.items():
            is_read = links.get(name, name) in read
            mark = outputs[name].mark if name in outputs else None
            is_of_kind = mark is not None and (mark in data[:128] or not data)
            may_change = name in outputs and not is_read and (force or is_of_kind)
            assert may_change or now[name] == data, f"{argv}, --force {force}: {name} is replaced"
        assert not [name for name in now if name.startswith(".")], "a temporary file is left"
        for name in now:
            (tmp_path / name).unlink()
        fill(tmp_path)
    assert written > 15
