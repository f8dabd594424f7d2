"""A robot of one's own with meshes, from URDF and from MJCF, through everything, from a folder of its own."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import gymnasium
import pytest

from ce_gym.__main__ import main
from ce_gym.learn.evaluation import transfer
from ce_gym.model import load_robot
from ce_gym.viewer.live.runner import Runner
from ce_gym.viewer.live.setup import named
from ce_gym.viewer.meshes.triangles import Triangles, drawn_meshes
from ce_gym.viewer.stream import serving

for package in ("mujoco", "meshcat", "trimesh", "fast_simplification"):
    pytest.importorskip(package)

DATA = Path(__file__).parents[1] / "data"
BLOCK = """v -1 -1 -1\nv 1 -1 -1\nv -1 1 -1\nv -1 -1 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""
MESHES = {"plate": 0.1, "arm": 0.04}
"""Meshes and half their size [m]."""


def write_urdf(folder: Path) -> Path:
    """Tripod, whose three links are seen as meshes; returns the file to register."""
    visual = '<visual><geometry><mesh filename="meshes/{}.obj"/></geometry></visual></link>'
    plate, upper_arm, forearm, rest = (DATA / "tripod" / "tripod.urdf").read_text().split("</link>")
    links = [part + visual.format(name) for part, name in ((plate, "plate"), (upper_arm, "arm"), (forearm, "arm"))]
    (folder / "tripod.urdf").write_text("".join([*links, rest]))
    text = (DATA / "tripod" / "tripod.yaml").read_text()
    (folder / "scout.yaml").write_text(text.replace("urdf: tripod.urdf", "name: scout\nurdf: tripod.urdf"))
    return folder / "scout.yaml"


def write_mjcf(folder: Path) -> Path:
    (folder / "rover.xml").write_text((DATA / "own_robot" / "rover.xml").read_text())
    return folder / "rover.xml"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ce_gym.model.LossyImportWarning")
@pytest.mark.parametrize(("write", "name", "seen"), [(write_urdf, "Scout", 3), (write_mjcf, "Rover", 3)])
def test_everything_takes_it(write, name, seen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd) -> None:
    (tmp_path / "meshes").mkdir()
    for mesh, size in MESHES.items():
        rows = [row.replace("1", f"{size}") if row[0] == "v" else row for row in BLOCK.splitlines()]
        (tmp_path / "meshes" / f"{mesh}.obj").write_text("\n".join(rows) + "\n")
    file = write(tmp_path)
    module = f"robots_of_mine_{name.lower()}"
    (tmp_path / f"{module}.py").write_text(f"import ce_gym\nce_gym.register_robot({str(file)!r})\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(transfer, "LEVELS", ("exact", "none"))  # each takes seconds to compile
    before, env = set(gymnasium.registry), f"{module}:ce_gym/{name}Velocity-v0"
    try:
        small = ["hidden=[8]", "rollout=16", "epochs=1", "minibatches=1"]
        train = ["train", env, "--steps", "1024", "--num-envs", "32", "--threads", "1", "--out", "run", "--set", *small]
        assert main([*train, "--episodes", "4"]) == 0
        judged = ["run", "--env", env, "--episodes", "2"]
        assert main(["evaluate", *judged, "--json", "evaluation.json"]) == 0
        assert json.loads(Path("evaluation.json").read_text())["episode_length"] > 0
        assert main(["transfer", *judged]) == 0
        assert main(["sim2sim", *judged, "--seconds", "1", "--json", "sim2sim.json"]) in (0, 1)  # it has hardly learned
        assert Path("sim2sim.json").exists()
        assert main(["inspect", str(file), "--no-errors"]) == 0
        assert main(["inspect", env]) == 0
        assert main(["play", "run", "--env", env, "--command", "0.1", "0", "0", "0"]) == 0
        assert Path("run.html").exists()
        with serving(Runner(named("run", env), tmp_path)):
            pass
        drawn = drawn_meshes(load_robot(file))
        assert sum(isinstance(one, Triangles) for shapes in drawn.values() for one in shapes) >= seen
        assert "not drawn" not in capfd.readouterr().err
    finally:
        sys.modules.pop(module, None)
        for one in set(gymnasium.registry) - before:
            del gymnasium.registry[one]
        importlib.invalidate_caches()
