"""What people install: sdist and wheel are whole and small, and the wheel works by itself.

The wheel goes into an empty environment, next to links to its declared dependencies and nothing else, and is used from
another folder with its files read-only. Knows the files of the repository; `ce_gym` only as others see it.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from packaging.metadata import Metadata
from packaging.requirements import Requirement
from pages import ROOT, blocks, commands, links

import ce_gym
from ce_gym.viewer import Rollout

pytestmark = pytest.mark.slow

STEP = """
import gymnasium, numpy as np, ce_gym
from ce_gym.model import assets_folder

env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0")
policy = ce_gym.load_policy("mini_cheetah_velocity")
observation, _ = env.reset(seed=0)
observation, reward, *_ = env.step(policy.predict(observation)[0])
assert np.isfinite(observation).all() and np.isfinite(reward)
print(ce_gym.__file__, assets_folder(), sep="\\n")
"""


def run(command: list[str | Path], **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def checked(command: list[str | Path], **options) -> str:
    result = run(command, **options)
    assert result.returncode == 0, f"{shlex.join(map(str, command))}\n{result.stdout[-2000:]}\n{result.stderr[-3000:]}"
    return result.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """Folder with the sdist, the wheel made from it, and in `direct` the wheel made from the checkout."""
    out = tmp_path_factory.mktemp("dist")
    # Without hatchling here, `build` has pip fetch it.
    command = [sys.executable, "-m", "build", *(["--no-isolation"] if find_spec("hatchling") else [])]
    checked([*command, "--outdir", out, ROOT])
    checked([*command, "--wheel", "--outdir", out / "direct", ROOT])
    return out


def only(folder: Path, pattern: str) -> Path:
    (found,) = folder.glob(pattern)
    return found


def files_of(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def sources(folder: str) -> set[str]:
    """Files below a folder of the repository that are no leftovers of running them."""
    return {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_wheel_has_all_code_and_assets_and_is_small(built: Path):
    """At most 5 MB; robots, trained policies and settings are part of the wheel, benchmarks are not."""
    wheel = only(built, "*.whl")
    assert wheel.stat().st_size <= 5e6
    names = {name for name in files_of(wheel) if ".dist-info/" not in name}
    code = sources("ce_gym") - sources("ce_gym/bench")
    settings = {f"ce_gym/learn/{name.removeprefix('train/')}" for name in sources("train/config")}
    assert names == code | settings | {f"ce_gym/{name}" for name in sources("assets")}
    for kind in ("mini_cheetah/mini_cheetah.urdf", "policies/mini_cheetah_velocity_exact/policy.npz"):
        assert f"ce_gym/assets/{kind}" in names


def test_metadata_is_valid(built: Path):
    """As PyPI checks it; the version is the same in all files that state it."""
    (metadata,) = (text for name, text in files_of(only(built, "*.whl")).items() if name.endswith("/METADATA"))
    wheel = Metadata.from_email(metadata, validate=True)
    with tarfile.open(only(built, "*.tar.gz")) as archive:
        (member,) = (one for one in archive.getmembers() if one.name.count("/") == 1 and one.name.endswith("PKG-INFO"))
        file = archive.extractfile(member)
        assert file
        assert Metadata.from_email(file.read(), validate=True).version == wheel.version
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    codemeta = json.loads((ROOT / "codemeta.json").read_text())
    assert {ce_gym.__version__, citation["version"], codemeta["version"]} == {str(wheel.version)}
    assert codemeta["description"] == wheel.summary


def test_sdist_and_checkout_make_the_same_wheel(built: Path):
    assert files_of(only(built, "*.whl")) == files_of(only(built / "direct", "*.whl"))


def test_sdist_has_what_the_readme_names(built: Path):
    """All files that README links to or runs, and their dependencies; no files of a user of the checkout."""
    with tarfile.open(only(built, "*.tar.gz")) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames()}
    assert {name for name in names if "/" not in name} == {
        ".gitignore", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "Makefile", "PKG-INFO", "README.md",
        "SECURITY.md", "constraints.txt", "pyproject.toml",
    }  # fmt: skip
    assert {name.split("/")[0] for name in names if "/" in name} == {
        ".ci", "assets", "ce_gym", "docs", "tests", "train",
    }  # fmt: skip
    words = {word for command in commands(ROOT / "README.md") for word in shlex.split(command, comments=True)}
    scripts = {word for word in words if word.endswith(".py")}
    assert scripts | set(links(ROOT / "README.md")) <= names
    for folder in ("assets", "ce_gym", "train", "tests"):
        assert sources(folder) <= names


def dependencies(of: Distribution, extra: str = "", found: dict[str, Distribution] | None = None) -> dict:
    """All dependencies of a distribution, direct and indirect, with or without an extra, by name."""
    found = {} if found is None else found
    for requirement in map(Requirement, of.requires or ()):
        wanted = requirement.marker is None or requirement.marker.evaluate({"extra": extra})
        if wanted and requirement.name not in found:
            found[requirement.name] = distribution(requirement.name)
            dependencies(found[requirement.name], "", found)
    return found


def link(one: Distribution, site: Path) -> None:
    """Make a distribution importable from another folder of packages."""
    for top in {file.parts[0] for file in one.files or ()} - {"..", "__pycache__"}:
        if not (site / top).exists():
            (site / top).symlink_to(Path(str(one.locate_file(top))))


def everything(folder: Path) -> dict[str, int]:
    """Files below a folder, links not followed, and when they were changed."""
    return {
        str(path.relative_to(folder)): path.lstat().st_mtime_ns
        for path in folder.rglob("*")
        if not path.is_symlink() and path.is_file()
    }


@pytest.fixture(scope="module")
def python(built: Path, tmp_path_factory) -> Iterator[Path]:
    """Interpreter of an environment with the wheel, read-only, and its dependencies."""
    venv = tmp_path_factory.mktemp("user") / "venv"
    checked([sys.executable, "-m", "venv", "--without-pip", venv])
    interpreter = venv / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", interpreter]
    checked([*pip, "install", "--no-deps", "--no-index", only(built, "*.whl")])
    site = only(venv, "lib/python*/site-packages")
    for one in dependencies(Distribution.at(only(site, "ce_gym-*.dist-info"))).values():
        link(one, site)
    folders = [site, site / "ce_gym", *(path for path in (site / "ce_gym").rglob("*") if path.is_dir())]
    before = everything(site / "ce_gym")
    for folder in folders:
        folder.chmod(0o555)
    yield interpreter
    for folder in folders:
        folder.chmod(0o755)
    assert everything(site / "ce_gym") == before  # an administrator may write where nobody may


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture
def elsewhere(home: Path, tmp_path: Path) -> dict:
    """An empty folder and a bare environment to run things in."""
    return {"cwd": tmp_path, "env": {"PATH": os.defpath, "HOME": str(home), "TMPDIR": str(tmp_path)}}


def test_the_wheel_steps_an_environment(python: Path, elsewhere: dict, home: Path):
    """With a policy that came along, from another folder; its kernel is kept in the user's cache."""
    package, assets = map(Path, checked([python, "-c", STEP], **elsewhere).splitlines())
    assert package.is_relative_to(python.parents[1])
    assert assets == package.parent / "assets"
    assert any((home / ".cache" / "ce_gym").iterdir())


def linked(python: Path, folder: Path, *extras: str) -> str:
    """A folder with links to the packages of extras."""
    folder.mkdir()
    site = only(python.parents[1], "lib/python*/site-packages")
    for extra in extras:
        for one in dependencies(Distribution.at(only(site, "ce_gym-*.dist-info")), extra).values():
            link(one, folder)
    return str(folder)


def test_stable_baselines3_trains_with_the_wheel(python: Path, elsewhere: dict, tmp_path: Path):
    """As the page about other learners does it, with the packages of the extra."""
    pytest.importorskip("stable_baselines3")
    elsewhere["env"]["PYTHONPATH"] = linked(python, tmp_path / "extra", "sb3")
    (code,) = (
        block.text for block in blocks(ROOT / "docs" / "how-to" / "learners.md") if "stable_baselines3" in block.text
    )
    steps = checked([python, "-c", f"{code}\nprint(learner.num_timesteps)"], **elsewhere)
    assert int(steps) == 3072
    assert (tmp_path / "walk.zip").exists()


def test_the_wheel_trains_evaluates_exports_and_plays(python: Path, elsewhere: dict, tmp_path: Path):
    """Each by one command, with settings from the wheel; MuJoCo judges a policy that has hardly learned."""
    for package in ("numba", "mujoco", "onnx", "meshcat"):
        pytest.importorskip(package)
    elsewhere["env"]["PYTHONPATH"] = linked(python, tmp_path / "extra", "train", "mjcf", "export", "viewer")
    elsewhere["env"]["NUMBA_CACHE_DIR"] = str(tmp_path / "numba")  # an administrator's would be beside the package

    def command(line: str, *codes: int) -> str:
        result = run([python, "-m", "ce_gym", *shlex.split(line)], **elsewhere)
        assert result.returncode in (0, *codes), f"{line}\n{result.stdout[-2000:]}\n{result.stderr[-3000:]}"
        return result.stdout

    few = "--num-envs 64 --steps 20000 --episodes 4"
    assert "forward speed error" in command(f"train ce_gym/MiniCheetahVelocity-v0 --out walk {few}")
    record = json.loads((tmp_path / "walk" / "policy.json").read_text())
    config = yaml.safe_load((ROOT / "train" / "config" / "mini_cheetah_velocity.yaml").read_text())
    assert record["settings"]["hidden"] == config["hidden"]
    assert list((tmp_path / "walk").glob("events.out.tfevents.*"))
    assert "Mechanical, at the rotors" in command("evaluate walk --episodes 4")
    assert "| armature" in command("transfer walk --episodes 2")
    assert "MuJoCo" in command("sim2sim walk --episodes 2 --seconds 1", 1)
    command("export walk --out walk.onnx")
    assert (tmp_path / "walk.onnx").stat().st_size > 1e4
    command("play walk --command 0.2 0.5 0 0")
    assert "mini_cheetah" in (tmp_path / "walk.html").read_text()


def test_the_wheel_inspects_and_plays(python: Path, elsewhere: dict, tmp_path: Path):
    pytest.importorskip("meshcat")
    assert "FL_knee" in checked([python, "-m", "ce_gym", "inspect", "mini_cheetah", "--no-errors"], **elsewhere)
    elsewhere["env"]["PYTHONPATH"] = linked(python, tmp_path / "extra", "viewer")
    show = ["play", "mini_cheetah_velocity", "--command", "0.2", "0.5", "0", "0", "--html", "walk.html"]
    checked([python, "-m", "ce_gym", *show], **elsewhere)
    assert "mini_cheetah" in (tmp_path / "walk.html").read_text()


def test_benchmarks_are_in_the_repository_only(python: Path, elsewhere: dict):
    result = run([python, "-m", "ce_gym", "bench", "speed"], **elsewhere)
    assert result.returncode == 2
    assert result.stderr == "ce_gym: benchmarks are not installed with the package; run them in a clone of it\n"


def test_the_wheel_brings_the_command(python: Path, elsewhere: dict):
    for command in ([python, "-m", "ce_gym"], [python.with_name("ce-gym")]):
        output = checked([*command, "list"], **elsewhere)
        assert "tello_with_arms" in output
        assert "ce_gym/Jvrc1Velocity-v0" in output


def test_what_needs_an_extra_says_which(python: Path, elsewhere: dict):
    still = Rollout("four_bar", "exact", dt=0.02, times=[0.0, 0.02], q=[[1.5], [1.5]], v=[[0.0], [0.0]])
    still.save(elsewhere["cwd"] / "still.npz")
    result = run([python, "-m", "ce_gym", "view", "still.npz"], **elsewhere)
    assert result.returncode == 2
    assert 'pip install "ce_gym[viewer]"' in result.stderr.splitlines()[-1]
