"""What a figure depends on, and which changes of it count, in a repository of a few lines."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from ce_gym.bench.page import depends

FILES = {
    "ce_gym/__init__.py": "from ce_gym.a import f\nfrom ce_gym.b import g\n",
    "ce_gym/a.py": "def f():\n    return 1\n",
    "ce_gym/b.py": "def g():\n    return 2\n",
    "ce_gym/viewer/console.py": "WIDTH = 80\n",
    "ce_gym/bench/speed.py": "from ce_gym import f\nfrom ce_gym.viewer.console import WIDTH\nROBOT = 'dog'\n",
    "ce_gym/bench/every.py": "import numpy\n\n\ndef run():\n    from ce_gym.b import g\n\n    return robots()\n",
    "train/script.py": "import other\nfrom ce_gym.a import f\n",
    "train/other.py": "",
    "assets/dog/dog.yaml": "a: 1\n",
    "assets/dog/dog.urdf": "<robot> <link/> </robot>",
    "assets/cat/cat.yaml": "a: 1\n",
}
SPEED = "ce_gym/bench/speed.py"


@pytest.fixture
def repository(tmp_path: Path, monkeypatch) -> Path:
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
    depends.files.cache_clear()
    depends._tree.cache_clear()


def test_modules_are_reached_by_the_names_that_are_imported(repository: Path):
    dog = {"assets/dog/dog.yaml", "assets/dog/dog.urdf"}
    assert depends.files(SPEED) == {SPEED, "ce_gym/a.py"} | dog
    every = "ce_gym/bench/every.py"
    assert depends.files(every) == {every, "ce_gym/b.py", "assets/cat/cat.yaml"} | dog
    assert depends.files("train/script.py") == {"train/script.py", "train/other.py", "ce_gym/a.py"}
    assert depends.benchmark_file("speed") == SPEED


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("ce_gym/a.py", '"""New."""\n\n\ndef f() -> int:\n    "Text."  # words\n    return 1\n'),
        ("ce_gym/b.py", "def g():\n    return 3\n"),
        ("ce_gym/viewer/console.py", "WIDTH = 100\n"),
        ("assets/dog/dog.yaml", "a: 1  # of somebody\n"),
        ("assets/dog/dog.urdf", "<robot><!-- ours -->\n<link/></robot>"),
        ("assets/cat/cat.yaml", "a: 2\n"),
    ],
)
def test_what_changes_no_figure(repository: Path, name: str, text: str):
    (repository / name).write_text(text)
    assert depends.changed(SPEED, "HEAD") == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("ce_gym/a.py", "def f():\n    return 2\n"),
        ("ce_gym/a.py", "def f(x=1):\n    return 1\n"),
        ("ce_gym/a.py", "def f():\n    if not f:\n        raise ValueError\n    return 1\n"),
        ("assets/dog/dog.yaml", "a: 2\n"),
        ("assets/dog/dog.urdf", "<robot><joint/></robot>"),
    ],
)
def test_what_may_change_a_figure(repository: Path, name: str, text: str):
    (repository / name).write_text(text)
    assert depends.changed(SPEED, "HEAD") == [name]


def test_modules_that_are_new_count(repository: Path):
    (repository / "ce_gym/a.py").write_text("from ce_gym.c import f\n")
    (repository / "ce_gym/c.py").write_text("def f():\n    return 1\n")
    subprocess.run(["git", "-C", str(repository), "add", "-A"], check=True)
    assert depends.changed(SPEED, "HEAD") == ["ce_gym/a.py", "ce_gym/c.py"]


def test_texts_of_errors_do_not_count():
    one, other = (f"def f(x):\n    raise ValueError('{text}')\n" for text in ("expected 1", "1 was expected"))
    assert depends.meaning(one, ".py") == depends.meaning(other, ".py")


def test_a_commit_that_is_not_there(repository: Path):
    with pytest.raises(LookupError):
        depends.changed(SPEED, "1234567")
