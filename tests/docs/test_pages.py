"""The pages are built without a warning, lead nowhere that does not exist, and have a place for every public name."""

from __future__ import annotations

import importlib
import inspect
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from pages import ROOT

import ce_gym
import ce_gym.identify
import ce_gym.learn
import ce_gym.model
import ce_gym.numba
import ce_gym.viewer
from ce_gym.bench.measure.report import read_report

PUBLIC = (ce_gym, ce_gym.identify, ce_gym.learn, ce_gym.model, ce_gym.numba, ce_gym.viewer)
SPECIAL = {"index.html", "genindex.html", "py-modindex.html", "search.html"}
"""Pages of the site that Sphinx adds, and the front page."""
SNAPSHOT = ROOT / "tests" / "data" / "public_names.txt"


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    if find_spec("sphinx") is None or find_spec("myst_parser") is None or find_spec("furo") is None:
        pytest.skip("Sphinx is not installed: pip install -e '.[docs]'")
    out = tmp_path_factory.mktemp("html")
    options = ["-W", "--keep-going", "--nitpicky", "-q", "-b", "html", "-d", str(out / "doctrees")]
    command = [sys.executable, "-m", "sphinx", *options, str(ROOT / "docs"), str(out / "html")]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert result.returncode == 0, result.stderr[-4000:]
    return out / "html"


@pytest.mark.slow
def test_every_robot_and_environment_has_a_page(built: Path):
    generated = built / "generated"
    assert {path.stem for path in (generated / "robots").glob("*.html")} == set(ce_gym.robots())
    pages = {(a["robot"], a["task"]) for a in ce_gym.environment_ids().values()}
    assert {path.stem for path in (generated / "environments").glob("*.html")} == {f"{r}_{t}" for r, t in pages}
    for path in (generated / "robots").glob("*.html"):
        assert '<div class="ce-tree"><svg' in path.read_text()


@pytest.mark.slow
def test_every_id_is_on_a_page(built: Path):
    text = "".join(path.read_text() for path in (built / "generated" / "environments").glob("*.html"))
    assert not [name for name in ce_gym.environment_ids() if name not in text]


@pytest.mark.slow
def test_llms_txt_lists_every_page(built: Path):
    text = (built / "llms.txt").read_text(encoding="utf-8")
    lines = text.splitlines()
    assert lines[0] == "# ce_gym"
    assert lines[2].startswith("> Gymnasium environments for legged robots")
    listed = re.findall(r"^- \[[^\]]+\]\(([^)]+)\): \S", text, re.MULTILINE)
    assert len(listed) == sum(line.startswith("- ") for line in lines)
    assert sorted(listed) == sorted({page.relative_to(built).as_posix() for page in built.rglob("*.html")} - SPECIAL)


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(built: Path):
    from sphinx.util.inventory import InventoryFile

    with (built / "objects.inv").open("rb") as file:
        inventory = InventoryFile.load(file, "", lambda base, path: path)
    known = {name for kind, entries in inventory.items() if kind.startswith("py:") for name in entries}
    names = [f"{module.__name__}.{name}" for module in PUBLIC for name in module.__all__]
    homes = {f"ce_gym.{name}" for name in ce_gym.__all__}
    missing = [n for n in names if n not in known and f"ce_gym.{n.rsplit('.', 1)[1]}" not in homes & known]
    assert not missing


def test_public_names_change_on_purpose_only():
    """A name that comes or goes is written into the snapshot, and into CHANGELOG.md."""
    api = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "reference" / "api").glob("*.md"))
    public = {f"{module.__name__}.{name}" for module in PUBLIC for name in module.__all__}
    public |= set(re.findall(r"^\.\. (?:auto(?!module)\w+|py:data):: (ce_gym\.[\w.]+)", api, re.MULTILINE))
    snapshot = SNAPSHOT.read_text(encoding="utf-8").split()
    assert snapshot == sorted(snapshot)
    assert (public - set(snapshot), set(snapshot) - public) == (set(), set())
    page = (ROOT / "docs" / "reference" / "api" / "public.md").read_text(encoding="utf-8")
    assert [module.__name__ for module in PUBLIC if f"`{module.__name__}`" not in page] == []


def test_what_returns_arrays_says_their_shape():
    silent = []
    for owner in (ce_gym.Model, ce_gym.Simulator, ce_gym.Terrain):
        for name, thing in inspect.getmembers(owner):
            function = thing.fget if isinstance(thing, property) else thing
            hint = str(getattr(function, "__annotations__", {}).get("return", ""))
            document = inspect.getdoc(thing) or ""
            if not name.startswith("_") and "Array" in hint and "shape" not in document:
                silent.append(f"{owner.__name__}.{name}")
    assert not silent


def test_the_reference_imports_what_it_names():
    for module in PUBLIC:
        for name in module.__all__:
            assert getattr(importlib.import_module(module.__name__), name) is not None


def test_measured_figures_of_the_readme():
    reports = {
        name: read_report(ROOT / "docs" / "results" / f"{name}.json") for name in ("speed", "throughput", "accuracy")
    }
    measured = [r.measured.split()[0].rstrip(";") for report in reports.values() for r in report.requirements]
    text = (ROOT / "README.md").read_text()
    steps = max(row[3] for row in reports["throughput"].tables[0].rows)
    compile_s, load_s = (row[2] for row in reports["throughput"].tables[2].rows)
    sub_step = next(row[2] for row in reports["speed"].tables[0].rows if row[0] == "ce_gym exact float64")
    ratios = [
        f"1/{float(r.measured.split()[0]):.0f}" for r in reports["accuracy"].requirements if "equal error" in r.claim
    ]
    assert f"{steps / 1e6:.2f} million per second" in text
    assert f"{sub_step:.2f} us; MuJoCo with these rotors takes {float(measured[1]):.0f} times" in text
    assert f"{compile_s:.1f} s; {load_s:.2f} s" in text
    assert ", ".join(ratios) in text
