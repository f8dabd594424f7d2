"""What a figure depends on, and which changes of it count, in a repository of a few lines."""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from ce_gym.bench.page import depends, stale
from ce_gym.bench.page.source import Source

FILES = {
    "ce_gym/__init__.py": "from ce_gym.a import f\nfrom ce_gym.b import g\nfrom ce_gym import b as c\n",
    "ce_gym/a.py": "from ce_gym.b import h\nONE = TWO = 1\n\n\ndef f():\n    return ONE + h()\n\n\n"
    "def other():\n    return 0\n",
    "ce_gym/b.py": "def g():\n    return 2\n\n\ndef h():\n    return 3\n",
    "ce_gym/copy.py": "replace = 1\n",
    "ce_gym/viewer/console.py": "WIDTH = 80\n",
    "ce_gym/bench/speed.py": "from copy import replace\nfrom ce_gym import f\nfrom ce_gym.viewer.console import WIDTH\n"
    "ROBOT = 'dog'\n\n\ndef run():\n    return replace(f(WIDTH))\n",
    "ce_gym/bench/every.py": "def run():\n    from ce_gym import robots, c\n\n    return robots(c.g)\n",
    "ce_gym/bench/ids.py": "import ce_gym  # registers\nENV = 'ce_gym/BigCatWalk-v0'\n",
    "train/script.py": "import other\n\nother.learn()\n",
    "train/other.py": "def learn():\n    return 1\n",
    "assets/dog/dog.yaml": "a: 1\n",
    "assets/dog/dog.urdf": "<robot> <link/> </robot>",
    "assets/big_cat/big_cat.yaml": "a: 1\n",
}
SPEED = "ce_gym/bench/speed.py"


@pytest.fixture
def repository(tmp_path: Path, monkeypatch) -> Iterator[Path]:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for arguments in (["init", "-q"], ["add", "-A"], ["-c", "user.name=a", "-c", "user.email=b", "commit", "-qm", "c"]):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True)
    monkeypatch.setattr(depends, "ROOT", tmp_path)
    _forget()
    yield tmp_path
    _forget()


def _forget() -> None:
    depends.needed.cache_clear()
    depends._source.cache_clear()


def names(script: str) -> set[str]:
    """Return what a script needs, as "file:name", without what files do when they are imported."""
    return {f"{file}:{name}" for file, name in depends.needed(script) if name and file != script}


def test_definitions_are_reached_by_the_names_that_are_used(repository: Path):
    assert names(SPEED) == {"ce_gym/a.py:f", "ce_gym/a.py:ONE", "ce_gym/a.py:TWO", "ce_gym/b.py:h"}
    assert "ce_gym/b.py:g" in names("ce_gym/bench/every.py")  # by another name, of a module
    assert "ce_gym/__init__.py:*" in names("ce_gym/bench/ids.py")  # imported for what that does
    assert names("train/script.py") == {"train/other.py:learn"}
    assert depends.benchmark_file("speed") == SPEED


def test_robots_are_those_that_are_named(repository: Path):
    def robots(script: str) -> set[str]:
        return set(depends._robot_files(script, depends.needed(script)))

    dog, cat = {"assets/dog/dog.yaml", "assets/dog/dog.urdf"}, {"assets/big_cat/big_cat.yaml"}
    assert robots(SPEED) == dog
    assert robots("ce_gym/bench/ids.py") == cat
    assert robots("ce_gym/bench/every.py") == dog | cat


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("ce_gym/a.py", FILES["ce_gym/a.py"].replace("def f():", 'def f() -> int:\n    "Text."  # words')),
        ("ce_gym/a.py", FILES["ce_gym/a.py"].replace("return 0", "return 1")),
        ("ce_gym/b.py", FILES["ce_gym/b.py"].replace("2", "4")),
        ("ce_gym/copy.py", "replace = 2\n"),
        ("ce_gym/viewer/console.py", "WIDTH = 100\n"),
        ("assets/dog/dog.yaml", "a: 1  # of somebody\n"),
        ("assets/dog/dog.urdf", "<robot><!-- ours -->\n<link/></robot>"),
        ("assets/big_cat/big_cat.yaml", "a: 2\n"),
    ],
)
def test_what_changes_no_figure(repository: Path, name: str, text: str):
    (repository / name).write_text(text)
    assert depends.changed(SPEED, "HEAD") == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("ce_gym/a.py", FILES["ce_gym/a.py"].replace("ONE +", "2 * ONE +")),
        ("ce_gym/a.py", FILES["ce_gym/a.py"].replace("TWO = 1", "TWO = 2")),
        ("ce_gym/a.py", FILES["ce_gym/a.py"] + "\n\nf = cached(f)\n"),
        ("ce_gym/a.py", FILES["ce_gym/a.py"] + "\n\nother()\n"),
        ("ce_gym/b.py", FILES["ce_gym/b.py"].replace("3", "4")),
        ("assets/dog/dog.yaml", "a: 2\n"),
        ("assets/dog/dog.urdf", "<robot><joint/></robot>"),
    ],
)
def test_what_may_change_a_figure(repository: Path, name: str, text: str):
    (repository / name).write_text(text)
    assert depends.changed(SPEED, "HEAD") == [name]


def test_what_moves_to_a_new_module_counts(repository: Path):
    (repository / "ce_gym/a.py").write_text("from ce_gym.d import f\n")
    (repository / "ce_gym/d.py").write_text("def f():\n    return 1\n")
    subprocess.run(["git", "-C", str(repository), "add", "-A"], check=True)
    _forget()
    assert depends.changed(SPEED, "HEAD") == ["ce_gym/d.py"]


def test_texts_of_errors_do_not_count():
    one, other = (f"def f(x):\n    raise ValueError('{text}')\n" for text in ("expected 1", "1 was expected"))
    assert Source.of(one).meaning("f") == Source.of(other).meaning("f")


def test_a_commit_that_is_not_there(repository: Path):
    with pytest.raises(LookupError):
        depends.changed(SPEED, "1234567")


def test_the_report_names_what_is_stale_and_lists_records_apart(repository: Path):
    git = ["git", "-C", str(repository), "rev-parse", "--short=7", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    said = f"`python -m ce_gym.bench speed` at {commit}.\n\nBy `train/script.py`, written at {commit}.\n"
    (repository / "README.md").write_text(said)
    report = stale.run(argparse.Namespace())
    assert not report.failed
    assert [row[-1] for row in report.tables[0].rows] == [""]
    (repository / "ce_gym/b.py").write_text(FILES["ce_gym/b.py"].replace("3", "4"))
    (repository / "train/other.py").write_text("def learn():\n    return 2\n")
    _forget()
    report = stale.run(argparse.Namespace())
    assert report.failed
    assert report.tables[0].rows == (("README.md", 1, "speed", commit, "b.py"),)
    assert report.tables[1].rows == (("README.md", 3, commit),)
