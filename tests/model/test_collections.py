"""Robots that installed packages download: the packages' own interfaces, without a network."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from ce_gym.model import RobotError, load_robot

PUP = Path(__file__).parents[1] / "data" / "own_robot" / "pup.urdf"


@pytest.fixture
def menagerie(monkeypatch, tmp_path):
    """A stand-in for mujoco_menagerie with one robot."""
    hopper = SimpleNamespace(default_model="hopper", xml=lambda entry: tmp_path / f"{entry}.xml")
    module = SimpleNamespace(names=lambda: ["hopper"], get={"hopper": hopper}.__getitem__)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", module)
    return hopper


def descriptions(monkeypatch, folder: Path, text: str) -> None:
    """A stand-in for robot_descriptions with one description, of this content."""
    package = folder / "robot_descriptions"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "pup_description.py").write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)


def test_a_description(monkeypatch, tmp_path):
    shutil.copy(PUP, tmp_path)
    descriptions(monkeypatch, tmp_path, f"URDF_PATH = {str(tmp_path / 'pup.urdf')!r}")
    assert load_robot("robot_descriptions:pup_description") == load_robot(PUP)
    with pytest.raises(RobotError, match=r"robot is 'pop_description': .*did you mean 'pup_description'"):
        load_robot("robot_descriptions:pop_description")
    sys.modules.pop("robot_descriptions.pup_description")


def test_a_download_that_fails_is_one_line(monkeypatch, tmp_path):
    descriptions(monkeypatch, tmp_path, "raise OSError('no host called\\ngithub')")
    with pytest.raises(RobotError, match=r"cannot be downloaded: .*\(no host called github\)$"):
        load_robot("robot_descriptions:pup_description")


def test_menagerie(menagerie, tmp_path):
    pytest.importorskip("mujoco")
    body = '<body name="b"><joint axis="0 1 0"/><geom size="0.1"/></body>'
    (tmp_path / "hopper.xml").write_text(f'<mujoco model="hop"><worldbody>{body}</worldbody></mujoco>')
    assert load_robot("menagerie:hopper").name == "hop"
    with pytest.raises(RobotError, match=r"menagerie:hoper: robot is 'hoper': .*did you mean 'hopper'"):
        load_robot("menagerie:hoper")


def test_without_the_package_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(RobotError, match="expected the package mujoco-menagerie; pip install mujoco-menagerie"):
        load_robot("menagerie:unitree_go2")
