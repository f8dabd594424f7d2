"""`python -m ce_gym project` writes a package that installs, registers itself, passes its tests and trains."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from pages import ROOT

from ce_gym.__main__ import main
from ce_gym.new_project.project import write_project

NAME = "my_dogs"
BROKEN = """[ce_gym.robots]
gone = no_such_module_of_a_plugin
"""


def installed(folder: Path, site: Path) -> None:
    """Install a project into a folder of packages, without network."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", site, folder], check=True, capture_output=True)


def run(words: list[str], folder: Path, *paths: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*paths, ROOT)))}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def checked(line: str, folder: Path, *paths: Path) -> str:
    result = run(shlex.split(line), folder, *paths)
    assert result.returncode == 0, f"{line}\n{result.stdout[-3000:]}\n{result.stderr[-3000:]}"
    return result.stdout


@pytest.mark.slow
def test_a_project_installs_tests_and_trains(tmp_path: Path):
    pytest.importorskip("hatchling")
    pytest.importorskip("numba")
    project, site, empty = tmp_path / "project", tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    checked(f"-m ce_gym project {NAME} --out project", tmp_path)
    installed(project, site)
    listed = checked("-m ce_gym list", empty, site)
    assert "ce_gym/MyDogsRobotCrouch-v0" in listed.split("Environments of other packages:")[1]
    assert "12 joints" in checked(f"-m ce_gym inspect {NAME}_robot --no-errors --no-standing", empty, site)
    first = f"import {NAME}.tasks, gymnasium; gymnasium.spec('ce_gym/MyDogsRobotCrouch-Armature-v0')"
    checked(f'-c "{first}"', empty, site)  # the module of a plugin may be the first import
    assert "4 passed" in checked("-m pytest -p no:cacheprovider tests", project, site)
    settings = site / NAME / "crouch.yaml"
    train = f"-m ce_gym train ce_gym/MyDogsRobotCrouch-v0 --config {settings} --out run --steps 100000 --threads 1"
    checked(train, empty, site)
    record = json.loads((empty / "run" / "policy.json").read_text())
    assert record["steps"] >= 1e5
    assert "forward speed error" in checked("-m ce_gym evaluate run --episodes 4", empty, site)


def test_the_workflow_of_a_project_is_plain_yaml(tmp_path: Path):
    write_project(NAME, tmp_path / "new")
    workflow = yaml.safe_load((tmp_path / "new/.github/workflows/test.yml").read_text())
    assert [step["run"] for step in workflow["jobs"]["test"]["steps"] if "run" in step] == [
        'pip install ".[test]"',
        "pytest",
    ]


@pytest.mark.parametrize("name", ["My-Lab", "import", "ce_gym", "2lab"])
def test_a_name_must_be_that_of_a_package(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["project", name, "--out", str(tmp_path / "new")]) == 2
    expected = "expected lower-case letters, digits and underscores, as in my_lab"
    assert capsys.readouterr().err == f"ce_gym: name={name!r}; {expected}\n"
    assert not (tmp_path / "new").exists()


def test_a_project_replaces_no_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["project", NAME, "--out", str(tmp_path)]) == 2
    assert "is not empty; expected a new folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.slow
def test_a_broken_plugin_is_a_warning(tmp_path: Path):
    metadata = tmp_path / "broken-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(BROKEN)
    result = run(["-c", "import ce_gym; print(len(ce_gym.environment_ids()))"], tmp_path, tmp_path)
    assert int(result.stdout) > 100
    assert "entry point 'gone' of ce_gym.robots: no_such_module_of_a_plugin cannot be imported" in result.stderr
